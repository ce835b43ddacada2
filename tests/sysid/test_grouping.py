"""Slopes along base parameters only, against slopes along all numbers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sensors import CustomSensor
from rbjax.sysid import Grid, Inertia, Setup, Tilt, Unknown
from rbjax.sysid.parameters.unknowns import Unknowns
from rbjax.sysid.simulation import grouping
from rbjax.sysid.simulation.grouping import grouped
from rbjax.sysid.simulation.islands import directions
from rbjax.sysid.simulation.runs import Run
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.torque import base_parameters

SOUGHT = {
    "armature": Unknown("joints.armature", positive=True), "bias": Unknown("sensors.q.bias"),
    "upper": Inertia("upper"), "lower": Inertia("lower"),
}  # fmt: skip


@pytest.fixture
def setup(monkeypatch) -> Setup:
    monkeypatch.setattr(grouping, "BODIES", 2)
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
    error = SimulationError(setup, of, run, Grid(0.03), starts=True)
    base = base_parameters(setup.model, joint_terms=["armature"])
    assert error.directions.seeds.shape == (base.rank + 2 + 4, 24 + 4)  # biases and the start too
    x = np.append(of.read(setup), 0.01 * rng.normal(size=4))
    one = jax.tree.map(lambda a: a[0], error.runs)
    whole = jax.jit(
        jax.jacfwd(lambda x: error.programs.compared(*error.programs.path(x, one), one))
    )
    want, (r, J) = np.asarray(whole(x)), error.slopes(x)
    np.testing.assert_allclose(J[0], want, atol=1e-10 * np.abs(want).max())
    A, R = np.append(want, r[0][:, None], 1), error.triangle(x)
    assert R.shape == (29, 29)
    np.testing.assert_allclose(R.T @ R, A.T @ A, atol=1e-10 * np.abs(A.T @ A).max())


def test_where_numbers_are_not_known_to_group(setup):
    def of(**more):
        return Unknowns.of("test", SOUGHT | more, setup)

    assert len(grouped(setup, of()).kept) == 9  # 7 base parameters, two biases
    assert grouped(setup, of(gravity=Tilt())) is None
    assert grouped(setup, of(place=Unknown("joints.placement"))) is None
    floating = setup.model.with_forces(
        rb.forces.GravityCompensation(jnp.ones(2), ("upper", "lower"))
    )
    assert grouped(Setup.of(floating), of()) is None
    few = Unknowns.of("test", {"upper": Inertia("upper")}, setup)
    assert grouped(setup, few) is None
    mass = CustomSensor(lambda context: context.model.bodies.mass, 2)  # looks at the bodies itself
    reads = setup.with_sensors({"other:mass": mass})
    assert directions(reads, of(), 0, {"q", "other:mass"}) is None
    assert directions(reads, of(), 0, {"q"}) is not None
