"""Divergences of numbers of any size: finite or infinite, never a warning or nan."""

import numpy as np
import pytest

from rbjax.sysid.parameters.divergence import TRIAL, Divergence, _excess

ONE = np.array([1.0])
KINDS = {
    "positive": lambda p: Divergence.positive(np.array([p]), ONE),
    "free": lambda p: Divergence.free(np.array([p]), ONE, 1e-3),
    "bounded": lambda p: Divergence.bounded(np.array([p]), ONE, 0.0, np.inf, 1.0),
    "both bounds": lambda p: Divergence.bounded(np.array([p]), ONE, 0.0, 1.7e308, 1.0),
    "definite": lambda p: Divergence.definite(
        p * np.eye(4)[None], np.eye(4)[None], np.eye(4)[None]
    ),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("p", [3.7e62, 1e155, 1e200, 1e307, 1e-6, 1.0, 2.0])
def test_a_step_of_any_size_has_a_divergence(kind, p):
    """Warnings are errors in tests: a trial step may make a number enormous."""
    with np.errstate(**TRIAL):
        found = KINDS[kind](p)
        assert not np.isnan(found.value) and found.value >= 0
        if np.isfinite(found.value):
            assert np.isfinite(found.slope).all()
            assert not np.isnan(found.curvature).any()
    assert (found.value == 0) == (p == 1)


@pytest.mark.parametrize("p", [1e-200, 1e-310])
def test_a_number_next_to_zero(p):
    with np.errstate(**TRIAL):
        found = KINDS["positive"](p)
        assert found.value > 400 and not np.isnan(found.curvature).any()
        assert not np.isnan(found.slope).any()


def test_the_excess_is_that_of_long_doubles():
    """x - log(1 + x), relative to the value; 1e-9 near the change of formula at 1e-3."""
    x = np.concatenate([s * np.logspace(-12, np.log10(0.9), 60) for s in (-1, 1)])
    x = np.append(x, np.logspace(0, 300, 40))
    wide = x.astype(np.longdouble)
    want = np.where(np.abs(x) < 1e-5, wide**2 * (1 / 2 - wide / 3), wide - np.log1p(wide))
    np.testing.assert_allclose(_excess(x), want.astype(float), rtol=1e-9)
