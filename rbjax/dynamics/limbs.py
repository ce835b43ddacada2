"""The driver by limbs: isomorphic limbs as a loop over one that is written out.

A humanoid's two legs are one leg in a `lax.scan` over two; base and waist (the trunk) are written
out, as `Unrolled` would. Thus a program is short where a robot repeats itself, and within a limb
nothing is carried from turn to turn: all lanes of a limb are in registers.

What a number of the limbs of a group has in common stays part of the program: literal where all
agree, so zeros that all share vanish; where they differ it is a column over the limbs, read by the
loop's counter. What outlives a loop is written to memory; what a step hands on unchanged is not,
nor is a link's pose, which is computed again from cosine and sine.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics import unrolled
from rbjax.dynamics.joints import JointMotion, PosedJoint, joint_lanes, turning
from rbjax.dynamics.packing import pack
from rbjax.dynamics.unrolled import Listed, Step, Sweeps
from rbjax.lanes import Lane, add, as_arrays, is_literal, sub
from rbjax.materialize import materialize, sincos
from rbjax.model import WORLD, Group, Link, LinkConstants, Model, Prepared, partition
from rbjax.model.links import lane


class Parts:
    """A per-link value of `Limbs`: a list for the trunk, and for each group a list over the
    positions in a limb, each of columns over the limbs."""

    def __init__(self, trunk: list, limbs: list[list]):
        self.trunk, self.limbs = trunk, limbs


jax.tree_util.register_pytree_node(
    Parts, lambda x: ((x.trunk, x.limbs), None), lambda _, children: Parts(*children)
)


class LimbJoint:
    """Among the columns: the joint motions at one position of a group."""

    def __init__(self, link: Link, constants: LinkConstants, q: list, v: list, trig: Any):
        self.link, self.columns = link, (constants, q, v, trig)

    def of(self, lane_of: Callable[[Any], Lane]) -> PosedJoint:
        """The motion of one limb, whose lanes those are."""
        constants, q, v, trig = jax.tree.map(lane_of, self.columns)
        if trig:
            return PosedJoint(turning(*trig, v[0]), constants)
        return PosedJoint(joint_lanes(self.link, constants, q, v, 0), constants)


class PoseLane:
    """Among the columns: a lane of the links' poses, cheaper to compute than to keep."""

    def __init__(self, joint: LimbJoint, k: int):
        self.joint, self.k = joint, k


class Limb:
    """One limb's lanes in place of the columns."""

    def __init__(self, column_lane: Callable[[Any], Lane]):
        self.lane = lambda x: x if is_literal(x) else column_lane(x)
        self.joints: dict[int, tuple[LimbJoint, PosedJoint]] = {}

    def __call__(self, x: Any) -> Any:
        if isinstance(x, LimbJoint):
            return self.joint(x)
        if isinstance(x, PoseLane):
            return jax.tree.leaves(self.joint(x.joint).pose)[x.k]
        return self.lane(x)

    def joint(self, x: LimbJoint) -> PosedJoint:
        if id(x) not in self.joints:
            self.joints[id(x)] = x, x.of(self.lane)
        return self.joints[id(x)][1]

    @property
    def poses(self) -> dict[int, PoseLane]:
        """For each lane of a pose what it is among the columns."""
        return {
            id(x): PoseLane(joint, k)
            for joint, posed in self.joints.values()
            for k, x in enumerate(jax.tree.leaves(posed.pose)) if not is_literal(x)
        }  # fmt: skip


