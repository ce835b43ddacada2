"""Random programs by the emitted C against XLA."""

from __future__ import annotations

import numpy as np
import pytest

from tests.compiler.host import COMPILER, by_xla, many_on_host
from tests.compiler.random_programs import arguments, program

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")

TOGETHER = 20  # programs in one translation unit and one program of XLA


def differences(seeds: range) -> list[str]:
    cases = [(program(seed), arguments(seed)) for seed in seeds]
    got = many_on_host(cases, ("-O0", "-ffp-contract=off"))
    want = by_xla(cases)
    wrong = []
    for seed, gs, ws in zip(seeds, got, want, strict=True):
        for k, (g, w) in enumerate(zip(gs, ws, strict=True)):
            if not np.allclose(g, w, rtol=1e-8, atol=1e-8, equal_nan=True):
                wrong.append(f"program {seed}, result {k}: {np.abs(g - w).max()}")
    return wrong


@pytest.mark.parametrize("first", [0, TOGETHER])
def test_random_programs(first):
    assert not (wrong := differences(range(first, first + TOGETHER))), wrong


@pytest.mark.slow
@pytest.mark.parametrize("first", range(2 * TOGETHER, 1000, TOGETHER))
def test_a_thousand_random_programs(first):
    assert not (wrong := differences(range(first, first + TOGETHER))), wrong
