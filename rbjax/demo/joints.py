"""Kinds of joints: a cart on a user's own bent rail, defined by the pose of its joint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import MappingProxyType

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax import joints as kinds
from rbjax.demo.report import Section
from rbjax.dynamics import forward_kinematics, kinetic_energy, potential_energy
from rbjax.lanes import Lane, Mat3, Vec3
from rbjax.loading import load
from rbjax.model import State
from rbjax.motion.rollout import rollout
from rbjax.plotting import BLUE, GREEN, ORANGE, STYLE
from rbjax.spatial import Transform

STEPS, DT = 800, 0.005
OPENINGS, COLOURS = (0.2, 0.5, 1.0), (GREEN, ORANGE, BLUE)  # 1/m

_CODE = """\
class Rail(rb.joints.Node):
    name, coordinates = "rail", 1
    params = {"opening": 0.0}                      # 1/m

    def pose(self, q, params):
        height = params[0] * q[0] * q[0]
        return Transform(Mat3.identity(), Vec3(q[0], 0.0, height))

rb.joints.register(Rail())
bent = rb.load("cart_pole").with_joint("slider", "rail", opening=0.5, axis=[0, 0, 1])"""


class Rail(kinds.Node):
    """A rail in the form of a parabola: one coordinate."""

    name, coordinates = "rail", 1
    params = MappingProxyType({"opening": 0.0})

    def pose(self, q: Sequence[Lane], params: Sequence[Lane]) -> Transform:
        height = params[0] * q[0] * q[0]
        return Transform(Mat3.identity(), Vec3(q[0], 0.0, height))


def joints(folder: Path, say: Callable[[str], None], *, steps: int = STEPS) -> Section:
    """Run and draw."""
    say("carts on rails of three openings")
    kinds.register(Rail())
    cart = load("cart_pole").with_joint("slider", "rail", axis=[0.0, 0.0, 1.0])
    cart = cart.replace(joints=cart.joints.replace(damping=[0.0, 0.0]))
    start = State(jnp.array([1.0, 0.3]), jnp.zeros(2))

    def run(opening: jax.Array) -> tuple[jax.Array, ...]:
        model = cart.replace(joints=cart.joints.replace(params=opening[None]))
        path = rollout(model, start, None, DT, steps=steps, integrator="rk4")

        def seen(q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
            energy = kinetic_energy(model, q, v) + potential_energy(model, q)
            return forward_kinematics(model, q).p[0], energy

        return path.ts, path.q[:, 0], *jax.vmap(seen)(path.q, path.v)

    rows, drawn = [], []
    every = map(np.asarray, jax.jit(jax.vmap(run))(jnp.array(OPENINGS)))
    for opening, colour, ts, x, at, energy in zip(OPENINGS, COLOURS, *every, strict=True):
        lost = np.abs(energy / energy[0] - 1).max()
        drawn.append((opening, colour, at, ts, x))
        rows.append((f"{opening}", f"{x[-1]:.4f}", f"{lost:.1e}"))
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained")
        for opening, colour, at, ts, x in drawn:
            left.plot(at[:, 0], at[:, 2], color=colour, lw=3, label=f"{opening} /m")
            right.plot(ts, x, color=colour)
        left.set(xlabel="x [m]", ylabel="z [m]", aspect="equal", title="Rails")
        right.set(xlabel="time [s]", ylabel="cart [m]", title="Where the cart is")
        left.legend(loc="upper center", ncols=len(drawn))
        figure.savefig(folder / "joints.png")
        plt.close(figure)
    return Section(
        title="Your own joints",
        text=(
            "A joint is defined by the pose of its body. Its axes and their rates follow. Screws, "
            "cylindrical, planar and universal joints are in the library. The parameters of a "
            "joint, here the opening of the rail, can be differentiated.",
        ),
        pictures=(("joints.png", "A cart with a hanging pole, let go at 1 m on three rails."),),
        columns=("opening [1/m]", "cart at the end [m]", "energy lost, of all"),
        rows=tuple(rows),
        code=_CODE,
    )
