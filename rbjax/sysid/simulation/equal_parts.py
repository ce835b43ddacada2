"""Simulation of equal independent parts of a set-up as one batch.

Four legs on a fixed base are one leg with four sets of parameters. The program is the short one of
a single leg, and the legs run in parallel. A parameter with the same value in all parts is a
constant of the program. A parameter that differs between parts is an argument.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.model import WORLD, Model, State, Topology
from rbjax.model.components import Actuators, Bodies, Joints, Keyframes, Sites
from rbjax.motion.integrators import loop_stages
from rbjax.sysid.simulation.jacobian_colouring import independent_parts
from rbjax.sysid.simulation.setup import (
    PD,
    Calibration,
    Grid,
    Setup,
    SimulatedPath,
    prepare_setup,
    simulate_motion,
    simulate_states,
)


class Part(NamedTuple):
    """Indices of one independent part of a model.

    Fields:
        joints: indices of its joints.
        bodies: indices of its bodies, and of bodies that are fixed to the world.
        actuators: indices of its actuators.
        rows: for each force element, indices of its rows.
    """

    joints: np.ndarray
    bodies: np.ndarray
    actuators: np.ndarray
    rows: tuple[np.ndarray, ...]


def equal_parts(setup: Setup) -> tuple[Part, ...] | None:
    """Find the independent parts of a set-up.

    Return None unless there are several parts with the same structure.
    """
    of_joint = independent_parts(setup)
    if of_joint is None or setup.model.joints.params.size:
        return None
    model = setup.model
    of_body = np.array([of_joint[i] if i != WORLD else -1 for i in model.topology.body_links])
    parts = []
    for k in range(of_joint.max() + 1):
        joints = np.flatnonzero(of_joint == k)
        bodies = np.flatnonzero((of_body == k) | (of_body == -1))
        actuators = np.flatnonzero(np.isin(model.actuators.joints, joints))
        rows = tuple(
            np.flatnonzero(np.isin([model.joint(j) for j in e.joints], joints))
            for e in model.forces
        )
        parts.append(Part(joints, bodies, actuators, rows))
    driven = sum(len(part.actuators) for part in parts) == model.nu
    structures = {_structure(model, part) for part in parts}
    return tuple(parts) if driven and len(structures) == 1 else None


def _structure(model: Model, part: Part) -> tuple:
    """Collect the static data of a part's program: parents, joints, actuators, force elements."""
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


def extract_part(setup: Setup, part: Part) -> Setup:
    """Extract the set-up of one part. Its bodies and joints get numbers as names, equal in all
    parts."""
    model, top, at = setup.model, setup.model.topology, part.joints
    parents, kinds, bodies, driven, acting = _structure(model, part)
    body_names, joint_names, actuator_names = (
        tuple(map(str, range(len(x)))) for x in (parents, kinds, driven)
    )
    joints = tuple(top.joints[j] for j in at)
    topology = Topology(
        parents, kinds, bodies, body_names, joint_names, actuator_names, joints=joints
    )

    def rows(record: Any, kind: Any, which: np.ndarray, **more: Any) -> Any:
        arrays = {k: x for k, x in vars(record).items() if x is None or hasattr(x, "dtype")}
        return kind(**{k: _rows(x, which) for k, x in arrays.items() if k not in more}, **more)

    zero: Any = np.zeros
    n, nu = len(at), len(driven)
    small = Model(
        bodies=rows(model.bodies, Bodies, part.bodies),
        joints=rows(model.joints, Joints, at, params=zero(0)),
        actuators=rows(model.actuators, Actuators, part.actuators, joints=driven, sites=(-1,) * nu),
        sites=Sites(zero((0, 3)), zero((0, 4))),
        keyframes=Keyframes(zero((0, n)), zero((0, n)), zero((0, nu))),
        gravity=model.gravity, topology=topology, timestep=model.timestep, dropped=(),
        forces=tuple(
            rows(e, type(e), which, joints=those)
            for e, which, those in zip(model.forces, part.rows, acting, strict=True)
        ),
    )  # fmt: skip
    sensors = {
        k: Calibration(_rows(s.bias, at), _rows(s.scale, at), s.delay)
        for k, s in setup.sensors.items() if k in ("q", "v")
    }  # fmt: skip
    servo = setup.controller
    if isinstance(servo, PD):
        servo = PD(_rows(servo.kp, part.actuators), _rows(servo.kd, part.actuators))
    return Setup(small, sensors, servo, setup.delay)


