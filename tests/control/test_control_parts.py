"""Parts of control by closed forms of a few numbers."""

import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import rbjax as rb
from rbjax import control
from rbjax.control.laws.controller import check_poses, gains
from rbjax.control.laws.frame_laws import _matrix
from rbjax.control.linear.algebraic_riccati import Double, _cost_to_go_by_doubling, remainder
from rbjax.control.linear.parallel_riccati import Stretch, join
from rbjax.control.linear.systems import _reach
from rbjax.control.optimal.collocation.barrier import PUSH, push_inside
from rbjax.control.optimal.derivatives.implicit import _may_close_over_tracers
from rbjax.control.optimal.objective import shifted_excess
from rbjax.control.optimal.registry import METHODS
from rbjax.control.optimal.shooting.expansion import _second_order_in
from rbjax.control.optimal.terms import _name

RNG = np.random.default_rng(0)
A, Q = RNG.normal(size=(3, 3)), np.diag([1.0, 2.0, 3.0])
B, R, S = RNG.normal(size=(3, 2)), np.diag([0.5, 0.7]), np.zeros((3, 2))


@pytest.mark.parametrize("discrete", [True, False])
def test_the_remainder_of_riccatis_equation(discrete):
    """A'PA - P + Q - A'PB (R + B'PB)^-1 B'PA, or A'P + PA + Q - PB R^-1 B'P, for any P."""
    P = RNG.normal(size=(3, 3))
    P = P @ P.T
    found, size = jax.jit(lambda *z: remainder(discrete, z[:5], z[5]))(A, B, Q, R, S, P)
    H, G = (R + B.T @ P @ B, B.T @ P @ A) if discrete else (R, B.T @ P)
    linear = A.T @ P @ A - P if discrete else A.T @ P + P @ A
    due = linear + Q - G.T @ np.linalg.solve(H, G)
    np.testing.assert_allclose(found, due, rtol=0, atol=1e-12 * size)


def test_doubling_begins_with_the_continuous_problem():
    found = jax.jit(lambda *z: _cost_to_go_by_doubling(False, z))(A, B, Q, R, S)
    np.testing.assert_allclose(found, scipy.linalg.solve_continuous_are(A, B, Q, R), rtol=1e-8)


def test_joined_stretches_have_the_sum_of_their_costs():
    """J = F1' J2 (1 + C1 J2)^-1 F1 + J1."""
    F1, C1, J1, J2 = RNG.normal(size=(4, 2, 2))
    C1, J1, J2 = C1 @ C1.T, J1 @ J1.T, J2 @ J2.T
    none, one = np.zeros(2), np.eye(2)
    found = jax.jit(join)(Stretch(F1, none, C1, none, J1), Stretch(one, none, one, none, J2))
    due = F1.T @ J2 @ np.linalg.inv(one + C1 @ J2) @ F1 + J1
    np.testing.assert_allclose(found.J, due, rtol=1e-12)


@pytest.mark.parametrize("parallel", [False, True])
def test_gains_of_one_step(parallel):
    """K = (R + B'PB)^-1 B'PA with P = Q at the end; P = Q + A'PA - K'(R + B'PB) K before."""
    problem = control.linear.LinearQuadratic.constant(A, B, Q, R, 1)
    found = jax.jit(functools.partial(control.linear.backward, parallel=parallel))(problem)
    H, G = R + B.T @ Q @ B, B.T @ Q @ A
    np.testing.assert_allclose(found.K[0], np.linalg.solve(H, G), rtol=1e-12)
    np.testing.assert_allclose(found.P[1], Q, rtol=1e-15)
    np.testing.assert_allclose(found.P[0], Q + A.T @ Q @ A - G.T @ found.K[0], rtol=1e-10)


def test_reach_is_weakest_relative_to_the_norm_of_the_system():
    """A e2 = (1, 1) of a matrix with norm 2: half of it leads out of e2."""
    found = jax.jit(lambda A, B: _reach(A, B, None))(np.ones((2, 2)), np.array([[0.0], [1.0]]))
    assert int(found.rank) == 2
    np.testing.assert_allclose(found.weakest, 0.5, rtol=1e-12)


def test_a_product_of_two_numbers_each_of_matrices_that_are_not_square():
    a, b = RNG.normal(size=(2, 5)), RNG.normal(size=(5, 3))
    found = jax.jit(lambda a, b: Double.of(a) @ Double.of(b))(a, b)
    for i in range(2):
        for j in range(3):
            due = sum(Fraction(x) * Fraction(y) for x, y in zip(a[i], b[:, j], strict=True))
            off = Fraction(float(found.hi[i, j])) + Fraction(float(found.lo[i, j])) - due
            assert abs(off) < 1e-23