class Limbs(Sweeps, Listed):
    """The trunk written out; a loop over the limbs of each group."""

    def __init__(self, model: Model, prepared: Prepared):
        top = self.topology = model.topology
        self.prepared = prepared
        self._trunk, self._groups = partition(top)
        place = {link: n for n, link in enumerate(self._trunk)}
        self._place = {**place, WORLD: WORLD}
        self._parents = [self._place[top.parents[i]] for i in self._trunk]
        self._like: Any = None  # the shape and dtype of one lane, known with q

        def column(x: Any, links: Sequence[int]) -> Any:
            if isinstance(x, np.ndarray):
                return _merged(*(lane(x, i) for i in links))
            return _rows(x, links)

        self.constants = self._parts(
            prepared.link,
            lambda links: jax.tree.map(lambda x: column(x, links), prepared.columns),
        )

    def _parts(self, of_link: Callable, of_links: Callable) -> Parts:
        """A per-link value: of each link of the trunk, and of the links of each position."""
        positions = [list(map(of_links, zip(*group.links, strict=True))) for group in self._groups]
        return Parts([of_link(i) for i in self._trunk], positions)

    def joints(self, q: jax.Array, v: jax.Array | None) -> Parts:
        """As `Unrolled.joints`."""
        self._like = jnp.zeros(q.shape[1:], q.dtype)
        links = self.topology.links
        vs: Any = [0.0] * self.topology.nv if v is None else v
        constants = iter(self.constants.trunk)

        def trunk(i: int) -> JointMotion:
            return joint_lanes(links[i], next(constants), q, vs, i)

        def position(places: Sequence[int]) -> LimbJoint:
            link = links[places[0]]
            starts = [links[i].q for i in places]
            count = 0 if link.q is None else 4 if link.quaternion else 1
            at = [_rows(q, [start + k for start in starts]) for k in range(count)]
            speeds = range(3 if link.quaternion else 1)
            speed = [0.0 if v is None else _rows(v, [i + k for i in places]) for k in speeds]
            link = dataclasses.replace(link, q=0 if count else None)
            return LimbJoint(link, next(numbers), at, speed, None)

        numbers = iter([x for group in self.constants.limbs for x in group])
        out = self._parts(trunk, position)
        out.trunk = materialize(out.trunk)
        for group, positions in zip(self._groups, out.limbs, strict=True):
            self._turn(group, positions)
        return out

    def _turn(self, group: Group, positions: list[LimbJoint]) -> None:
        """Cosine and sine of the hinges of a group, which its loops share."""
        hinges = [x for x in positions if x.link.kind == "hinge" and x.link.part is None]
        angles = [(x.columns[1][0], x.columns[0].reference) for x in hinges]

        def body(_, angles, known):
            return (), [sincos(sub(q, reference)) for q, reference in angles]

        _, trigs = self._loop(group, body, (), angles)
        for x, trig in zip(hinges, trigs, strict=True):
            constants, _, v, _ = x.columns
            x.columns = (constants, [], v, trig)

    def lanes(self, x: jax.Array | None) -> Parts:
        """As `Unrolled.lanes`."""
        if x is None:
            return self._parts(lambda i: 0.0, lambda links: 0.0)
        return self._parts(lambda i: x[i], lambda links: _rows(x, links))

    def pack(self, lanes: Parts, like: jax.Array) -> jax.Array:
        """As `Unrolled.pack`. Limbs that follow each other are written as one block."""
        pieces: dict[int, jax.Array] = {}
        left = {i: x for i, x in zip(self._trunk, lanes.trunk, strict=True)}
        for group, columns in zip(self._groups, lanes.limbs, strict=True):
            count, size = len(group.links), len(columns)
            every = [i for limb in group.links for i in limb]
            shape = (count, *like.shape[1:])
            rows = [jnp.asarray(x, like.dtype) for x in columns]
            rows = [x.reshape(-1, *(1,) * (like.ndim - 1)) if x.ndim < 2 else x for x in rows]
            rows = [jnp.broadcast_to(x, shape)[:, None] for x in rows]
            block = jnp.concatenate(rows, 1).reshape(count * size, *shape[1:])
            if every == list(range(every[0], every[0] + len(every))):
                pieces[every[0]] = block
            else:
                left |= {i: block[n] for n, i in enumerate(every)}
        for i in sorted(left):
            if i - 1 not in left:
                run = [left[k] for k in range(i, self._run(left, i))]
                pieces[i] = pack(run, like[: len(run)])
        return jnp.concatenate([pieces[i] for i in sorted(pieces)])

    def _run(self, links: Any, i: int) -> int:
        while i in links:
            i += 1
        return i

    def columns(self, values: Parts, like: jax.Array) -> Any:
        """As `Unrolled.columns`."""
        return jax.tree.map(lambda *lanes: pack(lanes, like), *self.whole(values))

    def whole(self, values: Parts) -> list:
        """As `Unrolled.whole`: a list over the links."""
        out: list = [None] * self.topology.nv
        for i, x in zip(self._trunk, values.trunk, strict=True):
            out[i] = x
        for group, positions in zip(self._groups, values.limbs, strict=True):
            for j, limb in enumerate(group.links):
                at = Limb(lambda column, j=j: self._cast(column)[j])
                for i, x in zip(limb, jax.tree.map(at, positions), strict=True):
                    out[i] = x
        return out

    def rows(self, whole: list) -> Parts:
        """As `Unrolled.rows`."""
        return self._parts(
            lambda i: whole[i],
            lambda links: jax.tree.map(_merged, *(whole[i] for i in links)),
        )

    def zip(self, *values: Parts) -> Parts:
        """As `Unrolled.zip`."""
        groups = zip(*(v.limbs for v in values), strict=True)
        limbs = [list(zip(*positions, strict=True)) for positions in groups]
        return Parts(list(zip(*(v.trunk for v in values), strict=True)), limbs)

    def part(self, values: Parts, k: int) -> Parts:
        """As `Unrolled.part`."""
        return Parts([x[k] for x in values.trunk], [[x[k] for x in xs] for xs in values.limbs])

    # ---------------------------------------------------------------- sweeps

    def outward(self, step: Step, root: Any, xs: Parts) -> Parts:
        """As `Unrolled.outward`: the trunk, then the limbs."""
        carries, ys = unrolled.outward(self._parents, step, root, xs.trunk)

        def limb(group, x, before, known):
            return (), unrolled.outward(group.parents, step, before, x, known)[1]

        return Parts(ys, self._each_group(limb, (), xs, carries, root)[1])

    def inward(self, step: Step, zero: Any, xs: Parts) -> Parts:
        """As `Unrolled.inward`: the limbs, then the trunk."""

        def limb(group, x, before, known):
            sums = [zero] * len(x)
            messages, ys = unrolled.inward(group.parents, step, sums, x, known)
            return messages[0], ys

        sums, limbs = self._each_group(limb, zero, xs, None, None)
        return Parts(unrolled.inward(self._parents, step, sums, xs.trunk)[1], limbs)

    def out_and_in(self, outward: Step, root: Any, inward: Step, zero: Any, xs: Parts) -> Parts:
        """As `Sweeps.out_and_in`: the trunk out; out and in through each limb, which keeps nothing
        of the way out; the trunk in."""
        carries, first = unrolled.outward(self._parents, outward, root, xs.trunk)

        def limb(group, x, before, known):
            y = unrolled.outward(group.parents, outward, before, x, known)[1]
            sums, both = [zero] * len(x), list(zip(x, y, strict=True))
            messages, ys = unrolled.inward(group.parents, inward, sums, both, known)
            return messages[0], ys

        sums, limbs = self._each_group(limb, zero, xs, carries, root)
        both = list(zip(xs.trunk, first, strict=True))
        return Parts(unrolled.inward(self._parents, inward, sums, both)[1], limbs)

    def _each_group(
        self, limb: Callable, zero: Any, xs: Parts, carries: list | None, root: Any
    ) -> tuple[list, list]:
        """message, ys = limb(group, xs, carry of its carrier, known) of every limb: the sums of the
        messages to each link of the trunk, and the columns of ys."""
        sums, out = [zero] * len(self._trunk), []
        for group, positions in zip(self._groups, xs.limbs, strict=True):
            ports = [self._place[i] for i in group.carriers]
            one = ports[0] if len(set(ports)) == 1 else None  # carries all limbs
            before: Any = None
            if carries is not None:
                at = [root if port == WORLD else carries[port] for port in ports]
                before = at[0] if one is not None else jax.tree.map(_merged, *at)

            def body(total, given, known):
                x, own = given
                start = before if one is not None else own
                message, ys = limb(group, x, start, known)
                if one is None:
                    return (), (message, ys)
                if one == WORLD:
                    return (), ((), ys)
                total = jax.tree.map(add, total, message)
                return as_arrays(total, self._like), ((), ys)

            start = as_arrays(zero, self._like) if one not in (None, WORLD) else ()
            given = positions, before if one is None else None
            total, (messages, ys) = self._loop(group, body, start, given)
            out.append(ys)
            if one is not None and one != WORLD:
                sums[one] = jax.tree.map(add, sums[one], total)
            elif one is None:
                for j, port in enumerate(ports):
                    if port != WORLD:
                        message = jax.tree.map(Limb(lambda x, j=j: self._cast(x)[j]), messages)
                        sums[port] = jax.tree.map(add, sums[port], message)
        return sums, out

    def _loop(self, group: Group, body: Callable, carry: Any, given: Any) -> tuple[Any, Any]:
        """carry, out = body(carry, given, known) over the limbs: `given` in lanes in place of the
        columns. What a body returns of what was given to it stays the column that it was."""
        leaves, treedef = jax.tree.flatten(given)
        found = [c for x in leaves for c in _columns(x)]
        columns = {id(c): c for c in found}
        told: dict[str, Any] = {}

        def turn(carry, lanes):
            lane_of = dict(zip(columns, lanes, strict=True))
            limb = Limb(lambda column: lane_of[id(column)])
            x = jax.tree.unflatten(treedef, [limb(x) for x in leaves])
            poses = limb.poses
            known = [posed.pose for _, posed in limb.joints.values()]
            carry, out = body(carry, x, known)
            flat, told["tree"] = jax.tree.flatten(out)
            kept = poses | {id(x): columns[key] for key, x in lane_of.items()}
            kept |= {id(x): x for x in flat if is_literal(x)}
            fresh = {id(x): x for x in flat if id(x) not in kept}
            told["out"] = [(id(x), kept.get(id(x))) for x in flat]
            told["fresh"] = list(fresh)
            return carry, list(fresh.values())

        lanes = [self._cast(c) for c in columns.values()]
        carry, ys = jax.lax.scan(turn, carry, lanes, length=len(group.links))
        made = dict(zip(told["fresh"], ys, strict=True))
        out = [made.get(key, column) for key, column in told["out"]]
        return carry, jax.tree.unflatten(told["tree"], out)

    def _cast(self, column: Any) -> Any:
        if isinstance(column, np.ndarray):
            return column.astype(self._like.dtype)
        return column


def _columns(x: Any) -> list:
    """The columns that a leaf is read from."""
    if isinstance(x, PoseLane):
        return _columns(x.joint)
    if isinstance(x, LimbJoint):
        return [c for c in jax.tree.leaves(x.columns) if not is_literal(c)]
    return [] if is_literal(x) else [x]


def _rows(x: Any, index: Sequence[int]) -> Any:
    """Those rows of an array; a slice of it where they are evenly spaced."""
    steps = {b - a for a, b in zip(index, index[1:], strict=False)}
    if len(steps) == 1 and min(steps) > 0:
        return x[index[0] : index[-1] + 1 : steps.pop()]
    return x[np.array(index)]


def _merged(*lanes: Lane) -> Any:
    """The lanes of the limbs as a column; a literal where they agree."""
    if not all(map(is_literal, lanes)):
        return jnp.stack([jnp.asarray(x) for x in lanes])
    return lanes[0] if all(x == lanes[0] for x in lanes) else np.array(lanes, float)
