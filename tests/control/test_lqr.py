"""Regulators of infinite horizon beside SciPy, closed forms, and in a motion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import rbjax as rb
from rbjax.control import LinearStatus, feedback, lqr, lqr_at
from rbjax.control.linear import poles
from rbjax.errors import InputError
from tests.composing import STEP, check_composes
from tests.control.problems import enlarged, random_system
from tests.oracles import load
from tests.tolerances import GRADIENT, relative_error

are = {False: scipy.linalg.solve_continuous_are, True: scipy.linalg.solve_discrete_are}


solved = jax.jit(lqr)  # the numbers are not looked at


def is_(result, name):
    return bool(result == getattr(LinearStatus, name))


def polished(P, A, B, Q, R, S, discrete):
    """SciPy's P, by Newton's method with residuals of 64 bits of mantissa."""
    wide = [np.asarray(x, np.longdouble) for x in (A, B, Q, R, S)]
    P = np.asarray(P, np.longdouble)
    for _ in range(4):
        A, B, Q, R, S = wide
        H = R + B.T @ P @ B if discrete else R
        G = (B.T @ P @ A if discrete else B.T @ P) + S.T
        K = np.linalg.solve(H.astype(float), G.astype(float)).astype(np.longdouble)
        for _ in range(3):
            K += np.linalg.solve(H.astype(float), (G - H @ K).astype(float))
        off = (A.T @ P @ A - P if discrete else A.T @ P + P @ A) + Q - G.T @ K
        closed = (A - B @ K).astype(float).T
        if discrete:
            P = P + scipy.linalg.solve_discrete_lyapunov(closed, off.astype(float))
        else:
            P = P + scipy.linalg.solve_continuous_lyapunov(closed, -off.astype(float))
        P = (P + P.T) / 2
    return P.astype(float)


SIZES = [(3, 2), *(pytest.param(*s, marks=pytest.mark.slow) for s in ((6, 2), (12, 6), (24, 4)))]


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("n, m", SIZES)
def test_random_systems_beside_scipy(n, m, discrete):
    """Stable and unstable ones, with products of states and controls. SciPy is up to 6e-11 off."""
    worst = 0.0
    for seed, scale in enumerate([0.5, 0.9, 1.0, 1.5, 2.0, 3.0]):
        A, B, Q, R, S = random_system(seed, n, m, scale)
        found = lqr(A, B, Q, R, S, discrete=discrete)
        scipys = are[discrete](A, B, Q, R, s=S)
        truth = polished(scipys, A, B, Q, R, S, discrete)
        error = relative_error(found.P, truth)
        worst = max(worst, float(error))
        assert is_(found.status, "success") and found.residual < n * 2e-15
        of_truth = 5e-4 * relative_error(scipys, truth)  # long double has 11 bits more
        assert error <= found.error + of_truth  # as near as it says
        rates = np.linalg.eigvals(A - B @ np.asarray(found.K))
        assert (np.abs(rates).max() < 1) if discrete else (rates.real.max() < 0)
    assert worst < 1e-14


CASES = {  # what SciPy solves
    "a mode that grows and costs nothing": ([[2.0]], [[1.0]], [[0.0]], [[1.0]], 1e-14),
    "scales of 1e6": (np.diag([1e3, 1e-3, 1.0]), [[1e-3], [1e3], [1.0]],
                      np.diag([1e6, 1e-6, 1.0]), [[1e-6]], 1e-11),
    "hardly within reach": (np.diag([1.1, -0.5]), [[1e-5], [1.0]], np.eye(2), [[1.0]], 1e-6),
    "no control": (np.diag([-0.3, 0.5]), [[0.0], [1.0]], np.eye(2), [[1.0]], 1e-13),
    "an integrator": (np.zeros((1, 1)), [[1.0]], [[5.0]], [[1.0]], 1e-14),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:An ill-conditioned matrix")  # of SciPy's Lyapunov equations
@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_hard_systems_beside_scipy(name, discrete):
    *system, tolerance = CASES[name]
    A, B, Q, R = enlarged(*system)
    found = lqr(A, B, Q, R, discrete=discrete)
    want = polished(are[discrete](A, B, Q, R), A, B, Q, R, 0 * B, discrete)
    assert is_(found.status, "success")
    assert relative_error(found.P, want) < tolerance


def test_hard_systems_of_one_kind_only():
    A, B, Q, R = enlarged([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], np.eye(2), [[0.0]])
    found = lqr(A, B, Q, R, discrete=True)  # no cost of a control
    want = scipy.linalg.solve_discrete_are(A, B, Q, R)
    assert is_(found.status, "success") and relative_error(found.P, want) < 1e-12
    found = lqr(*enlarged([[-3.0]], [[1.0]], [[-5.0]], [[1.0]]))  # a cost below zero, but bounded
    assert is_(found.status, "success") and abs(found.P[0, 0] + 1) < 1e-13


@pytest.mark.parametrize(
    "result, A, B, Q, R, kinds",
    [
        ("not_stabilisable", np.diag([2.0, -0.5]), [[0.0], [1.0]], np.eye(2), [[1.0]], "cd"),
        ("not_stabilisable", np.diag([0.0, -0.5]), [[0.0], [1.0]], np.eye(2), [[1.0]], "c"),
        ("not_stabilisable", np.diag([1.0, -0.5]), [[0.0], [1.0]], np.eye(2), [[1.0]], "d"),
        ("no_stabilising_solution", np.diag([0, -1]), [[1], [1]], np.diag([0, 1]), [[1]], "c"),
        ("no_stabilising_solution", np.diag([1, 0.5]), [[1], [1]], np.diag([0, 1]), [[1]], "d"),
        ("no_stabilising_solution", [[1.0]], [[1.0]], [[-5.0]], [[1.0]], "cd"),
        ("indefinite_control_cost", [[0.5]], [[1.0]], [[1.0]], [[0.0]], "c"),
        ("indefinite_control_cost", [[0.5]], [[1.0]], [[1.0]], [[-9.0]], "cd"),
    ],
)
def test_bad_problems_have_named_results(result, A, B, Q, R, kinds):
    for kind in kinds:
        given = enlarged(A, B, Q, R)
        with pytest.raises(InputError, match="lqr: "):
            lqr(*given, discrete=kind == "d")
        found = jax.jit(functools.partial(lqr, discrete=kind == "d"))(*map(jnp.asarray, given))
        assert is_(found.status, result), found.status
        assert not found.K.any() and not found.P.any() and not np.isnan(found.residual)


def test_numbers_that_are_not_finite_within_a_program():
    with pytest.raises(InputError, match=r"lqr: A\[0, 0\] is nan"):
        lqr([[np.nan]], [[1.0]], [1.0], [1.0])
    _, B, Q, R = map(jnp.asarray, enlarged([[1.0]], [[1.0]], [[1.0]], [[1.0]]))
    found = solved(jnp.full((3, 3), jnp.nan), B, Q, R)
    assert is_(found.status, "not_finite") and not found.P.any()
    with pytest.raises(InputError, match=r"B has shape \(2, 0\), expected \(2, m\)"):
        lqr(np.eye(2), np.zeros((2, 0)), np.eye(2), np.zeros((0, 0)))
    with pytest.raises(InputError, match="vmap"):
        lqr(np.zeros((3, 2, 2)), np.zeros((3, 2, 1)), np.eye(2), np.eye(1))


def test_closed_forms():
    o = load("linear_quadratic")["lqr_discrete"]
    A, B, Q = (np.array(o[k]) for k in ("A", "B", "Q"))
    found = lqr(A, B, Q, np.reshape(o["R"], (1, 1)), discrete=True)
    assert relative_error(found.P, o["dare_P"]) < 1e-13
    assert relative_error(found.K[0], o["dare_K"]) < 1e-13
    found = lqr([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [1.0, 0.0], [1.0])
    s = np.sqrt(2)
    assert relative_error(found.P, [[s, 1], [1, s]]) < 1e-14
    assert relative_error(found.K, [[1, s]]) < 1e-14
    rates = poles([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], found.K)
    np.testing.assert_allclose(np.sort_complex(rates), np.array([-1 - 1j, -1 + 1j]) / s, rtol=1e-13)


def symmetric(W):
    return (W + W.T) / 2


@pytest.mark.slow
@pytest.mark.parametrize("discrete", [False, True])
def test_the_solution_composes(discrete):
    """By the implicit function theorem, in both modes, and mapped over a batch."""
    systems = [random_system(k, 3, 2) for k in range(3)]
    xs = [np.stack(x) for x in zip(*systems, strict=True)]

    def solved(A, B, Q, R, S):  # the differences are those of matrices that are not symmetric
        return lqr(A, B, symmetric(Q), symmetric(R), S, discrete=discrete)[:2]

    check_composes(solved, xs)


@pytest.mark.parametrize("discrete", [False, True])
def test_slopes_against_differences(discrete):
    """Of the gains by all matrices at once, by the implicit function theorem."""
    system = [jnp.asarray(x) for x in random_system(7, 3, 2)]
    rng = np.random.default_rng(8)
    along = [jnp.asarray(rng.normal(size=x.shape)) for x in system]

    def gains(A, B, Q, R, S):
        return lqr(A, B, symmetric(Q), symmetric(R), S, discrete=discrete).K

    slope = jax.jvp(gains, system, along)[1]
    ends = [gains(*(x + h * d for x, d in zip(system, along, strict=True))) for h in (-STEP, STEP)]
    assert relative_error(slope, (ends[1] - ends[0]) / (2 * STEP), floor=1.0) < GRADIENT


@pytest.mark.slow
def test_a_failure_in_a_batch_leaves_the_gradient_finite():
    B = jnp.array([[0.0], [1.0]])

    def total(a, b):
        A = jnp.stack([jnp.diag(jnp.array([1.0, 0.0])), jnp.diag(jnp.array([-1.0, 0.0]))]) * a
        found = jax.vmap(lambda A: lqr(A, b * B, jnp.eye(2), jnp.eye(1)))(A)
        return found.P.sum(), found.status == LinearStatus.success

    slope, ok = jax.jit(jax.grad(total, has_aux=True))(1.0, 1.0)
    assert ok.tolist() == [False, True] and np.isfinite(slope) and slope != 0


def test_a_model_is_held_upright():
    """A cart-pole, in discrete time, as it is driven."""
    model = rb.load("cart_pole")
    up = rb.State(jnp.array([0.0, jnp.pi]), jnp.zeros(2))
    Q = np.array([1.0, 1.0, 0.1, 0.1])
    found = lqr_at(model, up, jnp.zeros(1), Q, np.ones(1), dt=0.02)
    A, B = rb.linearise(model, up, jnp.zeros(1), 0.02)
    want = scipy.linalg.solve_discrete_are(A, B, np.diag(Q), np.eye(1))
    assert is_(found.status, "success") and relative_error(found.P, want) < 1e-11
    off = up.replace(q=up.q + jnp.array([0.3, 0.2]))
    path = rb.rollout(model, off, feedback(model, up, jnp.zeros(1), found.K), 0.02, steps=500)
    assert np.abs(path.q[-1] - up.q).max() < 0.03 * np.abs(off.q - up.q).max()


@pytest.mark.slow
def test_a_model_is_held_on_the_tangent_space():
    """A quadrotor, turned and thrown off its place, comes back."""
    model = rb.load("quadrotor")
    state = model.default_state()
    weight = float(model.bodies.mass.sum()) * 9.81
    ctrl = jnp.full(model.nu, weight / model.nu)
    dt = 0.02
    found = lqr_at(model, state, ctrl, jnp.ones(12), jnp.ones(model.nu), dt=dt)
    assert is_(found.status, "success")
    off = jnp.array([0.3, -0.2, 0.4, 0.5, -0.4, 0.6])
    q = rb.integrate(model, state.q, off)
    law = feedback(model, state, ctrl, found.K)
    path = rb.rollout(model, rb.State(q, 0.3 * jnp.ones(6)), law, dt, steps=600)
    start, end = (np.abs(rb.difference(model, state.q, path.q[k])).max() for k in (0, -1))
    assert end < 1e-3 * start
