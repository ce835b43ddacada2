"""The list of slow tests names tests that there are, and leaves each function a case."""

from pathlib import Path

from tests import slow_list

ROOT = Path(__file__).parent.parent


def test_every_name_is_that_of_a_test():
    for name in slow_list.listed():
        file, test = slow_list.function(name).split("::")
        own = test if file.startswith("tests/") else test.rpartition(".")[2]
        text = (ROOT / file).read_text()
        assert f"def {own}(" in text or f"class {own}" in text or f"{own} =" in text, name


def test_the_cheapest_case_stays_quick_unless_it_is_long():
    times = {"a::f[1]": 1.4, "a::f[2]": 3.0, "a::g": 1.6, "a::h": 1.2, "a::i[1]": 0.1}
    assert slow_list.slow(times) == {"a::f[2]", "a::g"}