def simulate_parts(
    parts: tuple[Part, ...] | None, made: Callable[[jax.Array], Setup], p: jax.Array, start: State,
    commands: jax.Array, grid: Grid, *, keep: int | None = None, count: int = 1,
) -> SimulatedPath:  # fmt: skip
    """Simulate equal parts as one batch, or the whole robot if `parts` is None."""
    if parts is None:
        return simulate_motion(made, p, start, commands, grid, keep=keep, count=count)
    now = made(p)
    each = [jax.tree.flatten(extract_part(now, part)) for part in parts]
    tree: Any = each[0][1]
    makers, constants, traced = _separate([leaves for leaves, _ in each])

    integrator = grid.integrator_of(now.model)
    if isinstance(integrator, str):  # a loop over the stages makes the program short
        grid = grid._replace(integrator=loop_stages(integrator))

    def part(numbers: tuple[jax.Array, jax.Array]) -> Setup:
        return prepare_setup(jax.tree.unflatten(tree, [make(*numbers) for make in makers]))

    def one(numbers: tuple[jax.Array, jax.Array], start: State, commands: jax.Array) -> Any:
        return simulate_states(part, numbers, start, commands, grid, keep, count)

    at = np.stack([part.joints for part in parts])
    driven = np.stack([part.actuators for part in parts])
    starts = State(start.q[at], start.v[at])
    each_commands = commands.T[driven].swapaxes(1, 2)
    states, ctrls = jax.vmap(one)((constants, traced), starts, each_commands)

    def merge(x: jax.Array, which: np.ndarray) -> jax.Array:
        """Merge trajectories (parts, T, n of a part) to (T, n)."""
        return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1)[:, np.argsort(which.ravel())]

    ctrls = commands if ctrls is None else merge(ctrls, driven)
    return SimulatedPath(merge(states.q, at), merge(states.v, at), None, ctrls)


def _separate(each: list[list[Any]]) -> tuple[list[Callable], jax.Array, jax.Array]:
    """Separate the leaves of all parts into constants and traced values.

    Return one function for each leaf, which builds it from two vectors, and these vectors (parts,
    n): the constants that differ between parts, and the traced values.
    """
    makers: list[Callable] = []
    vectors: tuple[list[Any], list[Any]] = [], []
    for leaves in zip(*each, strict=True):
        traced = any(isinstance(x, jax.core.Tracer) for x in leaves)
        rows: Any = [x.ravel() if traced else np.ravel(x) for x in map(_array, leaves)]
        rows = jnp.stack(rows) if traced else np.stack(rows)
        entries: list[Any] = []
        for k in range(rows.shape[1]):
            column = rows[:, k]
            if not traced and (column == column[0]).all():
                entries.append(column[0])
            else:
                entries.append((traced, len(vectors[traced])))
                vectors[traced].append(column)
        makers.append(_maker(entries, np.shape(leaves[0]), _array(leaves[0]).dtype))
    constants, unknown = (jnp.stack(x, 1) if x else jnp.zeros((len(each), 0)) for x in vectors)
    return makers, constants, unknown


def _maker(entries: list[Any], shape: tuple[int, ...], dtype: Any) -> Callable:
    """Return a function of two vectors that makes an array of a shape and dtype.

    entries: for each entry of the array, a number, or (index of the vector, index in the vector).
    """

    def make(*vectors: jax.Array) -> Any:
        if not any(isinstance(e, tuple) for e in entries):
            return np.array(entries, dtype).reshape(shape)
        found = [vectors[e[0]][e[1]] if isinstance(e, tuple) else e for e in entries]
        return jnp.stack([jnp.asarray(x, dtype) for x in found]).reshape(shape)

    return make


def _array(x: Any) -> Any:
    return x if isinstance(x, jax.core.Tracer) else np.asarray(x)


def _rows(x: Any, which: np.ndarray) -> Any:
    """Select rows of an array, in numpy if it is not traced. None remains None."""
    return None if x is None else _array(x)[which]
