"""A leg of the quadruped in the air, and ways in which a recording of joints can be wrong."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.sysid import PD, Channel, Grid, Recording, Setup, Unknown
from rbjax.sysid.simulation.setup import simulate_motion

T = 0.005
NOISE = 5e-4
JOINTS = ("abduction", "hip", "knee")
MJCF = """
<mujoco><worldbody><body name="trunk" pos="0 0 1">
 <body name="hip"><joint name="abduction" axis="1 0 0"/>
  <inertial pos="0 0.05 0" mass="1.2" diaginertia="3e-3 3e-3 3e-3"/>
  <body name="thigh" pos="0 0.08 0"><joint name="hip" axis="0 1 0"/>
   <inertial pos="0 0 -0.07" mass="1.1" diaginertia="6e-3 6e-3 1e-3"/>
   <body name="calf" pos="0 0 -0.21"><joint name="knee" axis="0 1 0"/>
    <inertial pos="0 0 -0.1" mass="0.3" diaginertia="3e-3 3e-3 1e-4"/>
   </body></body></body></body></worldbody>
 <actuator><motor joint="abduction"/><motor joint="hip"/><motor joint="knee"/></actuator></mujoco>
"""
UNKNOWNS = {
    "armature": Unknown("joints.armature", positive=True),
    "viscous": Unknown("joints.damping", positive=True),
    "bias": Unknown("sensors.q.bias", scale=0.1),
}
TRUTH = np.array([0.02, 0.025, 0.03, 0.2, 0.3, 0.25, 0.01, -0.02, 0.015])


@functools.cache
def leg(seconds: float = 3.0, seed: int = 0) -> tuple[Setup, Recording]:
    """A set-up with first guesses and its recording: armature, friction and bias differ."""
    with warnings.catch_warnings(action="ignore"):
        model = rb.load(MJCF, contacts=False)

    def setup(armature: np.ndarray, damping: np.ndarray, bias: np.ndarray) -> Setup:
        joints = model.joints.replace(armature=jnp.asarray(armature), damping=jnp.asarray(damping))
        made = Setup.of(model.replace(joints=joints), PD(jnp.full(3, 20.0), jnp.full(3, 1.5)))
        seen = made.sensors["q"].replace(bias=jnp.asarray(bias))
        return made.replace(sensors=made.sensors | {"q": seen})

    N = int(seconds / T)
    t = np.arange(N + 1) * T
    phase = 2 * np.pi * (0.3 * t + (3.0 - 0.3) / (2 * seconds) * t**2)
    asked = np.array([0.0, 0.9, -1.75]) + np.array([0.25, 0.35, 0.5]) * np.stack(
        [np.sin(phase), np.sin(1.2 * phase + seed), np.sin(0.9 * phase + 1)], 1
    )
    true = setup(*np.split(TRUTH, 3))
    start = rb.State(jnp.asarray(asked[0] - TRUTH[6:]), jnp.zeros(3))
    path = simulate_motion(lambda p: true, jnp.zeros(1), start, jnp.asarray(asked[:-1]), Grid(T))
    noise = NOISE * np.random.default_rng(seed).normal(size=(N + 1, 3))
    noise[0] = 0.0
    v = np.full((N + 1, 3), np.nan)
    v[0] = 0.0
    run = Recording(f"chirp {seed}", {
        "q": Channel(t, path.q + TRUTH[6:] + noise, JOINTS),
        "v": Channel(t, v, JOINTS, dropped="nan"),
        "ctrl": Channel(t[:-1], asked[:-1], JOINTS),
    })  # fmt: skip
    return setup(np.full(3, 0.01), np.full(3, 0.1), np.zeros(3)), run


def _changed(sensor: str, change: Callable[[np.ndarray, np.ndarray], tuple]) -> Callable:
    def wrong(run: Recording) -> Recording:
        c = run[sensor]
        t, values = change(c.t.copy(), c.values.copy())
        made = Channel(t, values, c.names, noise=c.noise, dropped="nan")
        return dataclasses.replace(run, channels={**run.channels, sensor: made})

    return wrong


def _slow(t, x):
    return t * 1.02, x


def _outliers(t, x):
    rng = np.random.default_rng(1)
    far = rng.random(x.shape) < 0.05
    far[0] = False
    return t, np.where(far, x + rng.choice([-1, 1], x.shape) * rng.uniform(0.2, 1.0, x.shape), x)


class Wrong(NamedTuple):
    """What makes a recording wrong, and the kind of the cause, its channels and columns."""

    make: Callable[[Recording], Recording]
    kind: str
    channels: tuple[str, ...]
    columns: tuple[str, ...]


def ways(names: tuple[str, ...], one: int, other: int) -> dict[str, Wrong]:
    """Ways in which the recording of joints can be wrong, in one column, or in two."""

    def flipped(t, x):
        x[:, one] *= -1
        return t, x

    def swapped(t, x):
        x[:, [one, other]] = x[:, [other, one]]
        return t, x

    def dead(t, x):
        k = len(t) // 2
        x[k:, other] = x[k, other] + NOISE * np.random.default_rng(1).normal(size=len(t) - k)
        return t, x

    a, b = names[one], names[other]
    return {
        "sign of a sensor": Wrong(_changed("q", flipped), "sign", ("q",), (a,)),
        "sign of a command": Wrong(_changed("ctrl", flipped), "sign", ("ctrl",), (a,)),
        "joints swapped": Wrong(_changed("q", swapped), "swap", ("q",), (a, b)),
        "commands swapped": Wrong(_changed("ctrl", swapped), "swap", ("ctrl",), (a, b)),
        "clock 2 % off": Wrong(_changed("q", _slow), "clock", ("q",), ()),
        "5 % outliers": Wrong(_changed("q", _outliers), "outliers", ("q",), names),
        "sensor dead": Wrong(_changed("q", dead), "dead", ("q",), (b,)),
    }


WRONG = ways(JOINTS, 1, 2)
