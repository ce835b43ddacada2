"""Slopes along base parameters only, against slopes along all numbers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sensors import CustomSensor
from rbjax.sysid import Grid, Inertia, Setup, Tilt, Unknown
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation import jacobian_colouring
from rbjax.sysid.simulation.jacobian_colouring import base_unknowns, colour_jacobian
from rbjax.sysid.simulation.runs import Run
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.torque import base_parameters

SOUGHT = {
    "armature": Unknown("joints.armature", positive=True), "bias": Unknown("sensors.q.bias"),
    "upper": Inertia("upper"), "lower": Inertia("lower"),
}  # fmt: skip


@pytest.fixture
def setup(monkeypatch) -> Setup:
    monkeypatch.setattr(jacobian_colouring, "BODIES", 2)
    model = rb.load("double_pendulum")
    return Setup.of(model.replace(joints=model.joints.replace(armature=np.array([0.1, 0.2]))))


@pytest.mark.slow
def test_slopes_along_some_numbers_show_all(setup):
    of, N = Unknowns.of("test", SOUGHT, setup), 12
    rng = np.random.default_rng(0)
    start = rb.State(rng.normal(size=(1, 2)), rng.normal(size=(1, 2)))
    seen = {"q": rng.normal(size=(1, N, 2)), "v": rng.normal(size=(1, N, 2))}
    times = dict.fromkeys("qv", 0.03 * np.arange(N)[None])
    weights = {k: np.full_like(x, 1.5) for k, x in seen.items()}
    run = Run(start, rng.normal(size=(1, N, setup.model.nu)), times, seen, weights)
    run = jax.tree.map(jnp.asarray, run)
    error = SimulationError(setup, of, run, Grid(0.03), estimate_initial_state=True)
    base = base_parameters(setup.model, joint_terms=["armature"])
    assert error.colouring.seeds.shape == (base.rank + 2 + 4, 24 + 4)  # biases and the start too
    x = np.append(of.read(setup), 0.01 * rng.normal(size=4))
    one = jax.tree.map(lambda a: a[0], error.runs)
    whole = jax.jit(
        jax.jacfwd(lambda x: error.programs.compare(*error.programs.simulate(x, one), one))
    )
    want, (r, J) = np.asarray(whole(x)), error.slopes(x)
    np.testing.assert_allclose(J[0], want, atol=1e-10 * np.abs(want).max())
    A, R = np.append(want, r[0][:, None], 1), error.triangle(x)
    assert R.shape == (29, 29)
    np.testing.assert_allclose(R.T @ R, A.T @ A, atol=1e-10 * np.abs(A.T @ A).max())


def test_where_numbers_are_not_known_to_group(setup):
    def of(**more):
        return Unknowns.of("test", SOUGHT | more, setup)

    assert len(base_unknowns(setup, of())[0]) == 9  # 7 base parameters, two biases
    assert base_unknowns(setup, of(gravity=Tilt())) is None
    assert base_unknowns(setup, of(place=Unknown("joints.placement"))) is None
    floating = setup.model.with_forces(
        rb.forces.GravityCompensation(jnp.ones(2), ("upper", "lower"))
    )
    assert base_unknowns(Setup.of(floating), of()) is None
    few = Unknowns.of("test", {"upper": Inertia("upper")}, setup)
    assert base_unknowns(setup, few) is None
    mass = CustomSensor(lambda context: context.model.bodies.mass, 2)  # looks at the bodies itself
    reads = setup.with_sensors({"other:mass": mass})
    assert colour_jacobian(reads, of(), 0, {"q", "other:mass"}) is None
    assert colour_jacobian(reads, of(), 0, {"q"}) is not None
