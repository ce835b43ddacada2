"""Friction, stiffness and size of a tossed cube: simulated, and the real one of ContactNets."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases import cube
from rbjax.sysid import Channel, Recording, Setup, Unknown, identify
from rbjax.sysid.simulation.setup import Grid, SimulatedPath, read_sensor

needs_data = pytest.mark.skipif(
    not cube.DATA.exists(), reason=f"the tosses of the cube are not there: {cube.DATA}"
)


def tossed(model: rb.Model, samples: int) -> np.ndarray:
    """Two tosses of a simulated cube (2, samples, 13): one lands on a corner, one slides."""
    first = np.array([
        [0, 0, 0.12, 0.9, 0.3, -0.2, 0.24, 0.8, 0.4, -1.0, 2.0, 1.0, -3.0],
        [0, 0, 0.055, 1, 0, 0, 0, 0.6, -0.3, -0.2, 0, 0, 1.0],
    ])  # fmt: skip
    first[:, 3:7] /= np.linalg.norm(first[:, 3:7], axis=1, keepdims=True)
    steps = (samples - 1) * cube.STEPS
    path = rb.rollout(
        model, rb.State(first[:, :7], first[:, 7:]), None, cube.GRID.period / cube.STEPS,
        steps=steps, save_every=cube.STEPS,
    )  # fmt: skip
    return np.concatenate([path.q, path.v], -1)


def test_parameters_of_a_simulated_cube_are_found() -> None:
    """Without noise, from a guess 10 to 50 % off: to 1 %."""
    want = {"friction": 0.25, "time constant": 0.012, "damping ratio": 0.8, "half side": 0.05}
    truth = cube.model(0.25, 0.05, (0.012, 0.8), impedance=0.1)
    seen = tossed(jax.tree.map(_double, truth), 25)
    found = identify(
        cube.model(0.35, 0.051, (0.018, 1.0), impedance=0.1), cube.recordings(seen),
        {k: u for k, u in cube.unknowns().items() if k in want}, grid=cube.GRID, restarts=0,
    )  # fmt: skip
    for name, value in want.items():
        assert found.values[name] == pytest.approx(value, rel=1e-2), (name, found.values)
    assert "the force of the contacts jumps at touch" in found.summary()


def test_a_touch_sensor_is_read_in_a_simulation() -> None:
    """The readings of `identify` contain the contact force of the model's law, with derivatives."""
    text = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.1">
      <joint type="slide" axis="0 0 1"/><geom size="0.1" mass="2"/><site name="pad" size="0.2"/>
      </body></worldbody><sensor><touch name="pad" site="pad"/></sensor></mujoco>"""
    model = jax.tree.map(_double, rb.load(text, contacts=True))
    setup = Setup.of(model).with_sensors({"other:pad": model.sensors[0]})
    state = rb.State(jnp.array([-0.001]), jnp.array([-0.1]))
    want = rb.sense(model, state)
    assert want[0] > 1

    def read(v: jax.Array) -> jax.Array:
        path = SimulatedPath(
            jnp.tile(state.q, (2, 1)), jnp.tile(v, (2, 1)), None, jnp.zeros((1, 0))
        )
        return read_sensor(setup, path, Grid(1e-9), "other:pad", jnp.zeros(1))[0]

    np.testing.assert_allclose(read(state.v), want, rtol=1e-9)
    slope = jax.jvp(read, (state.v,), (jnp.ones(1),))[1]
    difference = (read(state.v + 1e-4) - read(state.v - 1e-4)) / 2e-4
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


PRESSED = """<mujoco><option timestep="0.005" cone="elliptic"/><worldbody>
  <geom type="plane" size="0 0 1" priority="1" solref="0.03 1"
    solimp="0.0001 0.95 0.01 0.5 2"/>
  <body name="box" pos="0 0 0.099"><joint name="z" type="slide" axis="0 0 1"/>
    <geom type="box" size="0.1 0.1 0.1" mass="{}"/>
    <site name="pad" type="box" size="0.11 0.11 0.11"/></body></worldbody>
  <actuator><motor joint="z"/></actuator><sensor><touch name="touch" site="pad"/></sensor>
  </mujoco>"""


def test_the_mass_of_a_pressed_box_is_found_by_its_touch_sensor() -> None:
    """Readings of MuJoCo with 0.1 N of noise; the softness of the floor follows the mass, so the
    height alone says little."""
    true, steps, rng = 2.3, 60, np.random.default_rng(0)
    m = mujoco.MjModel.from_xml_string(PRESSED.format(true))
    data, t, rows = mujoco.MjData(m), 0.005 * np.arange(steps + 1), []
    for now in t:
        data.ctrl[:] = -8 * np.sin(4 * np.pi * now) ** 2
        mujoco.mj_forward(m, data)
        rows.append([data.qpos[0], data.ctrl[0], data.sensordata[0]])
        mujoco.mj_step(m, data)
    q, ctrl, force = np.array(rows).T[..., None]
    first = np.full_like(q, np.nan)
    first[0] = 0
    recording = Recording("pressed", {
        "q": Channel(t, q + 1e-5 * rng.normal(size=q.shape), noise=np.full(1, 1e-5)),
        "v": Channel(t, first, noise=np.full(1, 1e-3), dropped="nan"), "ctrl": Channel(t, ctrl),
        "other:touch": Channel(t, force + 0.1 * rng.normal(size=q.shape), noise=np.full(1, 0.1)),
    })  # fmt: skip
    model = jax.tree.map(_double, rb.load(PRESSED.format(1.5), contacts=True))
    setup = Setup.of(model).with_sensors({"other:touch": model.sensors[0]})
    mass = {"mass": Unknown("bodies.mass", 0, positive=True)}
    found = identify(setup, recording, mass, grid=Grid(0.005), restarts=0)
    assert found.success, found.summary()
    interval = found.estimates.interval("mass")
    assert interval.low < true < interval.high and interval.sigma < 0.01, found.summary()


@needs_data
def test_the_real_cube() -> None:
    """Friction and size from 12 real tosses agree with the published ones, and the fitted model
    predicts the start of other tosses better than the published parameters."""
    seen, unseen = cube.tosses(range(0, 570, 50), 25), cube.tosses(range(1, 570, 20), 25)
    guess = cube.model(0.25, 0.056, impedance=0.1)
    found = identify(
        guess, cube.recordings(seen), cube.unknowns(), grid=cube.GRID, loss="huber", restarts=0,
        max_evaluations=30,
    )  # fmt: skip
    assert 0.15 < found.values["friction"] < 0.27
    assert found.values["half side"] == pytest.approx(cube.PUBLISHED["half side"], rel=0.06)
    fit = cube.distances(cube.simulated(found.model, unseen, found.values["unit"]), unseen)
    published = cube.distances(cube.simulated(cube.model(), unseen), unseen)
    assert fit[:, 20].mean() < 0.8 * published[:, 20].mean()


def _double(x: object) -> object:
    return x.astype(jnp.float64) if getattr(x, "dtype", None) == jnp.float32 else x
