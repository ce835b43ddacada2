"""Rows of a fit: triangles, projections, robust rows, residuals of attitudes."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbjax.sensors.columns import Columns
from rbjax.sysid.simulation.simulation_error import HUBER, SimulationError
from rbjax.sysid.statistics.rank import project_out_others, triangle_of
from rbjax.sysid.statistics.residual_tests import explained

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("rows", [2, 4, 9])
def test_a_triangle_has_the_normal_equations_of_its_rows(rows):
    """Also of fewer rows than columns."""
    A = RNG.normal(size=(rows, 4))
    R = triangle_of(A)
    assert R.shape == (4, 4) and (np.tril(R, -1) == 0).all()
    np.testing.assert_allclose(R.T @ R, A.T @ A, rtol=0, atol=1e-13)


def test_slopes_beside_others_are_residuals_of_least_squares():
    """Of other numbers whose slopes depend on each other, in different units."""
    a, b, c = RNG.normal(size=(3, 8))
    others = np.stack([a, 1e6 * b, a + b, np.zeros(8)], 1)
    found = project_out_others(np.column_stack([c, others, RNG.normal(size=8)]), 1)[:, 0]
    span = np.stack([a, b], 1)
    np.testing.assert_allclose(found, c - span @ np.linalg.lstsq(span, c)[0], rtol=0, atol=1e-13)


def robust(times, u):
    """r = sign(u) sqrt(2 rho(u)) of one number x, with du/dx = 1: rho' = psi, dr/dx = psi / r."""
    far = np.abs(u) > HUBER
    r = np.where(far, np.sign(u) * np.sqrt(np.abs(HUBER * (2 * np.abs(u) - HUBER))), u)
    J = np.clip(u, -HUBER, HUBER) / r
    shape = (1, len(u), 1)
    runs = SimpleNamespace(
        times={"q": times}, values={"q": u.reshape(shape)}, weights={"q": np.ones(shape)}
    )
    of = SimpleNamespace(
        _seeded_slopes=lambda x: (r[None], J[None, :, None]),
        _bases=lambda: {"q": [None]}, shared=1, own=0, count=1, loss="huber",
        runs=runs, setup=SimpleNamespace(columns=lambda sensor: Columns(1)),
    )  # fmt: skip
    of.rows_of = functools.partial(SimulationError.rows_of, of)
    of.unknowns = SimpleNamespace(prior_rows=lambda p: np.zeros((0, 2)))
    return of


def test_rows_beyond_a_knee_are_those_of_the_linear_residual():
    """psi = clip(u) and du/dx = 1 of u = x - y; steps of a clock that ends with its last time."""
    off = np.array([0.3, -0.2, 4.0, -7.0, 1.0])
    of = robust(np.array([[0.0, 0.1, 0.2, 0.3, 0.3]]), off)
    (column,) = SimulationError.columns(of, np.zeros(1), set())
    (rows,) = column.runs
    np.testing.assert_allclose(rows.psi, np.clip(off, -HUBER, HUBER), rtol=1e-14)
    np.testing.assert_allclose(rows.J[:, 0], 1.0, rtol=1e-14)
    assert rows.inside.tolist() == [True, True, False, False, True]
    assert rows.place.tolist() == [0, 1, 2, 3, 3]


def test_residuals_of_an_attitude_are_an_angle():
    turns = Rotation.from_rotvec(1e-4 * RNG.normal(size=(3, 3)))
    first = Rotation.random(3, random_state=0)
    x, y = (q.as_quat(scalar_first=True) for q in (first * turns, first))
    wide = Columns(6, (1,))
    pad = lambda q, lead: np.column_stack([lead, q, lead])  # noqa: E731
    off = wide.residual(pad(y, np.zeros(3)), pad(x, np.full(3, 0.5)))
    np.testing.assert_allclose(np.linalg.norm(off[:, 1:5], axis=1), turns.magnitude(), rtol=1e-7)
    np.testing.assert_array_equal(off[:, [0, 5]], 0.5)


def test_the_variance_explained_of_columns_some_of_which_are_constant():
    y = np.column_stack([RNG.normal(size=20), np.full(20, 3.0)])
    r = np.column_stack([0.1 * RNG.normal(size=20), np.zeros(20)])
    due = 1 - (r**2).sum() / (20 * y[:, 0].var())
    np.testing.assert_allclose(explained([y], [r]), due, rtol=1e-13)
    assert np.isnan(explained([y[:, 1:]], [r[:, :1]]))
