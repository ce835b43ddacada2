"""Distances between inertias against figures of 40 digits in identification.json."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import sysid
from rbjax.errors import InputError
from rbjax.sysid.parameters import log_cholesky
from tests.composing import check_axes, check_composes
from tests.oracles import load
from tests.tolerances import relative_error

FIGURES = load("identification")
ORACLE, BODIES = FIGURES["inertia_distances"], FIGURES["log_cholesky"]
P_OF = {f"case{i}": np.array(c["pseudo_inertia"]) for i, c in enumerate(BODIES["cases"])}
P_OF |= {name: np.array(b["pseudo_inertia"]) for name, b in BODIES["from_bodies"].items()}
THETA = np.array([c["theta"] for c in BODIES["cases"]])
EXACT = 1e-12
DISTANCES = {"logdet_divergence": sysid.parameters.log_determinant_divergence}


@pytest.mark.parametrize("name", DISTANCES)
def test_pairs(name):
    P, Q = (np.stack([P_OF[pair[k]] for pair in ORACLE["pairs"]]) for k in "PQ")
    want = np.array([pair[name] for pair in ORACLE["pairs"]])
    found = np.asarray(DISTANCES[name](P, Q))
    np.testing.assert_allclose(found, want, rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("name", DISTANCES)
def test_invariance(name):
    """A change of frame and units changes no distance."""
    G = np.random.default_rng(1).normal(size=(4, 4))
    P, Q = P_OF["case0"], P_OF["case1"]
    before, after = DISTANCES[name](P, Q), DISTANCES[name](G @ P @ G.T, G @ Q @ G.T)
    np.testing.assert_allclose(after, before, rtol=1e-10)


def test_gradient_and_hessian_in_log_cholesky_coordinates():
    def divergence(theta, prior):
        return sysid.parameters.log_determinant_divergence(
            sysid.parameters.from_log_cholesky(theta), prior
        )

    want = ORACLE["gradient_in_theta"]
    found = jax.jit(jax.value_and_grad(divergence))(THETA[0], P_OF["case1"])
    np.testing.assert_allclose(found[0], want["value"], rtol=EXACT)
    assert relative_error(found[1], want["gradient"]) < EXACT
    hessian = jax.jit(jax.hessian(divergence))(THETA[0], P_OF["case0"])
    assert relative_error(hessian, ORACLE["hessian_at_the_prior"]["hessian"]) < EXACT


def test_residual_squares_to_the_divergence():
    r = log_cholesky.prior_residual(THETA[0], THETA[1:])
    want = [
        sysid.parameters.log_determinant_divergence(P_OF["case0"], P_OF[f"case{k}"])
        for k in range(1, 5)
    ]
    assert r.shape == (4, 10)
    np.testing.assert_allclose((r**2).sum(-1), want, rtol=EXACT)
    # Gauss-Newton on it has the exact Hessian at the prior: J^T J = H / 2
    J = jax.jit(jax.jacfwd(log_cholesky.prior_residual))(THETA[0], THETA[0])
    assert relative_error(2 * J.T @ J, ORACLE["hessian_at_the_prior"]["hessian"]) < EXACT


def test_the_scalar_residual_near_nothing_and_far():
    x = np.concatenate([np.geomspace(1e-9, 5.0, 40), -np.geomspace(1e-9, 5.0, 40), [0.0]])
    r = np.asarray(log_cholesky.scalar_residual(jnp.asarray(x)))
    big = np.abs(x) > 1e-3  # the formula itself loses its digits below
    np.testing.assert_allclose((r**2)[big], (np.exp(2 * x) - 1 - 2 * x)[big], rtol=1e-9)
    np.testing.assert_allclose(r[~big], np.sqrt(2) * x[~big] * (1 + x[~big] / 3), rtol=1e-6)
    slopes = jax.vmap(jax.grad(log_cholesky.scalar_residual))(x)
    assert np.isfinite(slopes).all() and (slopes > 0).all()


def test_what_is_no_body_is_an_error():
    bad = np.array(BODIES["not_physical"]["pseudo_inertia"])
    for f in DISTANCES.values():
        with pytest.raises(InputError, match="eigenvalue -0"):
            f(np.eye(4), bad)


FUNCTIONS = {
    "divergence": (sysid.parameters.log_determinant_divergence, "PQ"),
    "residual": (log_cholesky.prior_residual, "theta"),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_composes(name):
    function, kind = FUNCTIONS[name]
    xs = {
        "PQ": [np.stack([P_OF[f"case{k + i}"] for k in range(3)]) for i in (0, 1)],
        "theta": [THETA[:3], THETA[1:4]],
    }[kind]
    check_composes(function, xs)
    check_axes(function, xs)


def test_gradients_at_equal_bodies_are_finite():
    for f in DISTANCES.values():
        slope = jax.grad(lambda x, f=f: f(sysid.parameters.from_log_cholesky(x), P_OF["case0"]))(
            THETA[0]
        )
        assert np.isfinite(slope).all()
