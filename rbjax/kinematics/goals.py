"""Goals of frames: a pose, position, rotation or direction, with its error and Jacobian.

    pose         e = [log(R_d R^T); p_d - p]           J = [J_w; J_v]
    rotation     e = log(R_d R^T)                       J = J_w
    position     e = p_d - p                            J = J_v
    direction    e = rotation vector from a to n        J = (1 - n n^T) J_w

in world axes. The frame has attitude R and position p. Its axis a shall point along n. To first
order in e, J v is the rate of -e (Sola, Deray & Atchuthan, *A micro Lie theory*, 2018, eq. 83).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.algorithms.frames import locate_on_link
from rbjax.dynamics.algorithms.kinematics import LinkMotion
from rbjax.dynamics.arguments import check_array
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_frame, check_not_negative, check_rotation
from rbjax.lanes import Lane, Mat3, Vec3, is_literal, mul
from rbjax.model import WORLD, Frame, Model, prepare
from rbjax.model.leaves import site_transform
from rbjax.model.record import Record
from rbjax.rotations import quaternion

#: two unit vectors are treated as opposite if 1 + their dot product is below this
OPPOSITE = 1e-14


class Goal(Record):
    """The goal of a frame: a position, an attitude, both, or a direction of one of its axes.

    Args:
        site, body: the name of the frame; give exactly one of the two.
        position: (3,) m, desired position of its origin (or of `point`) in the world.
        rotation: (3, 3), desired attitude, from frame to world axes.
        direction: (3,), desired direction of its `axis` in the world; not with a rotation.
        axis: (3,), an axis in the frame; its z axis if None.
        point: (3,) m, a point in the frame; its origin if None.
        weight: weight of the error relative to other goals, if not all can be met.

    Raises:
        InputError: neither or both names, no target, a wrong shape, a zero vector as a direction.

    Example:
        >>> import rbjax as rb
        >>> rb.control.Goal(site="tool", position=[0.4, 0.0, 0.5], direction=[0.0, 0.0, -1.0]).rows
        6
    """

    position: jax.Array | None
    rotation: jax.Array | None
    direction: jax.Array | None
    axis: jax.Array | None
    point: jax.Array | None
    weight: jax.Array
    site: str | None = eqx.field(static=True)
    body: str | None = eqx.field(static=True)

    def __init__(
        self, *, site: str | None = None, body: str | None = None, position: Any = None,
        rotation: Any = None, direction: Any = None, axis: Any = None, point: Any = None,
        weight: Any = 1.0,
    ):  # fmt: skip
        def given(name: str, value: Any, *shape: int) -> Any:
            return None if value is None else check_array("Goal", name, value, shape)

        check_frame("Goal", site, body)
        if position is None and rotation is None and direction is None:
            raise InputError("Goal: nothing to reach; give a position, a rotation or a direction")
        if rotation is not None and direction is not None:
            raise InputError(
                "Goal: got both rotation and direction, expected at most one: a rotation fixes "
                "the direction of every axis"
            )
        if axis is not None and direction is None:
            raise InputError("Goal: got an axis and no direction for it; give direction=")
        self.site, self.body = site, body
        self.position = given("position", position, 3)
        self.rotation = given("rotation", rotation, 3, 3)
        self.direction = given("direction", direction, 3)
        self.axis, self.point = given("axis", axis, 3), given("point", point, 3)
        self.weight = check_not_negative("Goal", "weight", weight, ())
        for name in ("direction", "axis"):
            _check_length(name, getattr(self, name))
        check_rotation("Goal", self.rotation)

    @property
    def arrays(self) -> list[jax.Array]:
        """The target arrays that are given: position, rotation and direction."""
        return [x for x in (self.position, self.rotation, self.direction) if x is not None]

    @property
    def rows(self) -> int:
        """Number of rows of the error."""
        turns = self.rotation is not None or self.direction is not None
        return 3 * turns + 3 * (self.position is not None)


def _check_length(name: str, x: jax.Array | None) -> None:
    if x is not None and not isinstance(x, jax.core.Tracer) and not np.any(np.asarray(x)):
        raise InputError(f"Goal: {name} is the zero vector, expected one with a direction")


class GoalErrors:
    """Errors of all goals at a configuration, and the rows of their Jacobian, as lanes.

    errors: e, one lane a row.
    rows: rows of J, nv lanes each.
    weights: weight of each row.
    turning: true for each row of a rotation error.
    """

    def __init__(
        self, model: Model, d: Unrolled, goals: Sequence[Goal], q: jax.Array,
        weights: Sequence[Lane] = (1.0, 1.0),
    ):  # fmt: skip
        """Evaluate the errors and their Jacobian at q.

        d: an unrolled driver of the model (`unrolled_driver`).
        weights: factors of rotation errors and of position errors.
        """
        self.model, self.dtype = model, q.dtype
        self.errors: list[Lane] = []
        self.rows: list[list[Lane]] = []
        self.weights: list[Lane] = []
        self.turning: list[bool] = []
        self._weights = weights
        self._d, self._motion = d, LinkMotion(d, q, None)
        self._columns: dict[int, list[tuple[int, Vec3, Any]]] = {}
        self.groups: list[tuple[bool, int, int]] = []
        for goal in goals:
            self._add(goal)

    def _add(self, goal: Goal) -> None:
        link, r, attitude = self._frame(goal)
        if link == WORLD:
            p, R = r, attitude
        else:
            pose = self._motion.pose(link)
            p, R = pose.p + pose.R @ r, pose.R @ attitude
        path = () if link == WORLD else self._d.topology.ancestors[link]
        if goal.rotation is not None:
            turn = _entries(goal.rotation, self.dtype) @ R.T
            entries = [jnp.asarray(x, self.dtype) for x in turn]
            e = quaternion.log_lanes(quaternion.from_matrix_lanes(entries))
            self._rows(goal, True, e, path, lambda spin, slip: spin)
        elif goal.direction is not None:
            n, a = _unit(goal.direction, self.dtype), Vec3(0.0, 0.0, 1.0)
            a = R @ (a if goal.axis is None else _unit(goal.axis, self.dtype))
            across = lambda spin, slip: spin - n * spin.dot(n)  # noqa: E731
            self._rows(goal, True, _shortest_turn(a, n, self.dtype), path, across)
        if goal.position is not None:
            e = Vec3(*(goal.position[i] for i in range(3))) - p
            self._rows(goal, False, e, path, lambda spin, slip: slip(p))

    def _frame(self, goal: Goal) -> tuple[int, Vec3, Mat3]:
        """Return the link that carries the frame, and the frame's origin and orientation in link
        axes."""
        model, d = self.model, self._d
        like = jnp.zeros(0, self.dtype)
        link, r = locate_on_link("Goal", model, d, like, Frame(goal.body, goal.point, goal.site))
        R = Mat3.identity()
        b = body_of(model, goal)
        if goal.site is not None:
            R = site_transform(model, model.site(goal.site), self.dtype).R
        return link, r, (R if link == WORLD else d.prepared.weld(b).R @ R)

    def _rows(self, goal: Goal, turns: bool, e: Any, path: Sequence[int], of: Any) -> None:
        scale = mul(self._weights[0 if turns else 1], jnp.asarray(goal.weight, self.dtype))
        self.groups.append((turns, len(self.errors), len(self.errors) + 3))
        columns = {i: list(of(*x)) for link in path for i, *x in self._columns_of(link)}
        for k, entry in enumerate(e):
            self.errors.append(entry)
            self.weights.append(scale)
            self.turning.append(turns)
            self.rows.append([columns[i][k] if i in columns else 0.0 for i in range(self.model.nv)])

    def _columns_of(self, link: int) -> list[tuple[int, Vec3, Any]]:
        """Return the dofs that move a link relative to its parent, each with the angular velocity
        for unit speed and the function p -> velocity of a point.

        Velocities and the point p, which the link carries, are in the world.
        """
        if link not in self._columns:
            pose = self._motion.pose(link)
            turned = [(i, pose.R @ S.ang, pose.R @ S.lin) for i, S in self._motion.axes(link)]
            self._columns[link] = [
                (i, w, lambda p, w=w, v=v: w.cross(p - pose.p) + v) for i, w, v in turned
            ]
        return self._columns[link]

    def size(self, turns: bool) -> Lane:
        """Return the square of the largest rotation error (turns) or position error."""
        out: Lane = 0.0
        for turning, start, stop in self.groups:
            if turning == turns:
                square = sum(x * x for x in self.errors[start:stop])
                out = square if is_literal(out) else jnp.maximum(out, square)
        return out


def body_of(model: Model, goal: Goal) -> int:
    """Return the body that carries the goal's frame, or `WORLD`."""
    if goal.site is not None:
        return model.topology.site_bodies[model.site(goal.site)]
    return model.body(goal.body or "")


