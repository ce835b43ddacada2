"""Loops over columns of lanes, by `lax.scan`.

A column has one lane for each iteration. If the body returns a lane unchanged, the result is its
column. If it returns the pose of a link, the pose is recomputed from the columns of the joint.
Neither is stored.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.joints import PosedJoint
from rbjax.lanes import Lane, is_literal, sincos


class Parts:
    """A per-link value: a list over the links of the trunk, and columns of the other links."""

    def __init__(self, trunk: list, rest: Any):
        self.trunk, self.rest = trunk, rest


jax.tree_util.register_pytree_node(
    Parts, lambda x: ((x.trunk, x.rest), None), lambda _, children: Parts(*children)
)


class JointColumns:
    """The joint motions of all iterations, as a function of their columns.

    columns: the columns from which the motions are computed.
    posed: function that computes a joint motion from f(c) of each column c. With the f that selects
        the lane of one iteration it is the motion of this iteration. With the identity it is the
        motions of all iterations.
    """

    def __init__(self, posed: Callable[[Callable[[Any], Lane]], PosedJoint], columns: Any):
        self.posed, self.columns = posed, columns


class PoseLane:
    """A placeholder for a lane of all link poses, which are recomputed when it is read."""

    def __init__(self, joint: JointColumns, k: int):
        self.joint, self.k = joint, k

    def of(self, posed: PosedJoint) -> Lane:
        """Return lane k of the pose of one joint motion, or of the axes of a frame."""
        return jax.tree.leaves(posed.recomputed)[self.k]


class Constants:
    """A placeholder for the constants of the links, used as a leaf of a pytree of columns."""


class Iteration:
    """A function that replaces columns by the lanes of one iteration."""

    def __init__(self, column_lane: Callable[[Any], Lane], constants: Any = None):
        def lane(x: Any) -> Any:
            if isinstance(x, Constants):
                return constants
            return x if is_literal(x) else column_lane(x)

        self.lane = lane
        self.joints: dict[int, tuple[JointColumns, PosedJoint]] = {}

    def __call__(self, x: Any) -> Any:
        if isinstance(x, JointColumns):
            return self.joint(x)
        return x.of(self.joint(x.joint)) if isinstance(x, PoseLane) else self.lane(x)

    def joint(self, x: JointColumns) -> PosedJoint:
        """Return the joint motion of this iteration, which is computed on first use."""
        if id(x) not in self.joints:
            self.joints[id(x)] = x, x.posed(self.lane)
        return self.joints[id(x)][1]

    @property
    def pose_lanes(self) -> dict[int, PoseLane]:
        """Placeholders for the lanes of this iteration's link poses, by the id of the lane."""
        return {
            id(x): PoseLane(joint, k)
            for joint, posed in self.joints.values()
            for k, x in enumerate(jax.tree.leaves(posed.recomputed)) if not is_literal(x)
        }  # fmt: skip


def loop(
    scan: Callable, body: Callable, carry: Any, given: Any, cast: Callable = lambda x: x
) -> tuple[Any, Any]:
    """Scan carry, out = body(carry, lanes, more, iteration) over the columns of `given`.

    Args:
        scan: f(step, carry, columns) -> carry, stacked results. It calls step(carry, (more, lanes))
            in each iteration; `more` is (index, constants) or ().
        cast: a function that is applied to each column before the scan.
    """
    leaves, treedef = jax.tree.flatten(given)
    columns = {id(c): c for x in leaves for c in _columns(x)}
    emitted: dict[str, Any] = {}

    def step(carry, x):
        more, lanes = x
        lane_of = dict(zip(columns, lanes, strict=True))
        here = Iteration(lambda column: lane_of[id(column)], *more[1:])
        given = jax.tree.unflatten(treedef, [here(x) for x in leaves])
        carry, out = body(carry, given, more, here)
        flat, emitted["tree"] = jax.tree.flatten(out)
        kept: dict[int, Any] = {**here.pose_lanes}
        kept |= {id(x): columns[key] for key, x in lane_of.items()}
        kept |= {id(x): x for x in flat if is_literal(x)}
        fresh = {id(x): x for x in flat if id(x) not in kept}
        emitted["out"] = [(id(x), kept.get(id(x))) for x in flat]
        emitted["fresh"] = list(fresh)
        return carry, list(fresh.values())

    carry, ys = scan(step, carry, [cast(c) for c in columns.values()])
    made = dict(zip(emitted["fresh"], ys, strict=True))
    out = [made.get(key, column) for key, column in emitted["out"]]
    return carry, jax.tree.unflatten(emitted["tree"], out)


def _columns(x: Any) -> list:
    """Return the arrays over the iterations from which a leaf of the loop's inputs is computed."""
    if isinstance(x, PoseLane):
        return _columns(x.joint)
    found = jax.tree.leaves(x.columns) if isinstance(x, JointColumns) else [x]
    return [c for c in found if not (is_literal(c) or isinstance(c, Constants))]


# ------------------------------------------------------------------- columns over limbs


@jax.custom_jvp
def sequential_sincos(angles: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute cosines and sines in a loop, so that their long program is compiled once."""
    return jax.lax.scan(lambda _, x: ((), sincos(x)), (), angles)[1]


@sequential_sincos.defjvp
def _sequential_sincos_jvp(primals: tuple, tangents: tuple) -> tuple:
    c, s = sequential_sincos(*primals)
    return (c, s), (-s * tangents[0], c * tangents[0])


def widen(column: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Broadcast a column, or a value that all limbs share, to (limbs, 1, ...)."""
    if column.ndim:
        column = jnp.expand_dims(column, (1, *range(column.ndim + 1, len(shape))))
    return jnp.broadcast_to(column, shape)


def rows_of(x: Any, index: Sequence[int]) -> Any:
    """Return rows of an array, by a slice if they are evenly spaced."""
    steps = {b - a for a, b in itertools.pairwise(index)}
    if len(steps) == 1 and min(steps) > 0:
        return x[index[0] : index[-1] + 1 : steps.pop()]
    return x[np.array(index, int)]


def merge(*lanes: Lane) -> Any:
    """Convert the lanes of the limbs to a column, or to a literal if they are one constant."""
    if not all(map(is_literal, lanes)):
        return jnp.stack([jnp.asarray(x) for x in lanes])
    return lanes[0] if all(x == lanes[0] for x in lanes) else np.array(lanes, float)
