"""Wheels: an omnidirectional robot that drives and turns, on grounds with less and less grip."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax import wheeled
from rbjax.demo.report import Section
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting import STYLE, top_view

STEPS, DT = 400, 0.005
GROUNDS = {"rubber": 0.9, "ice": 0.08, "wet ice": 0.04}
TWIST = (0.8, 0.0, 1.5)

_CODE = """\
robot = wheeled.kinds()["omni_3"].make(motor=wheeled.SpeedServo(0.5, 1.0))
vehicle = wheeled.at(robot, "slipping", tyre=wheeled.Fiala(15.0, 0.08))
speeds = wheeled.commands(robot, [0.8, 0.0, 1.5]).speeds
path = wheeled.rollout(vehicle, wheeled.start(vehicle), jnp.tile(speeds, (400, 1)), 0.005,
                       integrator="linearly_implicit_euler")"""


def wheels(folder: Path, say: Callable[[str], None], *, steps: int = STEPS) -> Section:
    """Run and draw."""
    say("an omnidirectional robot loses its grip")
    motor = wheeled.SpeedServo(jnp.asarray(0.5), jnp.asarray(1.0))
    robot = wheeled.kinds()["omni_3"].make(motor=motor, wheel_mass=1.0)
    speeds = wheeled.commands(robot, np.array(TWIST)).speeds
    controls = jnp.tile(speeds, (steps, 1))

    def on(friction: jax.Array) -> wheeled.RobotModel:
        grip, smooth = jnp.asarray(15.0), jnp.asarray(0.3)
        tyre = wheeled.Fiala(stiffness=grip, friction=friction, smooth_speed=smooth)
        return wheeled.at(robot, "slipping", tyre=tyre)

    def moved(friction: jax.Array) -> Trajectory:
        vehicle = on(friction)
        return wheeled.rollout(
            vehicle, wheeled.start(vehicle), controls, DT, integrator="linearly_implicit_euler",
            save_every=max(1, steps // 40),
        )  # fmt: skip

    # all grounds are a batch
    paths = jax.jit(jax.vmap(moved))(jnp.array(list(GROUNDS.values())))
    rows = []
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            1, len(GROUNDS), figsize=(11, 3.6), layout="constrained", sharex=True, sharey=True
        )
        for k, (name, friction) in enumerate(GROUNDS.items()):
            path, vehicle = jax.tree.map(lambda x, k=k: x[k], paths), on(jnp.asarray(friction))
            top_view(axes[k], vehicle, path, robots=4, controls=speeds)
            axes[k].set_title(f"{name}: friction {friction:g}")
            twist = np.asarray(path.v[-1, :3])
            ends = wheeled.contacts(vehicle, path.state(-1), speeds)
            slides = np.abs(np.asarray(ends.sliding)[:, 0]).max()
            speed = np.hypot(*twist[:2])
            rows.append((name, f"{speed:.2f}", f"{twist[2]:.2f}", f"{slides:.2f}"))
        figure.savefig(folder / "wheels.png")
        plt.close(figure)
    return Section(
        title="Wheels that roll, and wheels that slip",
        text=(
            f"Motors hold the speeds of three omnidirectional wheels, for {TWIST[0]:g} m/s and "
            f"{TWIST[2]:g} rad/s. With enough friction the robot does that. With less its wheels "
            "spin, and it drives another way. Arrows are the forces on the wheels. The tyres are "
            "Fiala's brush model; friction is a number of the batch.",
        ),
        pictures=(("wheels.png", "The same commands on three grounds."),),
        columns=("ground", "speed [m/s]", "turning rate [rad/s]", "fastest sliding [m/s]"),
        rows=tuple(rows),
        code=_CODE,
    )
