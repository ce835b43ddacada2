"""A batch in motion: hundreds of copies of every bundled scene, drawn without GL."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax.demo.report import Section
from rbjax.loading import load
from rbjax.model import Model, State
from rbjax.motion.rollout import rollout
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting import BLUE, ORANGE, STYLE, Camera, bare, poses, strobe


@dataclass(frozen=True)
class Show:
    """The start and the view of a scene."""

    keyframe: str
    seconds: float
    spread: float  # of the batch's initial velocities
    dt: float
    camera: Camera
    drawn: int  # poses
    push: tuple[float, ...] = ()  # added to the first velocities
    trace: str | None = None


SHOWS = {
    "pendulum": Show("horizontal", 1.0, 0.5, 0.005, Camera(-90, 8), 9),
    "cart_pole": Show("up", 1.2, 0.3, 0.005, Camera(-90, 8), 9, (0.6, 1.0)),
    "arm7": Show("home", 0.6, 0.5, 0.002, Camera(-60, 15), 6, (2.0, 1.5, 0, -2.0), "link7"),
    "quadrotor": Show(
        "hover", 1.2, 0.3, 0.005, Camera(-60, 20), 6, (1.5, 0.5, 2.0, 0, 0, 3.0), "frame"
    ),
    "quadruped": Show("stand", 0.6, 0.3, 0.004, Camera(-80, 10), 4, (2.4, 0, 3.0, 0, 1.5, 0)),
    "humanoid": Show("stand", 1.0, 0.2, 0.004, Camera(-90, 8), 6, (2.6, 0, 4.6, 0, 6.0, 0)),
}


def launched(model: Model, show: Show, batch: int) -> State:
    """The first of the batch exactly as shown, the others around it."""
    rng = np.random.default_rng(1)
    state = model.keyframe(show.keyframe)
    noise = show.spread * rng.normal(size=(batch, model.nv))
    noise[0] = 0.0
    push = np.zeros(model.nv)
    push[: len(show.push)] = show.push
    q = jnp.broadcast_to(state.q, (batch, model.nq))
    return State(q, jnp.asarray(np.asarray(state.v) + push + noise, q.dtype))


def gallery(
    folder: Path, say: Callable[[str], None], *, batch: int, scenes: tuple[str, ...] = tuple(SHOWS)
) -> tuple[tuple[str, ...], ...]:
    """One panel a scene; rows (scene, coordinates, robots, steps a second)."""
    rows = []
    with plt.rc_context(STYLE):
        columns = min(3, len(scenes))
        shape = (-(-len(scenes) // columns), columns)
        figure, axes = plt.subplots(
            *shape, figsize=(11, 6.4), layout="constrained", squeeze=False
        )
        say(f"motion: compiling {batch} x {', '.join(scenes)}")
        with ThreadPoolExecutor(2) as pool:  # XLA compiles one while Python traces another
            flights = list(pool.map(lambda scene: Flight.of(scene, batch), reversed(scenes)))[::-1]
        for ax, scene, flight in zip(axes.flat, scenes, flights, strict=False):
            say(f"motion: {batch} x {scene}")
            show, model, steps = SHOWS[scene], flight.model, flight.steps
            path, rate = flight.timed()
            moments = np.linspace(0, steps, show.drawn).astype(int)
            q = np.asarray(path.q[0])[moments]
            strobe(ax, scene, model, q, camera=show.camera, trace=show.trace, shadow=model.nv > 2)
            ax.set_title(f"{scene.replace('_', ' ')}, {model.nv} dof")
            rows.append((scene, f"{model.nv}", f"{batch}", f"{steps}", f"{rate:,.0f}"))
        for ax in axes.flat[len(scenes) :]:
            ax.axis("off")
        figure.savefig(folder / "gallery.png")
        plt.close(figure)
    return tuple(rows)


@dataclass(frozen=True)
class Flight:
    """A compiled rollout of a scene's batch."""

    model: Model
    state: State
    steps: int
    program: Callable[[State], Trajectory]

    @classmethod
    def of(cls, scene: str, batch: int) -> Flight:
        """In f32."""
        with jax.enable_x64(False):  # which is a thread's own
            show, model = SHOWS[scene], load(scene)
            if model.nv > 4:
                model = model.replace(driver="rolled")
            state = launched(model, show, batch)
            steps = round(show.seconds / show.dt)
            ctrl = model.keyframes.ctrl[model.keyframe_names.index(show.keyframe)]
            ctrls = jnp.broadcast_to(ctrl, (steps, model.nu))
            run = jax.jit(lambda state: rollout(model, state, ctrls, show.dt))
            return cls(model, state, steps, run.lower(state).compile())

    def timed(self) -> tuple[Trajectory, float]:
        """The motion, and its steps a second."""
        path = jax.block_until_ready(self.program(self.state))
        begin = time.perf_counter()
        jax.block_until_ready(self.program(self.state))
        return path, path.q.shape[0] * self.steps / (time.perf_counter() - begin)


