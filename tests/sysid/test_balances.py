"""Balances of momentum and energy: identities, and parameters from motions without acceleration."""

import functools

import jax
import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid
from rbjax.errors import InputError
from tests.composing import check_axes, check_composes
from tests.oracles import load
from tests.robots import robot
from tests.sysid.arms import fourier, planar_2R
from tests.tolerances import relative_error

EXACT = 1e-12
TERMS = ("armature", "viscous", "coulomb", "bias")
ARM = load("identification")["fourier_excitation"]


@pytest.mark.parametrize("name", ["small", pytest.param("tree:3", marks=pytest.mark.slow)])
def test_momentum_and_energy_of_a_state(name):
    model = robot(name).model
    q, v, _ = (x[0] for x in sysid.random_motions(model, 1))
    pi, J = rb.inertial_parameters(model), model.joints.armature
    p = rb.mass_matrix(model, q) @ v - J * v
    assert relative_error(sysid.momentum_regressor(model, q, v) @ pi, p) < EXACT
    rest = sysid.energy_regressor(model, q, 0 * v) @ pi
    found = sysid.energy_regressor(model, q, v) @ pi - rest
    np.testing.assert_allclose(found, rb.kinetic_energy(model, q, v) - J @ v**2 / 2, rtol=1e-11)
    other = sysid.random_motions(model, 1, seed=4)[0][0]
    change = sysid.energy_regressor(model, other, 0 * v) @ pi - rest
    U = [rb.potential_energy(model, x) for x in (other, q)]
    np.testing.assert_allclose(change, U[0] - U[1], rtol=1e-11)


@functools.cache
def joints_and_torques():
    """The 2R arm with friction on the oracle's excitation: t, q, v, torques, parameters, names."""
    model = planar_2R(ARM)
    t = np.arange(2001) * 0.005
    q, v, a = fourier(ARM, t)
    W = np.asarray(sysid.observation_matrix(model, q, v, a, joint_terms=TERMS, smoothing=0.2))
    pi = np.concatenate(
        [rb.inertial_parameters(model), [0.1, 0.05], [0.4, 0.3], [0.6, 0.2], [0.1, -0.2]]
    )
    return model, t, q, v, W @ pi, pi, sysid.parameter_names(model, TERMS)


BALANCES = {"momentum": sysid.momentum_balance, "energy": sysid.energy_balance}


