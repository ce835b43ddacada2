"""Force elements on a pendulum: a user's own fan, and friction and a stop of the library."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax.demo.report import Section
from rbjax.forces import Context, Element, JointFriction, JointLimits, Loads
from rbjax.loading import load
from rbjax.model import Model
from rbjax.motion.rollout import rollout
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, STYLE

STEPS, DT, STOP = 600, 0.01, -0.8

_CODE = """\
class Fan(rb.forces.Element):
    air: jax.Array                                  # (3,) m/s
    drag: jax.Array                                 # N s^2 / m^2

    def loads(self, now):
        bob = now.body(0).at(now.model.bodies.com[0])
        wind = self.air - bob.velocity
        return bob.push(wind * (self.drag * wind.norm(1e-6)))

blown = rb.load("pendulum").with_forces(Fan(air, drag))"""


class Fan(Element):
    """A drag on the bob that grows with the square of its speed in the air."""

    air: jax.Array
    drag: jax.Array

    def loads(self, now: Context) -> Loads:
        bob = now.body(0).at(now.model.bodies.com[0])
        wind = self.air - bob.velocity
        return bob.push(wind * (self.drag * wind.norm(1e-6)))


def _scenes() -> dict[str, tuple[Model, str]]:
    """Name of the forces -> the model, and its colour."""
    alone = load("pendulum")
    fan = Fan(jnp.array([6.0, 0.0, 0.0]), jnp.array(0.05))
    friction = JointFriction.of(alone, alone.joint_names, coulomb=0.4)
    limited = alone.replace(joints=alone.joints.replace(range=[[STOP, 2.0]]))
    k, d, margin, width = (jnp.array([x]) for x in (2e3, 20.0, 0.0, 0.01))
    stop = JointLimits(k, d, margin, width, alone.joint_names)
    return {
        "nothing": (alone, INK),
        "a fan": (alone.with_forces(fan), ORANGE),
        "dry friction": (alone.with_forces(friction), GREEN),
        "a stop": (limited.with_forces(stop), BLUE),
    }


def forces(folder: Path, say: Callable[[str], None], *, steps: int = STEPS) -> Section:
    """Run and draw."""
    rows, paths = [], {}
    for name, (model, colour) in _scenes().items():
        say(f"a pendulum with {name}")
        start = model.keyframe("horizontal")

        def run(state, model=model):  # compiled with the model known, a smaller program
            return rollout(model, state, None, DT, steps=steps, integrator="rk4")

        path = jax.jit(run)(start)
        paths[name] = path, colour
        angle = np.asarray(path.q[:, 0])
        rows.append((name, f"{angle.min():.4f}", f"{angle[-1]:.4f}", f"{len(model.forces)}"))
    with plt.rc_context(STYLE):
        figure, ax = plt.subplots(figsize=(11, 3.4), layout="constrained")
        for name, (path, colour) in paths.items():
            ax.plot(path.ts, path.q[:, 0], color=colour, label=name)
        ax.axhline(STOP, color=BLUE, lw=0.8, ls=":")
        ax.set(xlabel="time [s]", ylabel="angle [rad]", title="What acts on the pendulum")
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(paths))
        figure.savefig(folder / "forces.png")
        plt.close(figure)
    return Section(
        title="Your own forces",
        text=(
            "A model has a tuple of force elements: springs, friction, stops, fluids, muscles "
            "and motors of the library, or your own. Rollouts, solvers, linearisation and "
            "gradients sum over the same list, on CPU and GPU.",
        ),
        pictures=(("forces.png", "One pendulum, let go at the horizontal, under four kinds of "
                   "force. The dotted line is the stop."),),
        columns=("besides gravity", "lowest angle [rad]", "last angle [rad]", "elements"),
        rows=tuple(rows),
        code=_CODE,
    )  # fmt: skip
