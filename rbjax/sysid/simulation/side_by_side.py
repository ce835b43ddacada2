"""The motion of equal parts of a set-up that do not act on each other, each a sample of a batch.

Four legs on a held base are one leg under four sets of numbers. The program is that of one leg, so
it is short, and the legs run at the same time. A number on which all parts agree is known to the
program; one in which they differ is an argument.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.model import WORLD, Model, State, Topology
from rbjax.model.model import Actuators, Bodies, Joints, Keyframes, Sites
from rbjax.motion.integrators import loop_stages
from rbjax.sysid.simulation.islands import islands_of
from rbjax.sysid.simulation.setup import PD, Calibration, Grid, Path, Setup, motion, ready, stepped


class Part(NamedTuple):
    """One island: its joints, bodies (those fixed to the world, too), actuators, and the rows of
    each force element."""

    joints: np.ndarray
    bodies: np.ndarray
    actuators: np.ndarray
    rows: tuple[np.ndarray, ...]


def equal_parts(setup: Setup) -> tuple[Part, ...] | None:
    """The parts of a set-up, where there are several and all have one shape."""
    islands = islands_of(setup)
    if islands is None or setup.model.joints.params.size:
        return None
    model, top = setup.model, setup.model.topology
    of_body = np.array([islands[i] if i != WORLD else -1 for i in top.body_links])
    parts = []
    for island in range(islands.max() + 1):
        joints = np.flatnonzero(islands == island)
        bodies = np.flatnonzero((of_body == island) | (of_body == -1))
        actuators = np.flatnonzero(np.isin(model.actuators.joints, joints))
        rows = tuple(
            np.flatnonzero(np.isin([model.joint(j) for j in e.joints], joints))
            for e in model.forces
        )
        parts.append(Part(joints, bodies, actuators, rows))
    driven = sum(len(part.actuators) for part in parts) == model.nu
    shapes = {_shape(model, part) for part in parts}
    return tuple(parts) if driven and len(shapes) == 1 else None


def _shape(model: Model, part: Part) -> tuple:
    """All that the program of a part knows beside numbers."""
    top, at = model.topology, list(part.joints)
    body = {int(b): k for k, b in enumerate(part.bodies)} | {WORLD: WORLD}
    return (
        tuple(body[top.body_parents[b]] for b in part.bodies),
        tuple(top.joint_kinds[j] for j in at),
        tuple(body[top.joint_bodies[j]] for j in at),
        tuple(at.index(model.actuators.joints[k]) for k in part.actuators),
        tuple(
            tuple(at.index(model.joint(e.joints[k])) for k in rows)
            for e, rows in zip(model.forces, part.rows, strict=True)
        ),
    )


def cut(setup: Setup, part: Part) -> Setup:
    """The set-up of a part. Its names are numbers, so that equal parts are equal programs."""
    model, top, at = setup.model, setup.model.topology, part.joints
    parents, kinds, bodies, driven, acting = _shape(model, part)
    of_bodies, of_joints, of_controls = (
        tuple(map(str, range(len(x)))) for x in (parents, kinds, driven)
    )
    topology = Topology(
        parents, kinds, bodies, of_bodies, of_joints, of_controls,
        joints=tuple(top.joints[j] for j in at),
    )  # fmt: skip

    def rows(record: Any, kind: Any, which: np.ndarray, **more: Any) -> Any:
        taken = {k: _taken(x, which) for k, x in _leaves(record) if k not in more}
        return kind(**taken, **more)

    zero: Any = np.zeros
    n, nu = len(at), len(driven)
    act = rows(model.actuators, Actuators, part.actuators, joints=driven, sites=(-1,) * nu)
    small = Model(
        bodies=rows(model.bodies, Bodies, part.bodies),
        joints=rows(model.joints, Joints, at, params=zero(0)), actuators=act,
        sites=Sites(zero((0, 3)), zero((0, 4))),
        keyframes=Keyframes(zero((0, n)), zero((0, n)), zero((0, nu))),
        gravity=model.gravity, topology=topology, timestep=model.timestep, dropped=(),
        forces=tuple(
            rows(e, type(e), which, joints=those)
            for e, which, those in zip(model.forces, part.rows, acting, strict=True)
        ),
    )  # fmt: skip
    sensors = {
        k: Calibration(_taken(s.bias, at), _taken(s.scale, at), s.delay)
        for k, s in setup.sensors.items() if k in ("q", "v")
    }  # fmt: skip
    servo = setup.controller
    if isinstance(servo, PD):
        servo = PD(_taken(servo.kp, part.actuators), _taken(servo.kd, part.actuators))
    return Setup(small, sensors, servo, setup.delay)


def motion_of_parts(
    parts: tuple[Part, ...] | None, made: Callable[[jax.Array], Setup], p: jax.Array, start: State,
    commands: jax.Array, grid: Grid, *, keep: int | None = None, count: int = 1,
) -> Path:  # fmt: skip
    """As `motion`, of equal parts side by side; parts None: of the whole."""
    if parts is None:
        return motion(made, p, start, commands, grid, keep=keep, count=count)
    now = made(p)
    each = [jax.tree.flatten(cut(now, part)) for part in parts]
    tree: Any = each[0][1]
    plan, still, moving = _split([leaves for leaves, _ in each])

    if isinstance(grid.integrator, str):  # of a small part, too, a short program is what pays
        grid = grid._replace(integrator=loop_stages(grid.integrator))

    def part(numbers: tuple[jax.Array, jax.Array]) -> Setup:
        return ready(jax.tree.unflatten(tree, [f(*numbers) for f in plan]))

    def one(numbers: tuple[jax.Array, jax.Array], start: State, commands: jax.Array) -> Any:
        return stepped(part, numbers, start, commands, grid, keep, count)

    at = np.stack([part.joints for part in parts])
    driven = np.stack([part.actuators for part in parts])
    starts = State(start.q[at], start.v[at])
    each_commands = commands.T[driven].swapaxes(1, 2)
    states, ctrls = jax.vmap(one)((still, moving), starts, each_commands)

    def together(x: jax.Array, which: np.ndarray) -> jax.Array:
        """(T, n) of (parts, T, n of a part)."""
        return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1)[:, np.argsort(which.ravel())]

    asked = commands if ctrls is None else together(ctrls, driven)
    return Path(together(states.q, at), together(states.v, at), None, asked)


def _split(each: list[list[Any]]) -> tuple[list[Callable], jax.Array, jax.Array]:
    """For each leaf a function that makes it of two vectors; the vectors (parts, n) of what is
    known and differs, and of what is traced."""
    plan: list[Callable] = []
    still: list[Any] = []
    moving: list[Any] = []

    def kept(column: Any, into: list[Any]) -> int:
        into.append(column)
        return len(into) - 1

    for leaves in zip(*each, strict=True):
        traced = any(isinstance(x, jax.core.Tracer) for x in leaves)
        rows: Any = [x.ravel() if traced else np.ravel(x) for x in map(_array, leaves)]
        rows = jnp.stack(rows) if traced else np.stack(rows)
        entries: list[Any] = []
        for k in range(rows.shape[1]):
            column = rows[:, k]
            alike = not traced and (column == column[0]).all()
            entries.append(
                column[0] if alike else (traced, kept(column, moving if traced else still))
            )
        plan.append(_maker(entries, np.shape(leaves[0]), _array(leaves[0]).dtype))
    vectors = [jnp.stack(x, 1) if x else jnp.zeros((len(each), 0)) for x in (still, moving)]
    return plan, vectors[0], vectors[1]


def _maker(entries: list[Any], shape: tuple[int, ...], dtype: Any) -> Callable:
    def make(still: jax.Array, moving: jax.Array) -> Any:
        if not any(isinstance(e, tuple) for e in entries):
            return np.array(entries, dtype).reshape(shape)
        found = [(moving if e[0] else still)[e[1]] if isinstance(e, tuple) else e for e in entries]
        return jnp.stack([jnp.asarray(x, dtype) for x in found]).reshape(shape)

    return make


def _leaves(record: Any) -> list[tuple[str, Any]]:
    """The fields of a record that are arrays, or None as one that is not given."""
    return [(k, x) for k, x in vars(record).items() if x is None or hasattr(x, "dtype")]


def _array(x: Any) -> Any:
    return x if isinstance(x, jax.core.Tracer) else np.asarray(x)


def _taken(x: Any, which: np.ndarray) -> Any:
    """Rows of an array, known where that is; of None, None."""
    return None if x is None else _array(x)[which]