@pytest.mark.parametrize("kind", BALANCES)
def test_parameters_without_acceleration(kind):
    model, t, q, v, tau, pi, names = joints_and_torques()
    W, y = BALANCES[kind](model, t, q, v, tau, window=20, joint_terms=TERMS, smoothing=0.2)
    rows = 2 if kind == "momentum" else 1
    assert W.shape == (100, rows, len(names)) and y.shape == (100, rows)
    # Simpson at 5 ms over motions of up to 3 rad/s^4: 1e-9 of what a window sums
    np.testing.assert_allclose(W @ pi, y, atol=1e-7 * np.abs(y).max())
    base = sysid.base_parameters(model, joint_terms=TERMS, smoothing=0.2)
    found = sysid.regress(W, y, names, base=base)
    np.testing.assert_allclose(found.beta, base.combine(pi), rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_torques_that_are_held():
    """A rollout with held torques: impulses are exact, work is the torque times the distance."""
    model = planar_2R(ARM)
    rng = np.random.default_rng(0)
    dt, substeps, n = 0.02, 20, 60
    tau = rng.normal(size=(n, 2)) * [12.0, 4.0]
    fine = np.repeat(tau, substeps, 0)
    state = rb.State(np.array([-1.5, 0.2]), np.zeros(2))
    run = jax.jit(lambda s, u: rb.rollout(model, s, tau=u, dt=dt / substeps, integrator="rk4"))
    path = run(state, fine)
    q, v = (np.asarray(x)[::2] for x in (path.q, path.v))
    t, torque = np.arange(len(q)) * 2 * dt / substeps, np.repeat(tau, substeps // 2, 0)
    torque = np.concatenate([torque, torque[-1:]])
    pi = np.asarray(rb.inertial_parameters(model))
    for kind, balance in BALANCES.items():
        W, y = balance(model, t, q, v, torque, window=substeps // 2, held=True)
        # Simpson's error where the acceleration jumps: h^2 of the jumps, h = 2 ms
        assert np.abs((W @ pi).reshape(y.shape) - y).max() < 2e-4 * np.abs(y).max(), kind
        W, y = balance(model, t, q, v, torque, window=substeps // 2)
        assert np.abs((W @ pi).reshape(y.shape) - y).max() > 1e-2 * np.abs(y).max(), kind


@pytest.mark.slow
def test_a_free_fall_with_a_ball_joint():
    """No torque acts: momentum changes by M' v - C v - g only, and energy stays."""
    model = robot("small").model
    none = np.zeros_like(model.joints.stiffness), np.zeros_like(model.joints.damping)
    model = model.replace(joints=model.joints.replace(stiffness=none[0], damping=none[1]))
    q, v = (x[0] for x in robot("small").states(1))
    path = rb.rollout(model, rb.State(q, v), tau=np.zeros((400, 5)), dt=1e-3, integrator="rk4")
    t, pi = np.arange(401) * 1e-3, sysid.parameter_values(model, ["armature"])
    for kind, balance in BALANCES.items():
        W, y = balance(
            model, t, path.q, path.v, 0 * path.v, window=40, joint_terms=["armature"]
        )  # fmt: skip
        size = np.abs(W * np.asarray(pi)).max()
        # Simpson at 1 ms
        assert np.abs(y).max() == 0 and np.abs(W @ np.asarray(pi)).max() < 1e-7 * size, kind


def test_velocity_noise_hurts_less_than_differences():
    """Momentum against torques with differenced velocity, the same noisy data."""
    model, t, q, v, tau, pi, names = joints_and_torques()
    rng = np.random.default_rng(1)
    seen = v + 0.01 * rng.normal(size=v.shape)
    base = sysid.base_parameters(model, joint_terms=TERMS, smoothing=0.2)
    how = {"joint_terms": TERMS, "smoothing": 0.2}
    W, y = sysid.momentum_balance(model, t, q, seen, tau, window=40, **how)
    by_momentum = sysid.regress(W, y, names, base=base)
    differences = np.gradient(seen, t, axis=0)
    W = np.asarray(sysid.observation_matrix(model, q, seen, differences, **how))
    by_torque = sysid.regress(W, tau, names, base=base)
    error = [np.abs(x.beta - base.combine(pi)).max() for x in (by_momentum, by_torque)]
    assert error[0] < 0.2 * error[1], error


def test_bad_arguments():
    model = rb.load("pendulum")
    z, t = np.zeros((5, 1)), np.arange(5.0)
    for balance in BALANCES.values():
        with pytest.raises(InputError, match=r"t\[2\] = 1 follows 1"):
            balance(model, [0.0, 1.0, 1.0, 2.0, 3.0], z, z, z, window=2)
        with pytest.raises(InputError, match="window = 5"):
            balance(model, t, z, z, z, window=5)
        with pytest.raises(InputError, match=r"tau has shape \(4, 1\)"):
            balance(model, t, z, z, z[1:], window=2)


@pytest.mark.parametrize(  # the energy's has the momentum's inside
    "f",
    [pytest.param(sysid.momentum_regressor, marks=pytest.mark.slow), sysid.energy_regressor],
)
def test_composes(f):
    model = robot("free_body").model
    function = functools.partial(f, model)
    xs = list(sysid.random_motions(model, 3)[:2])
    check_composes(function, xs)
    check_axes(function, xs)
    assert jax.eval_shape(function, *(x[0] for x in xs)).shape[-1] == 10 * model.nb
