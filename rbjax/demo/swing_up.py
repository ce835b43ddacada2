"""Swing-up of the cart-pole: a control and its feedback by `rbjax.control`.

    min  sum_k h c u_k^2 / 2 + w |x_N (-) x_up|^2 / 2,      |u_k| <= u_max

by differential dynamic programming from no force at all. The gains that come with the solution
bring up a pole that starts elsewhere. No dynamics are derived by hand.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax import control
from rbjax.demo.report import Section
from rbjax.loading import load
from rbjax.model import Model, State
from rbjax.motion.rollout import rollout
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, STYLE, Camera, strobe
from rbjax.validation.reference import smooth, trajectory

DT, STEPS, FORCE, OFF = 0.02, 150, 5.0, 0.1

_CODE = """\
effort, end = Cost(Control(), 0.02), Cost(StateError(model.keyframe("up")), 100.0)
problem = Problem(model, 150, 0.02, bounds=(-5, 5), running=[effort], terminal=[end])
found = rb.control.solve(problem, model.keyframe("down"))
rb.rollout(model, elsewhere, found.policy(), dt=0.02, steps=150)     # with its feedback"""


def swing_up(folder: Path, say: Callable[[str], None], *, iterations: int = 500) -> Section:
    """Solve, check in MuJoCo C, push, draw."""
    say("swing-up: compiling and solving a problem of optimal control")
    model = load("cart_pole")
    start, up = model.keyframe("down"), model.keyframe("up")
    problem = control.Problem(
        model, STEPS, DT, bounds=(-FORCE, FORCE),
        running=[control.Cost(control.Control(), 0.02)],
        terminal=[control.Cost(control.StateError(up), 100.0)],
    )  # fmt: skip
    found = control.solve(problem, start, iterations=iterations, tolerance=1e-7)
    path = rollout(model, start, found.ctrls, DT)
    q, forces = np.asarray(path.q), np.asarray(found.ctrls)
    say("swing-up: the same from another start, with and without feedback")
    elsewhere = State(start.q.at[1].add(OFF), start.v)
    blind = np.asarray(rollout(model, elsewhere, found.ctrls, DT).q)
    seeing = np.asarray(rollout(model, elsewhere, found.policy(), DT, steps=STEPS).q)
    reference, _ = smooth("cart_pole")
    reference.opt.timestep = DT
    theirs, _ = trajectory(reference, np.asarray(start.q), np.asarray(start.v), forces, STEPS)
    gap = float(np.abs(theirs[-1] - q[-1]).max())
    count = int(found.iterations)
    costs = np.asarray(found.costs)[:count]
    _picture(folder / "swing_up.png", model, q, forces, costs, theirs, blind, seeing)
    last = State(path.q[-1], path.v[-1])
    rows = (
        ("pole angle from upright", f"{np.degrees(_turn(last.q[1])):+.2f} deg"),
        ("cart position", f"{float(last.q[0]):+.4f} m"),
        ("cart velocity", f"{float(last.v[0]):+.4f} m/s"),
        ("pole rate", f"{float(last.v[1]):+.4f} rad/s"),
        ("largest force", f"{np.abs(forces).max():.1f} N"),
        ("MuJoCo C under the same forces, final difference", f"{gap:.1e}"),
        ("pole angle from another start, open loop", f"{np.degrees(_turn(blind[-1, 1])):+.1f} deg"),
        ("the same with feedback", f"{np.degrees(_turn(seeing[-1, 1])):+.1f} deg"),
    )
    text = (
        f"A cart can only be pushed left and right, with {FORCE:.0f} N at most; its pole hangs "
        f"down. {count} iterations of differential dynamic programming, from no force at all, find "
        f"{STEPS} forces that swing the pole up and stop it there within {DT * STEPS:.0f} seconds "
        f"({found.summary()}). Open loop in MuJoCo C, the same forces give the same motion. The "
        f"solution has feedback gains, too: from a start that is {OFF} rad off, the forces miss, "
        "and the feedback brings the pole up.",
    )
    return Section(
        "Design a control: swinging up a cart-pole",
        text,
        (("swing_up.png", "The motion found (top), the pole, the force, and the cost."),),
        (f"after {DT * STEPS:.0f} s", "value"),
        rows,
        code=_CODE,
    )


def _turn(angle: Any) -> float:
    """An angle from upright, in (-pi, pi]."""
    return float((angle + jnp.pi) % (2 * jnp.pi) - jnp.pi)


def _picture(
    path: Path, model: Model, q: Any, u: Any, costs: Any, theirs: Any, blind: Any, seeing: Any
) -> None:
    ts = DT * np.arange(len(q))
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(11, 7.2), layout="constrained")
        grid = figure.add_gridspec(2, 3, height_ratios=(1.1, 1))
        top = figure.add_subplot(grid[0, :])
        moments = np.unique(np.linspace(0, len(q) - 1, 26).astype(int))
        strobe(top, "cart_pole", model, q[moments], camera=Camera(-90, 8), shadow=False)
        tip = np.stack([q[:, 0] + np.sin(q[:, 1]), np.cos(q[:, 1]) * np.cos(np.radians(8))], -1)
        top.plot(tip[:, 0], tip[:, 1] + np.cos(np.radians(8)), color=ORANGE, lw=1.2, alpha=0.8)
        top.set_title("From hanging to balanced, drawn every 0.12 s")
        ax = figure.add_subplot(grid[1, 0])
        ax.plot(ts, np.degrees(q[:, 1]), color=ORANGE, lw=2, label="rbjax")
        ax.plot(ts[::6], np.degrees(theirs[::6, 1]), "o", ms=3, color=INK, label="MuJoCo C")
        ax.plot(ts, np.degrees(seeing[:, 1]), color=GREEN, lw=1.2, label=f"{OFF} rad off, feedback")
        ax.plot(ts, np.degrees(blind[:, 1]), "--", color=BLUE, lw=1.2, label="the same, open loop")
        ax.set(xlabel="time [s]", ylabel="pole angle [deg]", title="Pole (0 is up)")
        ax.legend(fontsize=7)
        ax = figure.add_subplot(grid[1, 1])
        ax.step(ts[:-1], u[:, 0], where="post", color=BLUE, lw=1.6)
        ax.set(xlabel="time [s]", ylabel="force on the cart [N]", title="Control")
        ax = figure.add_subplot(grid[1, 2])
        ax.semilogy(costs, color=GREEN, lw=1.8)
        ax.set(xlabel="iteration", ylabel="cost", title="Cost by iteration")
        figure.savefig(path)
        plt.close(figure)
