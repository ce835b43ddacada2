"""Motions seen from above, and many samples in one picture."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.collections import LineCollection

import rbjax as rb
from docs.generate.pictures.motions import Frames, Size
from docs.generate.pictures.painting import COUNT
from rbjax import wheeled
from rbjax.plotting import GRID
from rbjax.plotting.from_above import Drawing, places
from rbjax.plotting.movie_files import canvas_of, picture


def first_hour(size: Size) -> Frames:
    """Two thousand double pendula from nearly the same start, in one rollout."""
    model, count, every = rb.load("double_pendulum"), 2000, 40
    start = model.default_state()
    tilt = jnp.array([2.0, 2.4]) + jnp.linspace(-1, 1, count)[:, None] * jnp.deg2rad(5.0)
    path = rb.rollout(
        model, rb.State(start.q + tilt, jnp.zeros((count, 2))), None, 0.002, integrator="rk4",
        steps=every * COUNT, save_every=every,
    )  # fmt: skip
    a, b = np.moveaxis(np.asarray(path.q), -1, 0)  # (count, F)
    elbow = np.stack([np.sin(a), -np.cos(a)], -1)
    tip = elbow + np.stack([np.sin(a + b), -np.cos(a + b)], -1)
    canvas, figure = canvas_of(size)
    ax = figure.add_axes((0, 0, 1, 1))
    colors = matplotlib.colormaps["viridis"](np.linspace(0, 0.95, count))
    uppers = LineCollection([], colors=colors, linewidths=0.6, alpha=0.12)
    lowers = LineCollection([], colors=colors, linewidths=0.6, alpha=0.12)
    tips = ax.scatter([], [], s=2.0, linewidths=0)
    tips.set_facecolor(colors)
    for lines in (uppers, lowers):
        ax.add_collection(lines)
    reach = 2.1
    ax.set(xlim=(-reach * size[0] / size[1], reach * size[0] / size[1]), ylim=(-reach, reach))
    ax.axis("off")
    for k in range(COUNT):
        uppers.set_segments(np.stack([np.zeros((count, 2)), elbow[:, k]], 1))
        lowers.set_segments(np.stack([elbow[:, k], tip[:, k]], 1))
        tips.set_offsets(tip[:, k])
        yield picture(canvas).copy()


def parking_a_trailer(size: Size) -> Frames:
    """A car pushes its trailer backwards along a curve, held by a regulator."""
    rig = wheeled.kinds()["car_trailer"].make(motor=wheeled.SpeedServo(3000.0))
    angle = jnp.linspace(0, 1.4, 90)
    way = jnp.stack([9 * jnp.sin(angle), 9 * (1 - jnp.cos(angle)), angle], -1)
    dt = 0.02
    steps = 600

    def outwards(t, state):
        wanted = wheeled.commands(rig, wheeled.pure_pursuit(way, state.q[:3], 1.0, 2.0))
        speed = 0.95 * (1 - jnp.cos(2 * jnp.pi * t / (dt * steps)))
        turn = wanted.angles[0] - state.q[rig.layout.steerings.start]
        return jnp.stack([speed * wanted.speeds[0], 3.0 * speed * turn])

    out = wheeled.at(rig, "kinematic")
    path = wheeled.rollout(out, wheeled.start(out), outwards, dt, steps=steps)
    given = jax.vmap(outwards)(path.ts[:-1], rb.State(path.q[:-1], path.v[:-1]))
    controls, model = -given[::-1], wheeled.at(rig, "reduced")
    speeds = jnp.append(controls[:, 0] * rig.wheels[0].radius, 0.0)
    reference = rb.State(path.q[::-1], speeds[:, None])
    weights = jnp.array([1.0, 1.0, 10.0, 10.0, 1.0] + [0.0] * (model.nq - 5) + [0.1])
    K = wheeled.tracking_gains(model, reference, controls, dt, weights, jnp.array([0.1, 1.0]))

    def inwards(t, state):
        k = jnp.clip(jnp.round(t / dt).astype(int), 0, steps - 1)
        error = jnp.concatenate([state.q - reference.q[k], state.v - reference.v[k]])
        error = error.at[rig.layout.shafts].set(0.0)
        u = controls[k] - K[k] @ error
        return jnp.stack([u[0], jnp.clip(u[1], -0.6, 0.6)])

    start = wheeled.start(model)
    start = start.replace(q=reference.q[0].at[1].add(0.3).at[3].add(0.1))
    found = wheeled.rollout(model, start, inwards, dt, steps=steps)
    index = np.round(np.linspace(0, steps, COUNT)).astype(int)
    q = np.asarray(found.q)[index]
    canvas, figure = canvas_of(size)
    ax = figure.add_axes((0, 0, 1, 1))
    track = np.asarray(reference.q)[:, :2]
    ax.plot(*track.T, "--", color="#9aa5b1", lw=1.2)
    drawing, where = Drawing(ax, rig), places(model, q)
    low, high = track.min(0) - np.array([7.0, 3.0]), track.max(0) + np.array([5.0, 3.0])
    middle, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half, half[::-1] * [size[0] / size[1], size[1] / size[0]])
    ax.set(xlim=(middle[0] - half[0], middle[0] + half[0]))
    ax.set(ylim=(middle[1] - half[1], middle[1] + half[1]))
    ax.set_facecolor("#f3f5f7")
    ax.grid(color=GRID)
    ax.tick_params(length=0, labelsize=0)
    ax.spines[:].set_visible(False)
    for k in range(COUNT):
        drawing.show(where.at(k))
        yield picture(canvas).copy()
