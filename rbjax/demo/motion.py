"""A batch of motions of every bundled scene, drawn without OpenGL."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax.demo.report import Section
from rbjax.loading import load
from rbjax.model import Model, State
from rbjax.motion.rollout import rollout
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting import STYLE, Camera, strobe


@dataclass(frozen=True)
class Show:
    """The initial state, the duration and the view of a scene."""

    keyframe: str
    seconds: float
    spread: float  # of the batch's initial velocities
    dt: float
    camera: Camera
    drawn: int  # number of poses
    push: tuple[float, ...] = ()  # added to the keyframe's first velocities
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


def initial_states(model: Model, show: Show, batch: int) -> State:
    """Draw random initial states around `show`; the first is exactly as in `show`."""
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
    """Draw a panel for each scene. Return rows (scene, dof, robots, steps, steps per second)."""
    rows = []
    with plt.rc_context(STYLE):
        columns = min(3, len(scenes))
        shape = (-(-len(scenes) // columns), columns)
        figure, axes = plt.subplots(*shape, figsize=(11, 6.4), layout="constrained", squeeze=False)
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
        """Compile the rollout of a scene, in f32."""
        with jax.enable_x64(False):  # this setting is per thread
            show, model = SHOWS[scene], load(scene)
            if model.nv > 4:
                model = model.replace(driver="rolled")
            state = initial_states(model, show, batch)
            steps = round(show.seconds / show.dt)
            ctrl = model.keyframes.ctrl[model.keyframe_names.index(show.keyframe)]
            ctrls = jnp.broadcast_to(ctrl, (steps, model.nu))
            run = jax.jit(lambda state: rollout(model, state, ctrls, show.dt))
            return cls(model, state, steps, run.lower(state).compile())

    def timed(self) -> tuple[Trajectory, float]:
        """Run the rollout. Return the motion, and the number of steps per second."""
        path = jax.block_until_ready(self.program(self.state))
        begin = time.perf_counter()
        jax.block_until_ready(self.program(self.state))
        return path, path.q.shape[0] * self.steps / (time.perf_counter() - begin)


def motion(
    folder: Path,
    say: Callable[[str], None],
    *,
    batch: int = 256,
    scenes: tuple[str, ...] = tuple(SHOWS),
) -> Section:
    """Simulate batches of the scenes and draw them. Return the section of the report."""
    with jax.enable_x64(False):
        rows = gallery(folder, say, batch=batch, scenes=scenes)
    return Section(
        "Simulate a batch",
        ("A robot file goes in, a batch of motions comes out. Below is one of each batch.",),
        (("gallery.png", "One of each batch, drawn by rbjax with matplotlib, no GL."),),
        ("scene", "dof", "robots", "steps each", "steps a second (f32, this machine)"),
        rows,
        note="Robots are in free flight; the next section has contacts.",
        code="states = rb.State(q, v)          # (256, nq), (256, nv): a leading axis is a batch\n"
        "path = rb.rollout(model, states, ctrls, 0.002)",
    )
