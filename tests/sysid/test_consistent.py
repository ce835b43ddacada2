"""Physically consistent least squares: always bodies; the prior decides only what is open."""

import functools

import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid
from rbjax.errors import InputError
from rbjax.sysid.parameters import log_cholesky
from rbjax.sysid.torque.consistency import _Problem
from rbjax.sysid.torque.torque_equations import equations
from tests.oracles import load
from tests.robots import load_quietly
from tests.sysid.arms import fourier, planar_2R

ORACLE = load("identification")
ARM = ORACLE["fourier_excitation"]
TERMS = ("armature", "viscous", "coulomb", "bias")


def eigenvalues(model):
    pi = rb.inertial_parameters(model).reshape(-1, 10)
    return np.linalg.eigvalsh(sysid.parameters.pseudo_inertia_of(pi))


def other_bodies(model, seed, spread=0.2):
    """The same robot with inertias that are off: by about 20 % of log-Cholesky coordinates."""
    theta = np.asarray(log_cholesky.model_log_cholesky(model))
    off = spread * np.random.default_rng(seed).normal(size=theta.shape)
    off[:, 4:] *= 0.1
    return sysid.parameters.with_inertial_parameters(
        model, log_cholesky.log_cholesky_parameters(theta + off)
    )


@functools.cache
def arm5():
    """The five-joint arm (a CAD model), a true one, and random motions with the true torques."""
    cad = load_quietly(ORACLE["arm_5"]["mjcf"])
    truth = other_bodies(cad, 0)
    truth = truth.replace(joints=truth.joints.replace(armature=1.5 * cad.joints.armature))
    W = np.asarray(
        sysid.torque.regressor(
            cad, *sysid.torque.motions.random_motions(cad, 60), joint_terms=TERMS
        )
    )
    pi = np.array(sysid.torque.parameter_values(truth, TERMS))
    pi[-10:] = [0.3, 0.2, 0.1, 0.4, 0.2, 0.1, -0.1, 0.2, 0.0, -0.3]
    base = sysid.statistics.combinations(W, sysid.torque.parameter_names(cad, TERMS))
    return cad, W, pi, base


def test_without_noise_base_parameters_are_exact_and_the_rest_stays_at_the_prior():
    cad, W, pi, base = arm5()
    found = sysid.torque.consistent(cad, W, W @ pi, joint_terms=TERMS, noise=1e-6, base=base)
    assert found.success and (eigenvalues(found.model) > 0).all()
    beta = base.combine(pi)
    np.testing.assert_allclose(found.beta, beta, rtol=1e-8, atol=1e-9)
    assert np.abs(found.residual).max() < 1e-7
    # what never shows is at the prior, or follows from it
    assert found.values[0] > 0 and found.divergence.max() < 5
    pair = (x.reshape(-1, 10) for x in (pi[:50], rb.inertial_parameters(cad)))
    before = sysid.parameters.log_determinant_divergence(
        *map(sysid.parameters.pseudo_inertia_of, pair)
    )
    # the truth explains the data too: the bodies found are nearer to the prior, in sum
    assert found.divergence.sum() < np.asarray(before).sum()
    np.testing.assert_allclose(
        sysid.torque.parameter_values(found.model, TERMS[:2]), found.values[:60]
    )
    assert (found.values[50:65] > 0).all()


@pytest.mark.slow
def test_the_prior_pulls_only_what_is_open():
    """Of noisy torques: base parameters as those of linear least squares, to a part of their
    errors, the smaller the better the data determine them."""
    cad, W, pi, base = arm5()
    noise = 0.02
    tau = W @ pi + noise * np.random.default_rng(1).normal(size=W.shape[:2])
    found = sysid.torque.consistent(cad, W, tau, joint_terms=TERMS, base=base)
    linear = sysid.torque.regress(W, tau, base.names, base=base)
    assert found.success and (eigenvalues(found.model) > 0).all()
    np.testing.assert_allclose(found.noise[0], noise, rtol=0.25)
    pull = np.abs(found.beta - linear.beta) / linear.errors
    assert np.median(pull) < 0.1 and pull.max() < 0.8
    base_errors = np.sqrt(np.diag(found.base_covariance))
    assert (base_errors < 1.05 * linear.errors).all()  # a prior adds information
    truth = base.combine(pi)
    assert (np.abs(found.beta - truth) / base_errors).max() < 4.5
    # tighter priors pull more
    tight = sysid.torque.consistent(cad, W, tau, joint_terms=TERMS, base=base, spread=0.02)
    assert tight.divergence.sum() < 0.5 * found.divergence.sum()


