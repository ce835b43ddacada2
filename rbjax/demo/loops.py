"""Loops: a parallelogram of three rods that passes its dead points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax import constraints
from rbjax.demo.report import Section
from rbjax.dynamics import kinetic_energy, potential_energy
from rbjax.loading import load
from rbjax.motion.rollout import rollout
from rbjax.plotting import BLUE, ORANGE, STYLE

STEPS, DT = 4000, 1e-3
NAMES = {"projected": BLUE, "multipliers": ORANGE}

_CODE = """\
model = rb.load("four_bar")         # its <connect> is a constraint of the model
state = model.keyframe("turning")
path = rb.rollout(model, state, None, 1e-3, steps=4000, integrator="rk4")
force = rb.constraints.joint_wrenches(model, path.state(-1))
soft = rb.rollout(model, state, None, 1e-3, steps=4000, constraints="baumgarte")"""


def loops(folder: Path, say: Callable[[str], None], *, steps: int = STEPS) -> Section:
    """Run and draw."""
    say("a four-bar through its dead points")
    model = load("four_bar")
    start = model.keyframe("turning")
    some = max(1, steps // 200)
    rows, drawn = [], []

    def seen(path):
        def one(q, v):
            energy = kinetic_energy(model, q, v) + potential_energy(model, q)
            state = start.replace(q=q, v=v)
            return energy, jnp.abs(constraints.residual(model, state).value).max()

        return jax.vmap(one)(path.q, path.v)

    for name in NAMES:

        def run(state, name=name):
            return rollout(
                model, state, None, DT, steps=steps, integrator="rk4", save_every=some,
                constraints=name,
            )  # fmt: skip

        path = jax.jit(run)(start)  # knows the model: a tenth of the program
        energy, off = map(np.asarray, jax.jit(seen)(path))
        lost = np.abs(energy - energy[0]).max()
        drawn.append((name, np.asarray(path.ts), np.asarray(path.q[:, 0]), off))
        rows.append((name, f"{off.max():.0e}", f"{lost:.0e}"))
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4), layout="constrained")
        for name, ts, angle, off in drawn:
            left.plot(ts, angle / (2 * np.pi), color=NAMES[name], label=name)
            right.semilogy(ts, off + 1e-17, color=NAMES[name])
        left.set(xlabel="time [s]", ylabel="turns", title="The left rod")
        right.set(xlabel="time [s]", ylabel="gap [m]", title="How far the loop is open")
        left.legend()
        figure.savefig(folder / "loops.png")
        plt.close(figure)
    return Section(
        title="Loops",
        text=(
            "Three rods of 1 m on the ground form a parallelogram. Twice a turn it is flat, and "
            "its constraints lose rank. The connect of the file holds as a constraint. "
            "'projected', the default, puts each state back on it. 'multipliers' solves only for "
            "accelerations, so that the gap grows.",
        ),
        pictures=(("loops.png", "A parallelogram that turns, and the gap of its loop."),),
        columns=("formulation", "largest gap [m]", "energy lost [J]"),
        rows=tuple(rows),
        code=_CODE,
    )