def chaos(folder: Path, say: Callable[[str], None], *, batch: int, seconds: float = 10.0) -> str:
    """Nearly equal double pendulums, and precessing tops; returns a sentence on the former."""
    say(f"motion: {batch} double pendulums, a millionth of a radian apart")
    model = load("double_pendulum")
    spread = 1e-6 * jnp.linspace(-0.5, 0.5, batch)
    q = jnp.array([2.8, -0.4]) + spread[:, None] * jnp.array([1.0, 0.0])
    steps = round(seconds / 0.002)

    def pendulums(state):  # compiled with the model known, a smaller program
        return rollout(model, state, None, 0.002, integrator="rk4", save_every=5, steps=steps)

    path = jax.jit(pendulums)(State(q, jnp.zeros_like(q)))
    ts, angles = np.asarray(path.ts), np.asarray(path.q)
    say("motion: a fan of spinning tops")
    top = load("spinning_top")
    spins = jnp.array([350.0, 500.0, 900.0])
    held = top.keyframe("spinning")
    v = jnp.stack([0 * spins, 0 * spins, spins], -1)

    def spun(state):
        return rollout(
            top, state, None, 0.0005,
            integrator="rk4", save_every=5, steps=5 * round(200 * seconds),
        )  # fmt: skip

    tops = jax.jit(spun)(State(jnp.broadcast_to(held.q, (3, 4)), v))
    _chaos_picture(folder / "chaos.png", ts, angles)
    _tops_picture(folder / "tops.png", top, np.asarray(tops.q), np.asarray(spins))
    apart = np.abs(angles[-1] - angles[0]).max(-1)
    i = int(np.argmax(apart > 1)) if (apart > 1).any() else len(ts) - 1
    return f"a millionth of a radian becomes {apart[i]:.1f} rad after {ts[i]:.1f} s"


def _chaos_picture(path: Path, ts: Any, angles: Any) -> None:
    x = np.sin(angles[..., 0]) + np.sin(angles.sum(-1))
    z = -np.cos(angles[..., 0]) - np.cos(angles.sum(-1))
    colors = plt.get_cmap("viridis")(np.linspace(0.05, 0.9, len(x)))
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(
            1, 2, figsize=(11, 4.6), width_ratios=(1, 1.7), layout="constrained"
        )
        late = len(ts) - 1
        elbow = np.stack([np.sin(angles[:, late, 0]), -np.cos(angles[:, late, 0])], -1)
        for i in range(0, len(x), max(1, len(x) // 160)):
            xs, zs = [0, elbow[i, 0], x[i, late]], [0, elbow[i, 1], z[i, late]]
            left.plot(xs, zs, color=colors[i], lw=0.8, alpha=0.5)
        left.scatter(x[:, late], z[:, late], s=9, c=colors, zorder=3, lw=0)
        left.plot([0], [0], "o", color="#22303c", ms=6)
        left.set(xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), aspect="equal", xlabel="x [m]", ylabel="z [m]")
        left.set_title(f"{len(x)} pendulums after {ts[-1]:.0f} s")
        for i in range(len(x)):
            right.plot(ts, angles[i].sum(-1), color=colors[i], lw=0.5, alpha=0.35)
        right.set(xlabel="time [s]", ylabel="angle of the lower rod [rad]", xlim=(0, ts[-1]))
        right.set_title("One motion, until it is not")
        figure.savefig(path)
        plt.close(figure)


def _tops_picture(path: Path, model: Model, q: Any, spins: Any) -> None:
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(11, 4.0), layout="constrained")
        grid = figure.add_gridspec(1, len(spins) + 1)
        camera = Camera(-60, 22)
        tips = [0.4 * poses(model, x)[0][:, 0, :, 2] for x in q]
        ax = figure.add_subplot(grid[0])
        strobe(ax, "spinning_top", model, q[1, -1:], camera=camera)
        path_seen = tips[1] @ camera.axes[:2].T
        ax.plot(*path_seen.T, color=BLUE, lw=1.0, zorder=9)
        bare(ax)
        ax.set_title("A heavy top and its tip's path")
        for i, (spin, tip) in enumerate(zip(spins, tips, strict=True)):
            ax = figure.add_subplot(grid[1 + i])
            ax.plot(tip[:, 0], tip[:, 1], color=BLUE, lw=1.0)
            ax.plot(*tip[0, :2], "o", color=ORANGE, ms=5)
            ax.set(aspect="equal", xlabel="x of the tip [m]", title=f"spin {spin:.0f} rad/s")
            ax.set(xlim=(-0.19, 0.19), ylim=(-0.19, 0.19))
            if i == 0:
                ax.set(ylabel="y of the tip [m]")
        figure.savefig(path)
        plt.close(figure)


def motion(
    folder: Path,
    say: Callable[[str], None],
    *,
    batch: int = 256,
    fan: int = 500,
    seconds: float = 10.0,
    scenes: tuple[str, ...] = tuple(SHOWS),
) -> Section:
    """Simulate, draw."""
    growth = chaos(folder, say, batch=fan, seconds=seconds)
    with jax.enable_x64(False):
        rows = gallery(folder, say, batch=batch, scenes=scenes)
    text = (
        f"A robot file goes in, a batch of motions comes out. {fan} double pendulums start within "
        f"a millionth of a radian: {growth}. Three tops, released at rest except for their spin, "
        "nod and precess; the faster the spin, the finer the path. Below is one of each batch.",
    )
    return Section(
        "Simulate a batch",
        text,
        (
            ("chaos.png", f"{fan} double pendulums in one rollout (RK4, f64), coloured by start."),
            ("tops.png", "Nutation and precession of a heavy top, seen from above (RK4)."),
            ("gallery.png", "One of each batch, drawn by rbjax with matplotlib, no GL."),
        ),
        ("scene", "dof", "robots", "steps each", "steps a second (f32, this machine)"),
        rows,
        note="Robots are in free flight: rbjax has no contact yet.",
        code="states = rb.State(q, v)          # (500, nq), (500, nv): a leading axis is a batch\n"
        'path = rb.rollout(model, states, None, 0.002, integrator="rk4", steps=5000)',
    )  # fmt: skip
