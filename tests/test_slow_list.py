"""The list of slow tests names existing functions, and functions are listed by their cost."""

import re
from pathlib import Path

from tests import slow_list

ROOT = Path(__file__).parent.parent


def test_every_name_is_that_of_a_test():
    for name in slow_list.listed():
        assert name == slow_list.function(name), "whole functions only"
        file, test = re.sub(r"\[.*\]", "", name).split("::")
        own = test if file.startswith("tests/") else test.rpartition(".")[2]
        text = (ROOT / file).read_text()
        assert f"def {own}(" in text or f"class {own}" in text or f"{own} =" in text, name


def test_functions_are_listed_by_the_mean_and_the_sum_of_their_cases():
    limit, total = slow_list.LIMIT, slow_list.TOTAL
    half = 0.5 * limit
    cheap = {f"a::many[{i}]": half for i in range(2 * int(total / half))}
    times = {"a::f[1]": half, "a::f[2]": 3 * limit, "a::g": 0.9 * limit, "a::h[x]": 1.1 * limit,
             "a::i[1]": half, **cheap}  # fmt: skip
    assert slow_list.slow(times) == {"a::f", "a::h", "a::many"}
    assert not slow_list.slow({"tests/test_registry.py::test_composes[x]": 9.0})