def test_penalised_rows_vanish_within_their_limits():
    c, y, mu = np.array([-3.0, 0.5, 4.0]), np.array([0.2, -0.1, 0.6]), 2.0
    s = c + y / mu
    due = np.sqrt(mu) * np.array([s[0] + 1.0, 0.0, s[2] - 2.0])
    found = jnp.sqrt(mu) * shifted_excess(c, y, mu, -1.0, 2.0)
    np.testing.assert_allclose(found, due, rtol=1e-14)


def test_a_point_is_pushed_into_its_bounds():
    """By the push relative to the bound, at most that of the width; not where it is inside."""
    low = np.array([-np.inf, -50.0, -np.inf, 1.0, -1.0])
    high = np.array([100.0, np.inf, 0.5, 1.5, 1.0])
    found = push_inside(np.array([200.0, -60.0, 3.0, 0.0, 0.25]), low, high)
    due = [100 - 100 * PUSH, -50 + 50 * PUSH, 0.5 - PUSH, 1 + 0.5 * PUSH, 0.25]
    np.testing.assert_allclose(found, due, rtol=1e-14)


def test_a_cost_of_weighted_residuals():
    """r'r / 2 with J'r and J'J, of linear residuals."""
    J, r = RNG.normal(size=(2, 3)), RNG.normal(size=2)

    def f(x):
        return jnp.asarray(J) @ x + r

    value, slope, H = jax.jit(lambda x, e: _second_order_in(f, x, e))(np.zeros(3), np.eye(3))
    np.testing.assert_allclose(value, r @ r / 2, rtol=1e-14)
    np.testing.assert_allclose(slope, J.T @ r, rtol=1e-12)
    np.testing.assert_allclose(H, J.T @ J, rtol=1e-12)


def test_gains_and_references_of_laws():
    np.testing.assert_array_equal(gains("f", "K", 3.0, 2), [3.0, 3.0])
    np.testing.assert_array_equal(gains("f", "K", [0.0, 2.0], 2), [0.0, 2.0])
    with pytest.raises(rb.InputError, match=r"f: K is -1\.0"):
        gains("f", "K", -1.0, 2)
    full = np.array([[2.0, 0.3], [0.3, 1.0]])
    np.testing.assert_array_equal(_matrix("f", "K", full, 2), full)
    np.testing.assert_array_equal(_matrix("f", "K", [2.0, 1.0], 2), np.diag([2.0, 1.0]))
    p, turn = np.array([1.0, 2.0, 3.0]), np.eye(3)[[1, 2, 0]]
    np.testing.assert_array_equal(check_poses("f", p, ("position",)), p)
    np.testing.assert_array_equal(check_poses("f", turn, ("rotation",)), turn)
    pose = check_poses("f", (turn, p), ("rotation", "position"))
    np.testing.assert_array_equal(pose[0], turn)
    np.testing.assert_array_equal(pose[1], p)


def test_a_posture_is_damped_critically():
    model = rb.load("arm7")
    of = {"site": "tool", "task": "position", "stiffness": 100.0}
    law = control.operational_space(model, [0.4, 0.0, 0.5], posture_stiffness=9.0, **of)
    np.testing.assert_allclose(law.posture_damping, np.full(7, 6.0), rtol=1e-15)
    with pytest.raises(rb.InputError, match=r"body=3\.0, expected a name"):
        control.operational_space(model, [0.4, 0.0, 0.5], body=3.0, task="position", stiffness=1.0)
    control.gravity_compensation(model, wrenches=np.zeros((model.nb, 6)))


def test_equations_are_a_vector_space():
    system = control.Equations(lambda t, x, u: -x, 2, 1)
    x, dx = jnp.array([1.0, 2.0]), jnp.array([0.5, -3.0])
    np.testing.assert_array_equal(system.plus(x, dx), [1.5, -1.0])
    np.testing.assert_array_equal(system.minus(system.plus(x, dx), x), dx)


def test_functions_that_may_read_tracers():
    inner = 3.0
    assert _may_close_over_tracers(lambda x: inner * x)
    assert _may_close_over_tracers(lambda x, k=2.0: k * x)
    assert not _may_close_over_tracers(lambda x: x)
    assert not _may_close_over_tracers(None)
    assert (_name(np.sin), _name(control.HalfSpace([0.0, 0.0, 1.0]))) == ("sin", "HalfSpace")


def test_methods_that_need_derivatives():
    without = {name for name, method in METHODS.items() if not method.derivatives}
    assert without == {"predictive", "mppi", "cross_entropy"}


def test_a_clearance_has_no_margin_unless_given():
    floor = control.HalfSpace([0.0, 0.0, 1.0])
    assert float(control.Clearance(floor, "tool").margin) == 0.0
    assert float(control.Clearance(floor, "tool", margin=0.2).margin) == 0.2
