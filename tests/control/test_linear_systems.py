"""What controls reach, Gramians, discretisation and margins."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import rbjax as rb
from rbjax.control import lqr
from rbjax.control.linear import (
    controllability,
    discretise,
    lyapunov,
    margins,
    observability,
    poles,
)
from rbjax.errors import InputError
from tests.composing import check_composes
from tests.control.problems import random_system
from tests.tolerances import relative_error

reach = jax.jit(controllability)


@pytest.mark.parametrize("inside", [1, 3, 5])
def test_a_hidden_subspace_is_found(inside):
    """Systems in Kalman's form, in turned coordinates; ranks of the classical matrix are right too
    for so few states."""
    rng = np.random.default_rng(inside)
    n, m = 5, 2
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    A[inside:, :inside] = 0
    B[inside:] = 0
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    A, B = turn @ A @ turn.T, turn @ B
    found = reach(jnp.asarray(A), jnp.asarray(B))
    columns = np.concatenate([np.linalg.matrix_power(A, k) @ B for k in range(n)], 1)
    assert found.rank == inside == np.linalg.matrix_rank(columns, 1e-9)
    space = turn[:, :inside]
    assert np.abs(found.inside - space @ space.T).max() < 1e-10
    outside = np.asarray(found.outside)
    assert not outside[:, n - inside :].any()
    assert np.abs(outside.T @ B).max() < 1e-10 and np.abs(outside.T @ A @ space).max() < 1e-10
    seen = jax.jit(observability)(jnp.asarray(A.T), jnp.asarray(B.T))
    assert seen.rank == inside and seen.weakest > 1e-3


def test_missing_directions_have_names():
    """An angle that is read says nothing of the place of the cart."""
    model = rb.load("cart_pole")
    A, B = rb.linearise(model, model.default_state(), jnp.zeros(1))
    whole = controllability(A, B)
    assert whole.rank == 4 and whole.missing(model) == []
    hinge = model.v_slice("hinge").start
    seen = observability(A, np.eye(4)[[hinge]])  # the pole's angle: not where the cart is
    assert seen.missing(model) == ["1.00 position of slider"]
    with pytest.raises(InputError, match="expected"):
        controllability(jnp.eye(2), jnp.eye(2)).missing(model)


def test_gramians_beside_quadrature():
    A, B = np.array([[-1.0, 2.0], [-1.0, -0.5]]), np.array([[0.0], [1.0]])
    t, weight = np.polynomial.legendre.leggauss(60)
    t, weight = 20 * (t + 1), 20 * weight  # to 40 s, when exp(-0.75 t) is 1e-13
    each = np.stack([scipy.linalg.expm(A * s) @ B for s in t])
    W = np.einsum("k,kia,kja->ij", weight, each, each)
    assert relative_error(lyapunov(A, B @ B.T).X, W) < 1e-9
    Ad, Bd = discretise(A, B, 0.1)
    total = sum(np.linalg.matrix_power(Ad, k) @ Bd @ Bd.T @ np.linalg.matrix_power(Ad, k).T
                for k in range(600))  # fmt: skip
    assert relative_error(lyapunov(Ad, Bd @ Bd.T, discrete=True).X, total) < 1e-12


def test_discretisation_beside_scipy():
    A, B, *_ = random_system(0, 4, 2, 3.0)
    Ad, Bd = discretise(A, B, 0.3)
    want = scipy.signal.cont2discrete((A, B, np.eye(4), np.zeros((4, 2))), 0.3)
    assert relative_error(Ad, want[0]) < 1e-13 and relative_error(Bd, want[1]) < 1e-13
    with pytest.raises(InputError, match="positive"):
        discretise(A, B, 0.0)


DOUBLE = jnp.array([[0.0, 1.0], [0.0, 0.0]]), jnp.array([[0.0], [1.0]])
margin = jax.jit(margins)


def test_margins_in_closed_form():
    """l = (sqrt 2 s + 1) / s^2: |l| = 1 at w^2 = 1 + sqrt 2, where it leads -1 by atan sqrt 2 w."""
    found = margin(*DOUBLE, jnp.array([[1.0, math.sqrt(2)]]))
    w = math.sqrt(1 + math.sqrt(2))
    phase = math.atan(math.sqrt(2) * w)
    assert found.stable and math.isclose(found.phase[0], phase, rel_tol=1e-10)
    assert math.isclose(found.delay[0], phase / w, rel_tol=1e-10)
    assert found.gain_up[0] == np.inf and found.gain_down[0] < 1e-12
    assert not margin(*DOUBLE, jnp.array([[1.0, -1.0]])).stable


@pytest.mark.slow
def test_margins_of_a_mode_that_grows():
    # l = g / (s - 1): stable for g > 1; g = 4: |l| = 1 at w = sqrt 15, 180 - atan w behind
    found = margin(jnp.ones((1, 1)), jnp.ones((1, 1)), jnp.full((1, 1), 4.0))
    assert math.isclose(found.gain_down[0], 0.25, rel_tol=1e-10)
    assert math.isclose(found.phase[0], math.atan(math.sqrt(15)), rel_tol=1e-10)


@pytest.mark.slow
def test_margins_are_where_the_loop_becomes_unstable():
    """In discrete time, by eigenvalues of loops with more and with less gain."""
    A, B, Q, R, S = random_system(3, 3, 2, 1.5)
    del S
    K = np.asarray(lqr(A, B, Q, R, discrete=True).K)
    found = jax.jit(lambda A, B, K: margins(A, B, K, 0.1))(*map(jnp.asarray, (A, B, K)))

    def radius(i, gain):
        G = np.eye(2)
        G[i, i] = gain
        return np.abs(np.linalg.eigvals(A - B @ G @ K)).max()

    assert found.stable
    for i in range(2):
        for gain, side in ((found.gain_up[i], 1), (found.gain_down[i], -1)):
            if np.isfinite(gain) and gain > 0:
                assert radius(i, float(gain) * (1 + side * 1e-6)) > 1
                assert radius(i, float(gain) * (1 - side * 1e-6)) < 1
            else:
                assert radius(i, 1e4 if side > 0 else 0.0) < 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_regulator_has_the_margins_that_are_known(seed):
    """Safonov & Athans: 1/2 to infinity, and 60 degrees, for a diagonal R."""
    A, B, Q, *_ = random_system(seed, 3, 2, 3.0)
    K = lqr(A, B, Q, np.eye(2)).K
    found = margin(jnp.asarray(A), jnp.asarray(B), K)
    assert found.stable and (found.gain_down <= 0.5).all() and np.isinf(found.gain_up).all()
    assert (found.phase >= math.pi / 3 - 1e-9).all()


def test_poles_by_falling_real_part():
    A, B, *_ = random_system(0, 3, 2)
    rates = poles(A, B, np.zeros((2, 3)))
    assert (np.diff(rates.real) <= 1e-15).all()
    for rate in np.linalg.eigvals(A):
        assert np.abs(rates - rate).min() < 1e-12
    slope = jax.jacfwd(lambda a: poles(a * jnp.diag(jnp.array([1.0, 2.0, 3.0]))).real)(1.0)
    np.testing.assert_allclose(slope, [3.0, 2.0, 1.0], rtol=1e-12)


@pytest.mark.slow
def test_discretisation_composes():
    systems = [random_system(k, 3, 2)[:2] for k in range(3)]
    xs = [np.stack(x) for x in zip(*systems, strict=True)]
    check_composes(lambda A, B: discretise(A, B, 0.2), xs)
