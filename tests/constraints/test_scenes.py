"""Bundled scenes with loops: closed as drawn, the textbook's mobility, no energy lost."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.equations.constrained_motion import constrained_motion
from rbjax.constraints.equations.projection import project_state

#: name -> freedoms (the textbooks' number), motors, and redundant rows: those across the plane of a
#: plane loop
SCENES = {"four_bar": (1, 0, 1), "delta": (3, 3, 0), "stewart": (6, 6, 0), "gripper": (1, 1, 2)}
SPATIAL = ("delta", "stewart")
FEW = [pytest.param(name, marks=pytest.mark.slow if name in SPATIAL else ()) for name in SCENES]


def energy(model: rb.Model, state: rb.State) -> jax.Array:
    return rb.kinetic_energy(model, state.q, state.v) + rb.potential_energy(model, state.q)


@functools.cache
def moving(name: str) -> tuple[rb.Model, rb.State, jax.Array]:
    """The scene, its default state with random velocities on the constraints, and the power of all
    forces there."""
    model = rb.load(name)
    start = model.default_state()

    def at(v):
        state = project_state(model, 0.0, rb.State(start.q, v), positions=False)
        q, v = state.q, state.v
        a = constrained_motion(model, 0.0, state, jnp.zeros(model.nv), {})[0]

        def along(s):
            return energy(model, rb.State(rb.integrate(model, q, s * v), v + s * a))

        return v, jax.jvp(along, (0.0,), (1.0,))[1]

    v, power = jax.jit(at)(jax.random.normal(jax.random.key(1), (model.nv,)))
    return model, rb.State(start.q, v), power


@pytest.mark.parametrize("name", SCENES)
def test_closed_as_drawn(name: str) -> None:
    model = rb.load(name, strict=True)
    off = jax.jit(functools.partial(rc.residual, model))
    for state in (model.default_state(), *map(model.keyframe, model.keyframe_names)):
        for x in off(state):
            assert np.abs(x).max() <= 1e-12


@pytest.mark.parametrize(
    "name", ["four_bar", "gripper", *(pytest.param(n, marks=pytest.mark.slow) for n in SPATIAL)]
)
def test_mobility(name: str) -> None:
    freedoms, motors, redundant = SCENES[name]
    model = rb.load(name)
    found = rc.mobility(model, model.default_state().q)
    assert (found.freedoms, model.nu, len(found.redundant)) == (freedoms, motors, redundant)


@pytest.mark.parametrize("name", FEW)
def test_rows_do_no_work(name: str) -> None:
    model, state, power = moving(name)
    off = jax.jit(functools.partial(rc.residual, model))(state).rate
    assert np.abs(off).max() < 1e-12 < 0.1 < np.abs(state.v).max()
    assert abs(power) < 1e-11 * rb.kinetic_energy(model, state.q, state.v)


def test_a_delta_s_platform_does_not_turn() -> None:
    model, state, _ = moving("delta")
    platform = state.v[model.v_slice("platform")]
    assert np.abs(platform[3:]).max() < 1e-12 < 0.1 < np.abs(platform[:3]).max()


def test_a_gripper_s_fingers_stay_parallel_and_meet() -> None:
    model, state, _ = moving("gripper")
    velocities = [
        rb.frame_velocity(model, state.q, state.v, site=f"{side}_pad") for side in ("left", "right")
    ]
    for w in velocities:
        np.testing.assert_allclose(w[:3], 0.0, atol=1e-12)
    np.testing.assert_allclose(velocities[0][3], -velocities[1][3], rtol=1e-9)
    pads = [
        rb.frame_pose(model, model.keyframe("closed").q, site=f"{side}_pad")[1]
        for side in ("left", "right")
    ]
    np.testing.assert_allclose(pads[0], pads[1], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_energy_stays(name: str) -> None:
    """Half a second of free motion with motors off."""
    model, state, _ = moving(name)
    state = state.replace(v=0.3 * state.v)
    path = rb.rollout(model, state, None, 2.5e-4, steps=2000, save_every=200, integrator="rk4")
    assert path.success
    values = np.array([energy(model, path.state(i)) for i in range(11)])
    kinetic = max(rb.kinetic_energy(model, q, v) for q, v in zip(path.q, path.v, strict=True))
    assert np.abs(values - values[0]).max() < 1e-8 * kinetic
    for i in range(11):
        for off in rc.residual(model, path.state(i)):
            assert np.abs(off).max() < 1e-12
