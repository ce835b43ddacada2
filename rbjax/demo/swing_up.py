"""Swing-up of the cart-pole: a control by gradients through the rollout.

    min over z of  mean over the last half second of (2 (1 - cos th) + x^2 + (v^2 + w^2) / 10)
                   + effort + a wall near the ends of the rail,      u = u_max tanh z
No dynamics are derived by hand: `jax.grad` of `rb.rollout`, and Adam.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

from rbjax.demo.report import Section
from rbjax.loading import load
from rbjax.model import Model, State
from rbjax.motion.rollout import rollout
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, STYLE, Camera, strobe
from rbjax.validation.reference import smooth, trajectory

DT, STEPS, HOLD, FORCE, RAIL = 0.01, 300, 50, 15.0, 1.6

_CODE = """\
def loss(z):
    path = rb.rollout(model, model.keyframe("down"), 15 * jnp.tanh(z), dt=0.01)
    return cost(path.q, path.v)

loss, slope = jax.value_and_grad(loss)(z)      # 300 steps of dynamics, differentiated"""


def optimise(model: Model, iterations: int, say: Callable[[str], None]) -> tuple[Any, Any]:
    """Controls (STEPS, 1), and the loss after each iteration."""
    start = model.keyframe("down")

    def controls(z: jax.Array) -> jax.Array:
        return FORCE * jnp.tanh(z)

    def loss(z: jax.Array) -> jax.Array:
        u = controls(z)
        path = rollout(model, start, u, DT)
        x, angle = path.q[-HOLD:, 0], path.q[-HOLD:, 1]
        still = (path.v[-HOLD:] ** 2).sum(-1)
        wall = jax.nn.relu(jnp.abs(path.q[:, 0]) - RAIL)
        end = (2 * (1 - jnp.cos(angle)) + x**2 + 0.1 * still).mean()
        return end + 1e-5 * (u**2).mean() + 10 * (wall**2).mean()

    rate = optax.cosine_decay_schedule(0.05, iterations)
    optimiser = optax.adam(rate)

    def descend(carry, _):
        z, memory = carry
        value, slope = jax.value_and_grad(loss)(z)
        update, memory = optimiser.update(slope, memory)
        return (optax.apply_updates(z, update), memory), value

    chunk = max(1, iterations // 10)
    run = jax.jit(lambda carry: jax.lax.scan(descend, carry, None, chunk))
    t = jnp.arange(STEPS)[:, None] * DT
    z = 0.1 * jnp.sin(2 * jnp.pi * t / 1.5)
    carry = (z, optimiser.init(z))
    losses: list[float] = []
    while len(losses) < iterations:
        carry, values = run(carry)
        losses += [float(x) for x in values]
        say(f"swing-up: iteration {len(losses)}, cost {losses[-1]:.4f}")
    return controls(carry[0]), np.array(losses)


def swing_up(folder: Path, say: Callable[[str], None], *, iterations: int = 2000) -> Section:
    """Optimise, check in MuJoCo C, draw."""
    say("swing-up: compiling the gradient of 300 steps")
    model = load("cart_pole")
    u, losses = optimise(model, iterations, say)
    start = model.keyframe("down")
    path = rollout(model, start, u, DT)
    q, forces = np.asarray(path.q), np.asarray(u)
    reference, _ = smooth("cart_pole")
    reference.opt.timestep = DT
    at = (np.asarray(start.q), np.asarray(start.v))
    theirs, _ = trajectory(reference, *at, forces, STEPS)
    gap = float(np.abs(theirs[-1] - q[-1]).max())
    _picture(folder / "swing_up.png", model, q, forces, losses, theirs)
    state = State(path.q[-1], path.v[-1])
    angle = float((state.q[1] + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    rows = (
        ("pole angle from upright", f"{np.degrees(angle):+.2f} deg"),
        ("cart position", f"{float(state.q[0]):+.4f} m"),
        ("cart velocity", f"{float(state.v[0]):+.4f} m/s"),
        ("pole rate", f"{float(state.v[1]):+.4f} rad/s"),
        ("largest force", f"{np.abs(forces).max():.1f} N"),
        ("MuJoCo C under the same forces, final difference", f"{gap:.1e}"),
    )
    text = (
        f"A cart can only be pushed left and right; its pole hangs down. {iterations:,} steps of "
        f"Adam on {STEPS} forces, with gradients through the whole rollout, find a push that "
        "swings the pole up and stops it there within 3 seconds. Open loop in MuJoCo C, the same "
        "forces give the same motion.",
    )
    return Section(
        "Design a control: swinging up a cart-pole",
        text,
        (("swing_up.png", "The motion found (top), states and force over time, and the cost."),),
        ("after 3 s", "value"),
        rows,
        code=_CODE,
    )


def _picture(path: Path, model: Model, q: Any, u: Any, losses: Any, theirs: Any) -> None:
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
        ax.plot(ts[::12], np.degrees(theirs[::12, 1]), "o", ms=3, color=INK, label="MuJoCo C")
        ax.set(xlabel="time [s]", ylabel="pole angle [deg]", title="Pole (0 and 360 deg are up)")
        ax.legend()
        ax = figure.add_subplot(grid[1, 1])
        ax.plot(ts[:-1], u[:, 0], color=BLUE, lw=1.6)
        ax.set(xlabel="time [s]", ylabel="force on the cart [N]", title="Control")
        ax = figure.add_subplot(grid[1, 2])
        ax.semilogy(losses, color=GREEN, lw=1.8)
        ax.set(xlabel="iteration", ylabel="cost", title="Adam on gradients of rollout")
        figure.savefig(path)
        plt.close(figure)
