"""Loops with flexible links: a four-bar with an elastic coupler, a slider-crank."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.flexible.beams import round_beam
from tests.tolerances import F64_IDENTITY

BAR = '<geom type="capsule" size="0.02 0.2" pos="0 0 0.25" mass="0.5" contype="0" conaffinity="0"/>'
BARS = f"""
<mujoco><option gravity="0 0 -9.81"/><worldbody>
  <body name="crank"><joint name="a" axis="0 1 0"/>{BAR}</body>
  <body name="rocker" pos="1 0 0"><joint name="d" axis="0 1 0"/>{BAR}</body>
</worldbody></mujoco>"""
SLIDER = """
<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="crank"><joint name="a" axis="0 1 0" armature="1"/>
    <geom type="sphere" size="0.02" mass="0.5" contype="0" conaffinity="0"/></body>
  <body name="slider" pos="1.2 0 0"><joint name="s" type="slide" axis="1 0 0"/>
    <geom type="sphere" size="0.05" mass="0.5" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>"""
#: from the hinge about z of `with_link` to one about y, and back
TO, BACK = (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0), (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)


def pinned_beam(model: rb.Model, at, name: str, end: str, point) -> rb.Model:
    """Add a beam along x on a hinge about y of the crank, and tie its tip to the body `end`."""
    model = model.with_link("pin", rb.joints.kind("hinge"), "crank", position=at, orientation=TO)
    model = model.with_beam(
        name, round_beam({"k_y": 1}, damping=0.0), "pin", orientation=BACK
    )  # fmt: skip
    tie = rb.constraints.Spherical.between(model, name, end, point=point)
    return model.with_constraints(tie)


@functools.cache
def four_bar() -> rb.Model:
    """A parallelogram: crank and rocker of 0.5 m upwards, the elastic coupler of 1 m along x."""
    return pinned_beam(rb.load(BARS), (0, 0, 0.5), "coupler", "rocker", (1.0, 0.0, 0.5))


@functools.cache
def slider_crank() -> rb.Model:
    """A crank of 0.2 m along x, a flexible rod of 1 m and a slider along x."""
    return pinned_beam(rb.load(SLIDER), (0.2, 0, 0), "rod", "slider", (1.2, 0.0, 0.0))


def start(model: rb.Model, v) -> rb.State:
    return model.default_state().replace(v=jnp.asarray(v, float))


def energy(model, state):
    kinetic = rb.kinetic_energy(model, state.q, state.v)
    return kinetic + rb.potential_energy(model, state.q) + rb.forces.elastic_energy(model, state.q)


@pytest.mark.parametrize(
    "method",
    ["kkt", "null_space_qr", "recursive", "udwadia_kalaba", "force_projection", "partitioning"],
)
def test_methods_give_the_same_acceleration(method: str) -> None:
    """M a = f + G^T l and G a = c, dense in NumPy, for each method."""
    model = four_bar()
    state = rb.State(jnp.array([0.0, 0.0, 0.0, 0.3, 0.1]), jnp.array([1.0, 0.9, -1.0, 0.2, 0.1]))
    tau = rb.applied_forces(model, state)
    found = rb.acceleration(model, state, constraints=method)
    M = np.asarray(rb.mass_matrix(model, state.q))
    free = np.asarray(rb.forward_dynamics(model, state.q, state.v, tau))

    def gap(q):
        """From the rocker to the tip, in the plane."""
        tip = rb.frame_pose(model, q, "coupler")[1]
        return (tip - rb.frame_pose(model, q, "rocker", point=(0.0, 0.0, 0.5))[1])[
            jnp.array([0, 2])
        ]

    @jax.jit
    def rows(q, v, a):
        speed = lambda q, v: jax.jvp(gap, (q,), (v,))[1]  # noqa: E731
        return jax.jacfwd(gap)(q), jax.jvp(speed, (q, v), (v, a))[1]

    G, rate = map(np.asarray, rows(state.q, state.v, found))
    push = M @ (np.asarray(found) - free)
    l = np.linalg.lstsq(G.T, push, rcond=None)[0]
    assert np.abs(push - G.T @ l).max() < 1e-9 * np.abs(push).max()
    assert np.abs(rate).max() < 1e-9 * np.abs(found).max()


def test_energy_of_a_four_bar_with_an_elastic_coupler() -> None:
    """Half a second under gravity without damping: RK4 steps of 0.5 ms, projected to the loop."""
    model = four_bar()
    state = start(model, [1.0, 1.0, -1.0, 0.0, 0.0])
    path = rb.rollout(
        model, state, None, 5e-4, steps=1000, integrator="rk4", constraints="projected",
        save_every=100,
    )  # fmt: skip
    states = rb.State(path.q, path.v)
    E = jax.jit(jax.vmap(lambda s: energy(model, s)))(states)
    swing = float(jnp.ptp(jax.vmap(lambda q: rb.potential_energy(model, q))(path.q)))
    assert float(jnp.abs(path.q[:, 3]).max()) > 0.05  # the coupler bends
    assert float(jnp.abs(E - E[0]).max()) < 1e-7 * swing
    gap = jax.vmap(lambda s: rb.constraints.residual(model, s).value)(states)
    assert float(jnp.abs(gap).max()) < F64_IDENTITY


def test_a_slider_crank_with_a_flexible_rod() -> None:
    """A heavy crank turns: the slider follows the rigid mechanism up to the deflection of the rod.

    A deflection w of the middle shortens a bar of length L by about 4 w^2 / L (parabola: 8 / 3).
    """
    model = slider_crank()
    state = start(model, [2 * np.pi, 0.0, -2 * np.pi, 0.0, 0.0])
    # the tip of the rod is at rest: the pin turns by (1 + 0.2 / 1) of the crank's rate
    state = state.replace(v=state.v.at[2].set(-2 * np.pi * 1.2))
    path = rb.rollout(
        model, state, None, 5e-4, steps=1000, integrator="rk4", constraints="projected",
        save_every=50,
    )  # fmt: skip
    gap = jax.vmap(lambda s: rb.constraints.residual(model, s).value)(rb.State(path.q, path.v))
    assert float(jnp.abs(gap).max()) < F64_IDENTITY
    crank, s, bend = path.q[:, 0], path.q[:, 1], jnp.abs(path.q[:, 3:]).max()
    rigid = 0.2 * jnp.cos(crank) + jnp.sqrt(1 - (0.2 * jnp.sin(crank)) ** 2) - 1.2
    off = float(jnp.abs(s - rigid).max())
    assert float(bend) > 0.005
    assert off < 8 / 3 * (float(bend) / 8) ** 2 * 2 + 1e-9
