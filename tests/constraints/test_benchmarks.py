"""Benchmark mechanisms against closed forms and integrations of others (tests/oracles/loops.json).

Sources: IFToMM library of computational benchmark problems (A01, A02, spatial slider-crank); Test
Set for IVP solvers (Andrews' squeezing mechanism).
"""

import functools
import json
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.mechanisms import andrews, four_bars, pendulum, spatial_slider_crank
from rbjax import constraints as rc

FIGURES = json.loads((Path(__file__).parent.parent / "oracles" / "loops.json").read_text())


def tight(tolerance: float) -> dict:
    controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
    return {"solver": diffrax.Dopri8(), "stepsize_controller": controller}


def times(samples: dict) -> jnp.ndarray:
    return jnp.array([0.0, *map(float, samples)])


@pytest.mark.parametrize(
    "constraints", ["projected", pytest.param("baumgarte", marks=pytest.mark.slow)]
)
def test_pendulum(constraints: str) -> None:
    """A01: 10 s from rest, beside the closed form; energy to 1e-8 J; tension of the rod."""
    samples = FIGURES["pendulum"]["samples"]
    model, start = pendulum(), rb.State(jnp.array([-1.0, 0.0]), jnp.zeros(2))
    path = rb.simulate(model, start, times(samples), constraints=constraints, **tight(1e-11))
    want = np.array([[s["x"], s["y"], s["vx"], s["vy"]] for s in samples.values()])
    np.testing.assert_allclose(np.hstack([path.q, path.v])[1:], want, atol=2e-9)
    energy = 0.5 * (path.v**2).sum(-1) + 9.81 * path.q[:, 1]
    assert np.abs(energy).max() < 1e-8
    tension = rc.multipliers(model, path.state(4))[0]
    assert abs(tension + samples["1.0"]["rod_tension"]) < 1e-7


@functools.cache
def crossed(n: int, seconds: float, joint: type) -> tuple[rb.Model, rb.Trajectory]:
    model, start = four_bars(n, joint)
    steps = round(seconds / 1e-3)
    return model, rb.rollout(
        model, start, None, 1e-3, steps=steps, save_every=500, integrator="rk4"
    )


@pytest.mark.parametrize(
    "n, seconds, joint",
    [
        pytest.param(2, 2.0, rc.Spherical, marks=pytest.mark.slow),  # test_singular.py is quick
        pytest.param(2, 10.0, rc.Spherical, marks=pytest.mark.slow),
        pytest.param(2, 10.0, rc.Revolute, marks=pytest.mark.slow),
    ],
)
def test_four_bars_pass_their_singular_positions(n: int, seconds: float, joint: type) -> None:
    """A02: flat at 90 and 270 degrees, where G loses rank; always with redundant rows, too."""
    model, path = crossed(n, seconds, joint)
    samples = {float(t): s for t, s in FIGURES["four_bars"][str(n)].items() if float(t) <= seconds}
    at = [round(t / 0.5) for t in samples]
    want = np.array([[s["theta"], s["thetadot"]] for s in samples.values()])
    found = np.stack([path.q[:, 0], path.v[:, 0]], -1)[at]
    np.testing.assert_allclose(found, want, atol=1e-9)
    off = rc.residual(model, path.state(-1))
    assert max(np.abs(off.value).max(), np.abs(off.rate).max()) < 1e-13


@pytest.mark.slow
def test_forty_four_bars_keep_their_energy() -> None:
    """A02 as its library has it: 81 rods, 120 rows of rank 80, ten singular positions, 1e-5 J."""
    model, start = four_bars(40)
    assert (model.nv, sum(one.size for one in model.constraints)) == (81, 120)

    @jax.jit  # the model's numbers are known here: a minute to compile
    def half_a_second(state):
        path = rb.rollout(model, state, None, 1e-3, steps=500, save_every=500, integrator="rk4")
        q, v = path.q[-1], path.v[-1]
        off = rc.residual(model, rb.State(q, v))
        energy = rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q)
        return rb.State(q, v), energy, jnp.abs(jnp.concatenate(off)).max()

    first = rb.kinetic_energy(model, start.q, start.v) + rb.potential_energy(model, start.q)
    samples, state = FIGURES["four_bars"]["40"], start
    for k in range(1, 21):
        state, energy, off = half_a_second(state)
        assert abs(energy - first) < 1e-5 and off < 1e-13
        if want := samples.get(str(k / 2)):
            np.testing.assert_allclose(state.q[::80], want["theta"], atol=1e-7)
            np.testing.assert_allclose(state.v[::80], want["thetadot"], atol=1e-6)


@pytest.mark.slow
def test_spatial_slider_crank() -> None:
    """A free rod on a ball and a universal joint: seven rows, one freedom."""
    samples = FIGURES["slider_crank"]["samples"]
    model, start = spatial_slider_crank()
    path = rb.simulate(model, start, times(samples), **tight(1e-12))
    want = np.array([[s["theta"], s["slider_x"] - 0.2] for s in samples.values()])
    np.testing.assert_allclose(path.q[1:, :2], want, atol=1e-9)  # the figures' own error: 3e-10


@pytest.mark.slow
@pytest.mark.parametrize(
    "constraints",
    [
        "projected", "multipliers", "baumgarte", "kkt", "null_space_svd", "udwadia_kalaba",
        "recursive",
    ],
)  # fmt: skip
def test_andrews(constraints: str) -> None:
    """Seven bodies, three loops that meet in a point: positions, velocities, multipliers."""
    figures = FIGURES["andrews"]
    model, start = andrews(figures["parameters"], figures["q0"])
    mom = jnp.zeros(7).at[model.joint("K1")].set(figures["parameters"]["mom"])
    samples = figures["samples"]
    path = rb.simulate(
        model, start, times(samples), tau=mom, constraints=constraints, **tight(1e-12)
    )
    order = np.array([model.joint(f"K{k}") for k in range(1, 8)])
    held = model.with_forces(Torque(mom))
    for i, want in enumerate(samples.values(), 1):
        np.testing.assert_allclose(path.q[i][order], want["q"], rtol=1e-9)
        np.testing.assert_allclose(path.v[i][order], want["v"], rtol=1e-8)
        l = rc.multipliers(held, path.state(i)).reshape(3, 3)
        np.testing.assert_allclose(-l[:, :2].ravel(), want["lam"], rtol=1e-7)
        np.testing.assert_allclose(l[:, 2], 0.0)  # across the plane


class Torque(rb.forces.Element):
    tau: jnp.ndarray

    def loads(self, context):
        return context.generalized(self.tau)


@pytest.mark.slow
def test_drift_stays_at_rounding() -> None:
    """Ten thousand steps of a method of first order; a slow test takes a million."""
    _drifts(10_000)


@pytest.mark.slow
def test_drift_over_a_million_steps() -> None:
    _drifts(1_000_000)


def _drifts(steps: int) -> None:
    model = rb.load("four_bar")
    start = model.keyframe("turning")
    path = rb.rollout(model, start, None, 1e-3, steps=steps, save_every=steps // 10)
    assert path.success
    for i in range(11):
        off = rc.residual(model, path.state(i))
        assert max(np.abs(off.value).max(), np.abs(off.rate).max()) < 1e-12