def test_always_a_body_where_least_squares_gives_none():
    """A poor motion and much noise: linear inertias are impossible ones."""
    cad, _, _, _ = arm5()
    rng = np.random.default_rng(4)
    t = np.linspace(0, 2, 80)[:, None]
    w = np.array([1.0, 1.3, 0.7, 1.9, 2.3])
    q, v, a = 0.3 * np.sin(w * t), 0.3 * w * np.cos(w * t), -0.3 * w**2 * np.sin(w * t)
    W = np.asarray(sysid.torque.regressor(cad, q, v, a))
    tau = W @ np.asarray(rb.inertial_parameters(cad)) + 0.1 * rng.normal(size=v.shape)
    names = sysid.torque.parameter_names(cad)
    linear = sysid.torque.regress(W, tau, names).parameters(rb.inertial_parameters(cad))
    assert np.linalg.eigvalsh(sysid.parameters.pseudo_inertia_of(linear.reshape(-1, 10))).min() < 0
    found = sysid.torque.consistent(cad, W, tau)
    assert found.success and (eigenvalues(found.model) > 0).all() and found.divergence.max() < 3
    rms = np.sqrt((found.residual**2).mean())
    assert rms < 0.11


def test_outliers_by_the_weights_of_a_robust_regression():
    model = planar_2R(ARM)
    q, v, a = fourier(ARM, np.arange(300) / 30)
    W = np.asarray(sysid.torque.regressor(model, q, v, a))
    rng = np.random.default_rng(5)
    pi = np.asarray(rb.inertial_parameters(other_bodies(model, 2)))
    tau = W @ pi + 0.05 * rng.normal(size=(300, 2)) + 30.0 * (rng.uniform(size=(300, 2)) < 0.05)
    names = sysid.torque.parameter_names(model)
    robust = sysid.torque.regress(W, tau, names, method="robust", loss="bisquare")
    noise = np.full((300, 2), np.inf)
    np.divide(robust.noise, np.sqrt(robust.weights), out=noise, where=robust.weights > 0)
    found = sysid.torque.consistent(model, W, tau, noise=noise)
    errors = np.sqrt(np.diag(found.base_covariance))
    assert (np.abs(found.beta - found.combinations.combine(pi)) / errors).max() < 4


def test_the_jacobian_is_exact():
    cad, W, pi, base = arm5()
    eq = equations(W, W @ pi, base.names, base=base, noise=0.1)
    linear = sysid.torque.regression.weighted(eq)
    R = np.linalg.qr((W / 0.1).reshape(-1, len(pi)), mode="r")
    problem = _Problem(cad, TERMS, R, R @ pi, np.asarray(0.5), linear)
    rng = np.random.default_rng(0)
    x = problem.start + 0.1 * rng.normal(size=problem.start.size)
    direction, h = rng.normal(size=x.size), 6e-6
    ends = [problem.residual(x + s * h * direction) for s in (-1, 1)]
    rate = problem.jacobian(x) @ direction
    np.testing.assert_allclose(rate, (ends[1] - ends[0]) / (2 * h), atol=1e-7 * np.abs(rate).max())


@pytest.mark.slow
def test_intervals_hold():
    """95 % of the intervals of 100 experiments with the five-joint arm."""
    cad, W, pi, base = arm5()
    rng, inside = np.random.default_rng(8), []
    for _ in range(100):
        tau = W @ pi + 0.05 * rng.normal(size=W.shape[:2])
        low, up = sysid.torque.consistent(cad, W, tau, joint_terms=TERMS, base=base).intervals().T
        inside.append((low < base.combine(pi)) & (base.combine(pi) < up))
    assert 0.93 < np.mean(inside) < 0.975


def test_a_body_of_the_prior_that_cannot_exist_is_named():
    cad, W, pi, _ = arm5()
    inertia = cad.bodies.inertia.at[2].set(np.diag([1.0, 1.0, 3.0]))
    wrong = cad.replace(bodies=cad.bodies.replace(inertia=inertia))
    with pytest.raises(InputError, match="link3"):
        sysid.torque.consistent(wrong, W, W @ pi, joint_terms=TERMS)