def unrolled_driver(model: Model, dtype: Any) -> Unrolled:
    """Build the driver for `GoalErrors`; one driver serves many configurations."""
    return Unrolled(model, prepare(model, dtype))


def errors(model: Model, goals: Sequence[Goal], q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the errors e (m,) and their Jacobian J (m, nv), without weights."""
    goal_errors = GoalErrors(model, unrolled_driver(model, q.dtype), goals, q)
    e = jnp.stack([jnp.asarray(x, q.dtype) for x in goal_errors.errors])
    rows = [jnp.stack([jnp.asarray(x, q.dtype) for x in row]) for row in goal_errors.rows]
    return e, jnp.stack(rows)


def _shortest_turn(a: Vec3, n: Vec3, dtype: Any) -> list[Lane]:
    """Return the shortest rotation vector from unit vector a to unit vector n, from the quaternion
    (1 + a.n, a x n). For opposite vectors, rotate by pi about an axis perpendicular to n."""
    w, u = 1 + a.dot(n), a.cross(n)
    opposite = w < OPPOSITE
    x, y, z = (jnp.abs(jnp.asarray(c, dtype)) for c in n)
    first = (x <= y) & (x <= z)
    second = ~first & (y <= z)
    least = [jnp.asarray(c, dtype) for c in (first, second, ~first & ~second)]
    aside = n.cross(Vec3(*least))
    turn = [jnp.where(opposite, b, c) for b, c in zip(aside, u, strict=True)]
    return quaternion.log_lanes([jnp.where(opposite, 0.0, w), *turn])


def _unit(x: jax.Array, dtype: Any) -> Vec3:
    v = Vec3(*(jnp.asarray(x[i], dtype) for i in range(3)))
    return v * (1 / jnp.sqrt(v.dot(v)))


def _entries(R: jax.Array, dtype: Any) -> Mat3:
    return Mat3(*(jnp.asarray(R[i, j], dtype) for i in range(3) for j in range(3)))
