"""Of nested models, the one that data need."""

import numpy as np
import pytest

from rbjax.errors import InputError
from rbjax.sysid.torque import select

T = np.linspace(-1, 1, 60)


def powers(*degrees):
    return {
        f"degree {n}": (np.stack([T**k for k in range(n + 1)], 1), [f"t^{k}" for k in range(n + 1)])
        for n in degrees
    }


def test_terms_in_the_middle_that_are_not_needed_do_not_hide_one_that_is():
    noise = 0.01 * np.random.default_rng(1).normal(size=T.size)
    found = select(powers(0, 1, 2, 3, 4), 1.0 + T**3 + noise)
    assert found.name == "degree 3"
    assert [c.significant for c in found.comparisons] == [True, False, True, False]
    np.testing.assert_allclose(found.regression.beta, [1, 0, 0, 1], atol=0.02)  # 5 sigma


def test_a_candidate_that_adds_no_direction_is_passed_over():
    small = powers(1)
    W, _ = small["degree 1"]
    twice = {"twice": (np.concatenate([W, W], 1), list("abcd"))}
    found = select(small | twice, 2 * T + np.cos(40 * T))
    assert found.name == "degree 1" and not found.comparisons


def test_candidates_that_are_not_nested_are_refused():
    other = {"waves": (np.stack([np.sin(9 * T), np.cos(9 * T), np.sin(5 * T)], 1), list("abc"))}
    with pytest.raises(InputError, match="not nested"):
        select(powers(1) | other, 2 * T + 0.01 * np.cos(40 * T))


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_exact_torques_of_a_smaller_model(unit):
    """What larger models leave is rounding, in either order and in any unit."""
    t = np.linspace(0.0, 1.0, 50)
    powers = np.stack([t**k for k in range(4)], 1)
    lines = {f"degree {n}": (powers[:, : n + 1], "abcd"[: n + 1]) for n in range(4)}
    for exact, name in ((3 * t, "degree 1"), (2 - t**3, "degree 3"), (0 * t + 5, "degree 0")):
        assert select(lines, unit * exact).name == name
