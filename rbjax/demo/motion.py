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

from rbjax.contact import ContactForces, solve
from rbjax.demo.report import ReportSection
from rbjax.loading import compile_model, load
from rbjax.model import Model, State
from rbjax.motion.rollout import rollout
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting import STYLE, Camera, strobe


def trot(t: jax.Array) -> jax.Array:
    """Return the joint angles (12,) of a quadruped that trots with strides of 0.2 m.

    Diagonal legs swing together. Thigh and shank are 0.22 m long, the hips 0.363 m above the feet.
    """
    phase = (t / 0.4 + jnp.array([0.0, 0.5, 0.5, 0.0])) % 1.0
    swing, s, grown = phase < 0.5, 2 * phase % 1.0, jnp.minimum(t / 0.8, 1.0)
    x = 0.2 * grown * jnp.where(swing, -0.5 * jnp.cos(jnp.pi * s), 0.5 - s)
    z = grown * jnp.where(swing, 0.06 * jnp.sin(jnp.pi * s) ** 2, 0.0) - 0.363
    knee = -2 * jnp.arccos(jnp.hypot(x, z) / 0.44)
    return jnp.stack([0 * x, jnp.arctan2(-x, -z) - knee / 2, knee], -1).ravel()


def touching(scene: str, part: str = "foot") -> Model:
    """Load a bundled robot of which only some geoms can touch the floor, and nothing else.

    part: a part of the names of the geoms that touch; "" for all.
    """
    m = compile_model(scene)
    for k in range(m.ngeom):
        name = m.geom(k).name
        m.geom_conaffinity[k] = name == "floor"
        m.geom_contype[k] = name != "floor" and part in name
    return load(m)


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
    scene: str = ""  # if it differs from the name
    touch: str | None = None  # a part of the names of the geoms that touch the floor
    angles: str | Callable[[jax.Array], jax.Array] | None = None  # a keyframe, or of the time
    gains: tuple[float, float] = (0.0, 0.0)  # N m/rad, N m s/rad of motors that hold the angles


SHOWS = {
    "trot": Show(
        "stand",
        2.4,
        0.1,
        0.004,
        Camera(-75, 12),
        5,
        scene="quadruped",
        touch="foot",
        angles=trot,
        gains=(200.0, 5.0),
    ),
    "stand": Show(
        "stand",
        1.0,
        0.05,
        0.004,
        Camera(-60, 12),
        2,
        scene="humanoid",
        touch="foot",
        angles="stand",
        gains=(300.0, 10.0),
    ),
    "fall": Show(
        "stand",
        1.2,
        0.2,
        0.004,
        Camera(-75, 12),
        4,
        (1.8, 0, 0.5, 0, 1.5, 0),
        scene="humanoid",
        touch="",
    ),
    "cart_pole": Show("up", 1.2, 0.3, 0.005, Camera(-90, 8), 9, (0.6, 1.0)),
    "arm7": Show("home", 0.6, 0.5, 0.002, Camera(-60, 15), 6, (2.0, 1.5, 0, -2.0), "link7"),
    "quadrotor": Show(
        "hover", 1.2, 0.3, 0.005, Camera(-60, 20), 6, (1.5, 0.5, 2.0, 0, 0, 3.0), "frame"
    ),
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


def controls(model: Model, show: Show) -> Callable[[jax.Array, State], jax.Array]:
    """Return a policy: the controls of the keyframe, and springs and dampers that hold angles."""
    constant = model.keyframes.ctrl[model.keyframe_names.index(show.keyframe)]
    if show.angles is None:
        return lambda t, state: constant
    (stiffness, damping), gear = show.gains, model.actuators.gear[:, 0]
    angles = model.keyframe(show.angles).q[7:] if isinstance(show.angles, str) else show.angles

    def hold(t: jax.Array, state: State) -> jax.Array:
        due = angles(t) if callable(angles) else angles
        return (stiffness * (due - state.q[7:]) - damping * state.v[6:]) / gear

    return hold


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
            strobe(
                model, q, ax=ax, source=show.scene or scene, camera=show.camera, trace=show.trace,
                shadow=model.nv > 2, ground=show.touch is not None, contacts=flight.contacts(path),
            )  # fmt: skip
            title = f"{show.scene}: {scene}" if show.scene else scene
            ax.set_title(f"{title.replace('_', ' ')}, {model.nv} dof")
            rows.append(
                (title.replace("_", " "), f"{model.nv}", f"{batch}", f"{steps}", f"{rate:,.0f}")
            )
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
    ctrl: Callable[[jax.Array, State], jax.Array]
    program: Callable[[State], Trajectory]

    @classmethod
    def of(cls, scene: str, batch: int) -> Flight:
        """Compile the rollout of a scene, in f32."""
        with jax.enable_x64(False):  # this setting is per thread
            show = SHOWS[scene]
            name = show.scene or scene
            model = load(name) if show.touch is None else touching(name, show.touch)
            if model.nv > 4 and model.contact is None:
                model = model.replace(driver="rolled")
            state = initial_states(model, show, batch)
            steps, ctrl = round(show.seconds / show.dt), controls(model, show)
            run = jax.jit(lambda state: rollout(model, state, ctrl, show.dt, steps=steps))
            return cls(model, state, steps, ctrl, run.lower(state).compile())

    def contacts(self, path: Trajectory) -> ContactForces | None:
        """Solve for the contact forces at the end of the first robot's motion."""
        if self.model.contact is None:
            return None
        last = State(path.q[0, -1], path.v[0, -1])
        return jax.jit(lambda t, state: solve(self.model, state, self.ctrl(t, state)).contacts)(
            path.ts[-1], last
        )

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
) -> ReportSection:
    """Simulate batches of the scenes and draw them. Return the section of the report."""
    with jax.enable_x64(False):
        rows = gallery(folder, say, batch=batch, scenes=scenes)
    return ReportSection(
        "Simulate a batch",
        ("A robot file goes in, a batch of motions comes out. Below is one of each batch.",),
        (
            (
                "gallery.png",
                "One of each batch, drawn by rbjax with matplotlib, no GL. Red: contact forces.",
            ),
        ),
        ("scene", "dof", "robots", "steps each", "steps a second (f32, this machine)"),
        rows,
        note="The robots on the ground take steps with contacts. Red: contact forces at the end.",
        code="states = rb.State(q, v)          # (256, nq), (256, nv): a leading axis is a batch\n"
        "path = rb.rollout(model, states, ctrls, 0.002)",
    )
