"""Motions of beams as links: spin-up, flying beams, invariants, gradients."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.beams import FLYING_LOAD, flying_beam
from rbjax.motion.variational import VariationalMidpoint
from tests.oracles import load

ORACLES = load("beams")
HEAVY = 1e12  # armature, kg m^2, of a hub whose motion the beam does not change
HUB = """<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="hub"><joint name="spin" axis="0 0 1" armature="{armature}"/>
    <geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>"""


def compiled(f):
    return jax.jit(f, compiler_options=rb.compiler_options())


def speed(t: np.ndarray) -> np.ndarray:
    """Rate of rotation of the spin-up manoeuvre, 6 rad/s after 15 s."""
    return np.where(t < 15, 0.4 * (t - 7.5 / np.pi * np.sin(2 * np.pi * t / 15)), 6.0)


def spin_up(h: float) -> np.ndarray:
    """Displacement (201, 2) of the tip in the rotating frame, axial and across, each 0.1 s."""
    beam = rb.flexible.beam(
        10.0, [0, 0, 1.4e4, 2.8e7, 1e7, 0], {"k_z": 4, "e_x": 2, "g_y": 2},
        mass=1.2, inertia=[6e-4, 0, 6e-4],
    )  # fmt: skip
    model = rb.load(HUB.format(armature=HEAVY)).with_beam("rod", beam, "hub")
    steps = round(20 / h)
    tau = np.zeros((steps, model.nv))
    tau[:, 0] = HEAVY * np.diff(speed(np.arange(steps + 1) * h)) / h
    path = rb.rollout(
        model, model.default_state(), None, h, tau=jnp.asarray(tau),
        integrator="variational_midpoint", save_every=round(0.1 / h),
    )  # fmt: skip
    tip = jax.vmap(lambda q: rb.frame_pose(model, q.at[0].set(0.0), "rod")[1])(path.q)
    return np.asarray(tip)[:, :2] - [10.0, 0.0]


@pytest.mark.slow
def test_spin_up() -> None:
    """The table of axial displacement and lag, and the largest lag, with 11 coordinates."""
    coarse, fine = spin_up(0.01), spin_up(0.005)
    u = (4 * fine - coarse) / 3  # the method has order 2
    for key, want in ORACLES["spin_up_table"].items():
        if key[0].isdigit():
            np.testing.assert_allclose(u[round(10 * float(key))], want, rtol=0, atol=2e-6)
            np.testing.assert_allclose(fine[round(10 * float(key))], want, rtol=0, atol=1e-5)
    lag, at = ORACLES["spin_up_table"]["peak_lag"]
    i = u[:, 1].argmin()
    cubic = np.polyfit(np.arange(-2, 3) * 0.1, u[i - 2 : i + 3, 1], 4)
    turns = np.roots(np.polyder(cubic))
    turn = turns[np.abs(turns).argmin()].real
    assert abs(np.polyval(cubic, turn) - lag) < 1e-5
    assert abs(i * 0.1 + turn - at) < 5e-3
    steady = ORACLES["spin_up_beam"]["steady_extension_linear"]
    assert abs(u[160:, 0].mean() - steady) < 1e-6


def flight(model: rb.Model, h: float, steps: int, save_every: int, **given):
    """Load the tip for 2.5 s by a force of 8 N and a moment of -80 N m, then fly freely."""
    wrenches = jnp.zeros((model.nb, 6)).at[-1].set(jnp.array(FLYING_LOAD))
    n = round(2.5 / h)
    loaded = rb.rollout(
        model, model.default_state(), None, h, wrenches=wrenches, steps=n,
        save_every=round(0.5 / h), **given,
    )  # fmt: skip
    state = rb.State(loaded.q[-1], loaded.v[-1])
    free = rb.rollout(model, state, None, h, steps=steps, save_every=save_every, **given)
    assert bool(loaded.success) and bool(free.success)
    return loaded, free


@pytest.mark.slow
@pytest.mark.parametrize("EI", [500.0, 100.0])
def test_flying_beam(EI: float) -> None:
    """The loaded end after the step load, with 259 coordinates.

    The moment at the end sends jumps of the curvature through the beam, which the length of a beam
    resolves: 16 beams err by 1.3e-3, 32 by 2.8e-4, 64 by 5e-5. With 16, half the step changes 1e-5.
    """
    h = 6.25e-4
    model = flying_beam(EI, 32, {"k_z": 2, "e_x": 1, "g_y": 2})
    loaded, free = flight(model, h, round(5 / h), round(0.5 / h), integrator="dop853")
    q = jnp.concatenate([loaded.q, free.q[1:]])
    tips = compiled(jax.vmap(lambda q: rb.frame_pose(model, q, model.body_names[-1])[1]))(q)
    for key, want in ORACLES["flying_beam_step_load_intrinsic"][f"EI_{EI:.0f}"].items():
        found = np.asarray(tips)[round(2 * float(key)), :2] - [6.0, 0.0]
        np.testing.assert_allclose(found, want, rtol=0, atol=3e-4)


@pytest.mark.slow
def test_invariants_of_free_flight() -> None:
    """Energy and momenta over 100,000 steps of the variational midpoint rule.

    The energy varies with the square of the step, within 2.2e-9 with steps of 0.1 ms.
    """
    model = flying_beam(500.0, 1, {"k_z": 3, "e_x": 1, "g_y": 1})
    _, path = flight(model, 5e-5, 100_000, 1000, integrator="variational_midpoint")
    K = -jax.jacfwd(lambda q: rb.applied_forces(model, rb.State(q, 0 * q)))(path.q[0])

    @compiled
    @jax.vmap
    def invariants(q, v):
        h, c = rb.centroidal_momentum(model, q, v), rb.center_of_mass(model, q)
        spin = h[2] + jnp.cross(c, h[3:])[2]
        return jnp.stack([rb.kinetic_energy(model, q, v) + q @ K @ q / 2, h[3], h[4], spin])

    x = np.asarray(invariants(path.q, path.v))
    assert np.abs(x[:, 1:3] - [20.0, 0.0]).max() < 1e-8  # the impulse of the load
    scale = np.maximum(1.0, np.abs(x[0]))
    trend = np.polyfit(np.linspace(0, 1, len(x)), x, 1)[0] / scale
    assert (np.abs(trend) < 1e-9).all(), trend
    assert (np.ptp(x, 0) / scale < 1e-9).all(), np.ptp(x, 0) / scale


@pytest.mark.slow
def test_variational_midpoint_of_a_bent_steel_rod() -> None:
    """Bending in two planes couples to torsion, of 5.6e3 rad/s, with steps of 1 ms.

    The iteration of the step has no such coupling in its matrix. Without acceleration it fails
    within 30 steps.
    """
    steel = rb.flexible.circle(0.005, E=2.1e11, nu=0.3, density=7800.0)
    rod = rb.flexible.beam(1.0, steel, {"k_x": 0, "k_y": 0, "k_z": 1})
    model = rb.load('<mujoco><option gravity="0 0 0"/></mujoco>').with_beam("rod", rod)
    state = rb.State(jnp.array([0.0, 0.5, 0.5, 0.0]), jnp.zeros(4))
    path = rb.rollout(model, state, None, 1e-3, steps=50, integrator=VariationalMidpoint(10))
    assert bool(path.success)


#: EI, GJ, mass per length, length, ratio of viscosity to stiffness
NUMBERS = jnp.array([5.0, 3.0, 1.0, 1.2, 2e-3])


def swinging() -> rb.Model:
    beam = rb.flexible.beam(
        1.2, [3.0, 5.0, 5.0, 0, 0, 0], {"k_x": 0, "k_y": 1, "k_z": 1},
        mass=0.5, inertia=[2e-2, 1e-2, 1e-2], damping=2e-3,
    )  # fmt: skip
    turn = np.array([0.9, 0.1, 0.3, 0.3])
    model = rb.load(HUB.format(armature=0).replace('"0 0 0"/><w', '"0.1 0.2 -9.81"/><w'))
    return model.with_beam("rod", beam, "hub", orientation=turn / np.linalg.norm(turn))


def after_fifty_steps(model: rb.Model, integrator: str, numbers: jax.Array) -> jax.Array:
    EI, GJ, mass, length, damping = numbers
    C = jnp.zeros(6).at[0].set(GJ).at[1:3].set(EI)
    params = jnp.stack([length, 0.5 * mass, 2e-2 * mass, 1e-2 * mass, 1e-2 * mass])
    model = dataclasses.replace(
        model,
        joints=model.joints.replace(params=params),
        forces=(rb.flexible.BeamElasticity(C, damping * C, "rod"),),
    )
    state = rb.State(
        jnp.array([0.3, 0.2, 0.5, -0.3, 0.4, 0.2]), jnp.array([1.0, 0.5, -0.5, 1.0, 0.3, -0.8])
    )
    path = rb.rollout(model, state, None, 5e-3, steps=50, integrator=integrator, save_every=50)
    return jnp.concatenate([path.q[-1], path.v[-1]]) @ jnp.arange(1.0, 13.0)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["implicitfast", "discrete"])
def test_gradient_of_a_rollout(integrator: str) -> None:
    """By central differences with steps of 0.2 %, 0.4 % and 0.8 %, extrapolated to order 6."""
    one = functools.partial(after_fifty_steps, swinging(), integrator)
    f, found = compiled(one), compiled(jax.grad(one))(NUMBERS)
    for i, number in enumerate(NUMBERS):
        sides = [float(f(NUMBERS.at[i].multiply(1 + k * 2e-3))) for k in (4, 2, 1, -1, -2, -4)]
        a, b, c = ((sides[j] - sides[5 - j]) / (2 * k * 2e-3) for j, k in ((2, 1), (1, 2), (0, 4)))
        ab, bc = (4 * a - b) / 3, (4 * b - c) / 3
        want = (16 * ab - bc) / 15 / number
        np.testing.assert_allclose(found[i], want, rtol=1e-8)
