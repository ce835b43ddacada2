"""Log-Cholesky coordinates against figures of 50 digits (mpmath) in identification.json."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid
from rbjax.errors import InputError
from rbjax.sysid.parameters import log_cholesky
from rbjax.sysid.parameters.log_cholesky import parameter_jacobian
from tests.composing import check_axes, check_composes
from tests.oracles import load
from tests.tolerances import relative_error

ORACLE = load("identification")["log_cholesky"]
CASES = {k: np.array([c[k] for c in ORACLE["cases"]]) for k in ORACLE["cases"][0]}
EXACT = 1e-12  # rounding of f64, and of the condition number of a pseudo-inertia, below 1e3 here


def phi_of(mass, h, I):
    xx, xy, xz, _, yy, yz, _, _, zz = np.ravel(I)
    return np.array([mass, *h, xx, xy, yy, xz, yz, zz])


PHI = np.stack(list(map(phi_of, CASES["mass"], CASES["h"], CASES["I_origin"])))


def test_coordinates_to_body():
    P = sysid.parameters.from_log_cholesky(CASES["theta"])
    assert relative_error(P, CASES["pseudo_inertia"], batch_dims=1).max() < EXACT
    phi = log_cholesky.log_cholesky_parameters(CASES["theta"])
    assert relative_error(phi, PHI, batch_dims=1).max() < EXACT
    assert (
        relative_error(sysid.parameters.inertial_parameters_of(P), PHI, batch_dims=1).max() < EXACT
    )
    assert relative_error(sysid.parameters.pseudo_inertia_of(PHI), P, batch_dims=1).max() < EXACT
    assert (
        relative_error(sysid.parameters.to_log_cholesky(P), CASES["theta"], batch_dims=1).max()
        < EXACT
    )
    mass, com, inertia = rb.spatial.from_pseudo_inertia(P)
    assert relative_error(mass, CASES["mass"]) < EXACT
    assert relative_error(com, CASES["com"]) < EXACT
    assert relative_error(inertia, CASES["I_com"]) < EXACT


def test_jacobian_and_its_determinant():
    J = np.asarray(parameter_jacobian(CASES["theta"]))
    assert relative_error(J, CASES["jacobian_dphi_dtheta"], batch_dims=1).max() < EXACT
    sign_and_log = np.linalg.slogdet(J)
    np.testing.assert_allclose(np.exp(sign_and_log[1]), CASES["abs_det_jacobian"], rtol=EXACT)


def test_gradient_and_hessian_of_a_scalar():
    scalar = ORACLE["scalar"]
    theta, weights = CASES["theta"][scalar["theta_case"]], np.array(scalar["weights"])

    def f(x):
        return weights @ log_cholesky.log_cholesky_parameters(x)

    value, gradient, hessian = jax.jit(lambda x: (f(x), jax.grad(f)(x), jax.hessian(f)(x)))(theta)
    np.testing.assert_allclose(value, scalar["value"], rtol=EXACT)
    assert relative_error(gradient, scalar["gradient"]) < EXACT
    assert relative_error(hessian, scalar["hessian"]) < EXACT


def test_bodies_to_coordinates():
    for name, body in ORACLE["from_bodies"].items():
        mass, com, inertia = body["mass"], np.array(body["com"]), np.array(body["I_com"])
        P = rb.spatial.pseudo_inertia(mass, com, inertia)
        assert relative_error(P, body["pseudo_inertia"]) < EXACT, name
        theta = sysid.parameters.to_log_cholesky(P)
        assert relative_error(theta, body["theta"]) < EXACT, name
        np.testing.assert_allclose(
            np.linalg.eigvalsh(P)[0], body["smallest_eigenvalue"], rtol=1e-10
        )


def test_a_body_that_cannot_exist_is_an_error_that_says_so():
    P = np.array(ORACLE["not_physical"]["pseudo_inertia"])
    with pytest.raises(InputError, match=r"eigenvalue -0\.00698.*nearest_pseudo_inertia"):
        sysid.parameters.to_log_cholesky(P)
    with pytest.raises(InputError, match="of body 1 "):
        sysid.parameters.to_log_cholesky(np.stack([np.eye(4), P]))
    inside = jax.jit(sysid.parameters.to_log_cholesky)(P)
    assert np.isnan(inside).any()  # a value in traced code
    lifted = sysid.parameters.nearest_pseudo_inertia(P, 1e-4)
    w = np.linalg.eigvalsh(lifted)
    np.testing.assert_allclose(w[0], 1e-4 * w[-1], rtol=1e-9)
    np.testing.assert_allclose(w[1:], np.linalg.eigvalsh(P)[1:], rtol=1e-12)
    assert np.isfinite(sysid.parameters.to_log_cholesky(lifted)).all()
    fine = np.asarray(CASES["pseudo_inertia"])
    np.testing.assert_array_equal(sysid.parameters.nearest_pseudo_inertia(fine), fine)
    with pytest.raises(InputError, match="margin"):
        sysid.parameters.nearest_pseudo_inertia(fine, 0.0)


def test_any_ten_numbers_are_a_body_and_come_back():
    theta = np.random.default_rng(0).normal(size=(200, 10))
    P = np.asarray(sysid.parameters.from_log_cholesky(theta))
    assert (np.linalg.eigvalsh(P)[:, 0] > 0).all()
    # the condition number of P is up to 1e5 here
    assert relative_error(sysid.parameters.to_log_cholesky(P), theta, batch_dims=1).max() < 1e-10


def test_a_model_and_its_parameters():
    model = rb.load("arm7")
    pi = np.asarray(rb.inertial_parameters(model)) * 1.3
    changed = sysid.parameters.with_inertial_parameters(model, pi)
    assert relative_error(rb.inertial_parameters(changed), pi) < EXACT
    theta = log_cholesky.model_log_cholesky(changed)
    phi = log_cholesky.log_cholesky_parameters(theta)
    assert relative_error(phi.reshape(-1), pi) < EXACT
    with pytest.raises(InputError, match=rf"mass of {model.body_names[2]} is -1"):
        sysid.parameters.with_inertial_parameters(model, jnp.asarray(pi).at[20].set(-1.0))
    flat = model.bodies.inertia.at[1].set(jnp.diag(jnp.array([1.0, 1.0, 2.5])))
    with pytest.raises(InputError, match=rf"inertia of {model.body_names[1]} \("):
        log_cholesky.model_log_cholesky(model.replace(bodies=model.bodies.replace(inertia=flat)))


THETA = CASES["theta"][:3]
FUNCTIONS = {
    "from_log_cholesky": (sysid.parameters.from_log_cholesky, [THETA]),
    "to_log_cholesky": (sysid.parameters.to_log_cholesky, [CASES["pseudo_inertia"][:3]]),
    "log_cholesky_parameters": (log_cholesky.log_cholesky_parameters, [THETA]),
    "pseudo_inertia_of": (sysid.parameters.pseudo_inertia_of, [PHI[:3]]),
    "inertial_parameters_of": (
        sysid.parameters.inertial_parameters_of,
        [CASES["pseudo_inertia"][:3]],
    ),
    "nearest_pseudo_inertia": (
        functools.partial(sysid.parameters.nearest_pseudo_inertia, margin=0.3),
        [CASES["pseudo_inertia"][:3]],
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_composes(name):
    function, xs = FUNCTIONS[name]
    check_composes(function, xs)
    check_axes(function, xs)
