"""The driver by limbs: a loop over isomorphic limbs, one of which is unrolled.

Limbs are in parallel, as the legs of a robot, or in series, as the beams of a cable. A sweep over a
series carries its values from limb to limb.

The two legs of a humanoid are a `lax.scan` of length two over one unrolled leg. Base and waist (the
trunk) are unrolled, as in `Unrolled`. All lanes of a limb are in registers.

A number that is equal in all limbs of a group is a literal of the program, so shared zeros vanish.
A number that differs between the limbs is a column over the limbs (`loop`).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers import unrolled
from rbjax.dynamics.drivers.contract import Step, dof_motion, frame_motions
from rbjax.dynamics.drivers.loop import (
    Iteration,
    JointColumns,
    Parts,
    loop,
    merge,
    rows_of,
    sequential_sincos,
    widen,
)
from rbjax.joints import HINGE, FrameKind, JointMotion, PosedJoint, hinge_motion
from rbjax.lanes import (
    Lane,
    add,
    as_arrays,
    fusion_barrier,
    is_literal,
    pack,
    sub,
    total,
)
from rbjax.lanes.primitives import whole_cotangent
from rbjax.model import WORLD, Group, LinkConstants, Model, ModelConstants, partition
from rbjax.model.links import lane


class Limbs(unrolled.ListDriver):
    """The driver that unrolls the trunk of a tree, and loops over the equal limbs of each group.
    The columns of a per-link value are a list for each group, over the positions in a limb."""

    def __init__(self, model: Model, prepared: ModelConstants):
        top = self.topology = model.topology
        self.prepared = prepared
        self._trunk, self._groups = partition(top)
        place = {link: n for n, link in enumerate(self._trunk)}
        self._place = {**place, WORLD: WORLD}
        self._parents = [self._place[top.parents[i]] for i in self._trunk]
        self._like: Any = None  # an array with the shape and dtype of one lane; set from q
        #: id of a lane that `whole` has read from a column -> (lane, column, limb)
        self._read: dict[int, tuple[Lane, Any, int]] = {}
        self.constants = self._parts(
            prepared.link,
            lambda links: jax.tree.map(lambda x: self._column(x, links), prepared.columns),
        )

    def _parts(self, of_link: Callable, of_links: Callable, *given: Parts) -> Parts:
        """Make a per-link value from functions of its two parts.

        of_link: function that returns the value of one link of the trunk.
        of_links: function that returns a column from the links of all limbs at one position of a
            group.
        """
        trunk = list(map(of_link, self._trunk, *(x.trunk for x in given)))
        positions = [list(zip(*group.links, strict=True)) for group in self._groups]
        limbs = [
            list(map(of_links, links, *(x.rest[n] for x in given)))
            for n, links in enumerate(positions)
        ]
        return Parts(trunk, limbs)

    def _column(self, column: Any, links: Sequence[int]) -> Any:
        """Return the rows of a column for some links, or a literal if all rows are the same
        constant."""
        if isinstance(column, np.ndarray):
            return merge(*(lane(column, i) for i in links))
        return rows_of(column, links)

    def joints(self, q: jax.Array, v: jax.Array | None, *along: jax.Array) -> Parts:
        self._like = jnp.zeros(q.shape[1:], q.dtype)
        dofs = self.topology.links
        hinges = [i for i, dof in enumerate(dofs) if dof.kind is HINGE]
        place = {i: n for n, i in enumerate(hinges)}
        c, s = jnp.zeros((2, 0), q.dtype)
        if hinges:
            reference = self._cast(self._column(self.prepared.columns.reference, hinges))
            c, s = sequential_sincos(sub(rows_of(q, [dofs[i].q[0] for i in hinges]), reference))
        qs: Any = q
        rates: Any = along
        vs: Any = [0.0] * self.topology.nv if v is None else v
        given: Any = (q, v, *along)
        rows = functools.lru_cache(None)(lambda k, at: rows_of(given[k], at))
        beams: dict[int, Sequence[JointMotion]] = {}

        def trunk(i: int, constants: LinkConstants) -> JointMotion:
            if i in place:
                return hinge_motion(c[place[i]], s[place[i]], vs[i])
            if isinstance(dofs[i].kind, FrameKind):
                start = self.topology.frame_starts[dofs[i].joint]
                if start not in beams:
                    beams[start] = frame_motions(dofs[i], constants, qs, vs, *rates)
                return beams[start][i - start]
            return dof_motion(dofs[i], constants, qs, vs)

        def limbs(index: Sequence[int], constants: LinkConstants) -> JointColumns:
            hinge, dof = index[0] in place, dofs[index[0]]
            speeds = zip(*(dofs[i].v for i in index), strict=True)
            speed = [0.0 if v is None else rows(1, at) for at in speeds]
            if hinge:
                at = [rows_of(x, [place[i] for i in index]) for x in (c, s)]
            else:
                at = [rows(0, every) for every in zip(*(dofs[i].q for i in index), strict=True)]
            more = []
            if isinstance(dof.kind, FrameKind):
                every = list(zip(*(dofs[i].v for i in index), strict=True))
                more = [[rows(2 + k, at) for at in every] for k in range(len(along))]
            columns = constants, at, speed, more

            def posed(lane_of: Callable[[Any], Lane]) -> PosedJoint:
                constants, at, v, more = jax.tree.map(lane_of, columns)
                if hinge:
                    cosine, sine = at
                    return PosedJoint(hinge_motion(cosine, sine, v[0]), constants)
                if isinstance(dof.kind, FrameKind):
                    start = self.topology.frame_starts[dof.joint]
                    frames = shared(lane_of, start, dof.kind, at, v, constants, *more)
                    return PosedJoint(frames[index[0] - start], constants)
                return PosedJoint(dof.kind.motion(at, v, constants), constants)

            return JointColumns(posed, columns)

        made: dict[int, tuple[Any, Sequence[JointMotion]]] = {}

        def shared(lane_of: Any, start: int, kind: FrameKind, *given: Any):
            """Compute the frames of a flexible link once for each iteration of a loop."""
            if start not in made or made[start][0] is not lane_of:
                made[start] = lane_of, kind.motions(*given)
            return made[start][1]

        out = self._parts(trunk, limbs, self.constants)
        return Parts(fusion_barrier(out.trunk), out.rest)

    def lanes(self, x: jax.Array | None, links: Sequence[int] | None = None) -> Parts:
        place = {} if x is None else self._rows(links)
        rows: Any = x
        return self._parts(
            lambda i: rows[place[i]] if i in place else 0.0,
            lambda at: rows_of(x, [place[i] for i in at]) if at[0] in place else 0.0,
        )

    def total(self, values: Parts) -> Lane:
        out = total(values.trunk)
        for group, positions in zip(self._groups, values.rest, strict=True):
            for x in positions:
                literal = is_literal(x)
                out = add(out, x * len(group.links) if literal else self._cast(x).sum(0))
        return out

    def scattered(self, values: Mapping[int, Any], zero: Any) -> Parts:
        return self._parts(
            lambda i: values.get(i, zero),
            lambda links: jax.tree.map(merge, *(values.get(i, zero) for i in links)),
        )

    def _rows(self, links: Sequence[int] | None) -> dict[int, int]:
        """Return the rows of links, by default of those with a coordinate, which come first."""
        given = range(self.topology.nv) if links is None else links
        return {link: k for k, link in enumerate(given)}

    def pack(self, lanes: Parts, like: jax.Array, links: Sequence[int] | None = None) -> jax.Array:
        # limbs with consecutive rows are written as one block
        place = self._rows(links)
        rows = {place[i]: x for i, x in zip(self._trunk, lanes.trunk, strict=True) if i in place}
        blocks: dict[int, jax.Array] = {}
        for group, columns in zip(self._groups, lanes.rest, strict=True):
            shape = (len(group.links), 1, *like.shape[1:])
            own = [x for i, x in zip(group.links[0], columns, strict=True) if i in place]
            wide = [widen(jnp.asarray(x, like.dtype), shape) for x in own]
            block = jnp.concatenate(wide, 1)
            every = [place[i] for limb in group.links for i in limb if i in place]
            block = block.reshape(len(every), *like.shape[1:])
            if every == list(range(every[0], every[0] + len(every))):
                blocks[every[0]] = block
            else:
                rows |= {i: block[n] for n, i in enumerate(every)}
        for first in [i for i in rows if i - 1 not in rows]:
            run = [rows[i] for i in itertools.takewhile(rows.__contains__, itertools.count(first))]
            blocks[first] = pack(run, like[: len(run)])
        return jnp.concatenate([blocks[i] for i in sorted(blocks)])

    def whole(self, values: Parts) -> list:
        out: list = [None] * len(self.topology.links)
        for i, x in zip(self._trunk, values.trunk, strict=True):
            out[i] = x
        for group, positions in zip(self._groups, values.rest, strict=True):
            for j, limb in enumerate(group.links):
                for i, x in zip(limb, self._limb(positions, j), strict=True):
                    out[i] = x
        return out

    def rows(self, whole: list) -> Parts:
        return self._parts(
            lambda i: whole[i],
            lambda links: jax.tree.map(self._column_of, *(whole[i] for i in links)),
        )

    def _column_of(self, *lanes: Lane) -> Any:
        """Return the column from which the lanes of the limbs were read, or a new column."""
        _, column, _ = self._read.get(id(lanes[0]), (None, None, 0))
        for j, x in enumerate(lanes):
            _, own, limb = self._read.get(id(x), (None, None, 0))
            if own is None or own is not column or limb != j:
                return merge(*lanes)
        return column

    def zip(self, *values: Parts) -> Parts:
        groups = zip(*(v.rest for v in values), strict=True)
        limbs = [list(zip(*positions, strict=True)) for positions in groups]
        return Parts(list(zip(*(v.trunk for v in values), strict=True)), limbs)

    def part(self, values: Parts, k: int) -> Parts:
        return Parts([x[k] for x in values.trunk], [[x[k] for x in xs] for xs in values.rest])

    def outward(self, step: Step, root: Any, xs: Parts) -> Parts:
        """Run an outward sweep over the trunk, then over the limbs."""
        carries, ys = unrolled.outward(self._parents, step, root, xs.trunk)
        if self._series:
            return Parts(ys, [self._outward_series(step, xs.rest[0], carries, root)])

        def limb(group, x, before, known):
            return (), unrolled.outward(group.parents, step, before, x, known)[1]

        return Parts(ys, self._each_group(limb, (), xs, carries, root)[1])

    def inward(self, step: Step, zero: Any, xs: Parts) -> Parts:
        """Run an inward sweep over the limbs, then over the trunk."""
        if self._series:
            return self._inward_series(step, zero, xs)

        def limb(group, x, before, known):
            sums = [zero] * len(x)
            messages, ys = unrolled.inward(group.parents, step, sums, x, known)
            return messages[0], ys

        sums, limbs = self._each_group(limb, zero, xs, None, None)
        return Parts(unrolled.inward(self._parents, step, sums, xs.trunk)[1], limbs)

    def out_and_in(self, outward: Step, root: Any, inward: Step, zero: Any, xs: Parts) -> Parts:
        # each limb runs both sweeps in one iteration and stores nothing of its outward sweep
        carries, first = unrolled.outward(self._parents, outward, root, xs.trunk)
        if self._series:
            start = self._outward_series(outward, xs.rest[0], carries, root, starts=True)
            return self._inward_series(inward, zero, xs, (outward, first, start))

        def limb(group, x, before, known):
            y = unrolled.outward(group.parents, outward, before, x, known)[1]
            sums, both = [zero] * len(x), list(zip(x, y, strict=True))
            messages, ys = unrolled.inward(group.parents, inward, sums, both, known)
            return messages[0], ys

        sums, limbs = self._each_group(limb, zero, xs, carries, root)
        both = list(zip(xs.trunk, first, strict=True))
        return Parts(unrolled.inward(self._parents, inward, sums, both)[1], limbs)

    @property
    def _series(self) -> Group | None:
        """The group of limbs in series, which is the only group, or None."""
        return next((group for group in self._groups if group.port is not None), None)

    def _outward_series(
        self, step: Step, xs: list, carries: list, root: Any, *, starts: bool = False
    ) -> Any:
        """Run an outward sweep over limbs in series. Return the outputs, stacked; if `starts`, the
        carries at the starts of the limbs instead."""
        group = self._groups[0]
        port, last = self._place[group.carriers[0]], group.port or 0
        before = as_arrays(root if port == WORLD else carries[port], self._like)

        def body(before, given, known):
            made, ys = unrolled.outward(group.parents, step, before, given, known)
            return as_arrays(made[last], self._like), before if starts else ys

        return self._loop(group, body, before, xs)[1]

    def _inward_series(self, step: Step, zero: Any, xs: Parts, first: tuple | None = None) -> Parts:
        """Run an inward sweep over limbs in series, then over the trunk.

        first: the outward step of `out_and_in`, its outputs in the trunk, and its carries at the
            starts of the limbs. The outputs in the limbs are computed again.
        """
        group = self._groups[0]
        outward, trunk, starts = first or (None, [], ())

        def body(message, given, known):
            x, start = given
            if outward is not None:
                ys = unrolled.outward(group.parents, outward, start, x, known)[1]
                x = list(zip(x, ys, strict=True))
            sums = [message if k == group.port else zero for k in range(len(x))]
            messages, ys = unrolled.inward(group.parents, step, sums, x, known)
            return as_arrays(messages[0], self._like), ys

        start = as_arrays(zero, self._like)
        message, ys = self._loop(group, body, start, (xs.rest[0], starts), reverse=True)
        sums, port = [zero] * len(self._trunk), self._place[group.carriers[0]]
        if port != WORLD:
            sums[port] = message
        own = list(zip(xs.trunk, trunk, strict=True)) if first else xs.trunk
        return Parts(unrolled.inward(self._parents, step, sums, own)[1], [ys])

    def _each_group(
        self, limb: Callable, zero: Any, xs: Parts, carries: list | None, root: Any
    ) -> tuple[list, list]:
        """Call limb(group, xs, carry, known) -> (message, ys) for every limb.

        Return the sum of the messages to each link of the trunk, and the columns of ys.

        carries: carry of each link of the trunk, to which limbs are attached.
        root: carry at the base.
        """
        sums, out = [zero] * len(self._trunk), []
        for group, positions in zip(self._groups, xs.rest, strict=True):
            messages, ys = self._one_group(group, limb, zero, positions, carries, root)
            out.append(ys)
            for port, message in messages:
                sums[port] = jax.tree.map(add, sums[port], message)
        return sums, out

    def _one_group(
        self, group: Group, limb: Callable, zero: Any, xs: list, carries: list | None, root: Any
    ) -> tuple[list[tuple[int, Any]], Any]:
        """Run `limb` for a group of equal limbs. Return (link of the trunk, value passed to it) of
        each limb, and the outputs of the links, stacked."""
        ports = [self._place[i] for i in group.carriers]
        together = len(set(ports)) == 1
        summed = together and ports[0] != WORLD
        before = [] if carries is None else [root if p == WORLD else carries[p] for p in ports]
        starts = jax.tree.map(merge, *before) if before and not together else None

        def body(total, given, known):
            x, own = given
            start = before[0] if before and together else own
            message, ys = limb(group, x, start, known)
            if not summed:
                return (), (() if together else message, ys)
            return as_arrays(jax.tree.map(add, total, message), self._like), ((), ys)

        start = as_arrays(zero, self._like) if summed else ()
        total, (messages, ys) = self._loop(group, body, start, (xs, starts))
        if together:
            return [(ports[0], total)] if summed else [], ys
        pairs = [(port, self._limb(messages, j)) for j, port in enumerate(ports) if port != WORLD]
        return pairs, ys

    def _limb(self, columns: Any, j: int) -> Any:
        """Return the lanes of limb j in a pytree of columns over the limbs."""

        def lane(column):
            cast = self._cast(column)
            found = (whole_cotangent(cast) if isinstance(cast, jax.Array) else cast)[j]
            self._read[id(found)] = found, column, j
            return found

        return jax.tree.map(Iteration(lane), columns)

    def _loop(
        self, group: Group, body: Callable, carry: Any, given: Any, *, reverse: bool = False
    ) -> tuple[Any, Any]:
        """Scan carry, out = body(carry, given, known) over the limbs of a group."""

        def scan(step: Callable, carry: Any, columns: list) -> tuple[Any, Any]:
            # the transpose recomputes the values of a limb instead of storing them
            step = jax.checkpoint(step, prevent_cse=False)
            return jax.lax.scan(
                step, carry, ((), columns), length=len(group.links), reverse=reverse
            )

        def with_known(carry: Any, lanes: Any, _: tuple, here: Iteration) -> tuple[Any, Any]:
            return body(carry, lanes, [posed.recomputed for _, posed in here.joints.values()])

        return loop(scan, with_known, carry, given, self._cast)

    def _cast(self, column: Any) -> Any:
        if isinstance(column, np.ndarray):
            return column.astype(self._like.dtype)
        return column
