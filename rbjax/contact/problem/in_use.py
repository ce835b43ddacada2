"""Forces of the contacts in use as differentiable functions of the state and the parameters.

The narrow phase tells which candidates are in use (`InUse`). Their places, rows and forces are
computed again by loops over them, which have derivatives in both modes (`Turns`). The features that
touch are held constant; points and normals are differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler.jax.turns import Rows, Turns
from rbjax.contact.geometry.candidates import pair_contacts
from rbjax.contact.geometry.narrow_phase import COUNTS
from rbjax.contact.problem.contact_rows import ContactSet, Found
from rbjax.contact.problem.world import World, shape_of
from rbjax.contact.rows.split_tables import SplitTables, entry
from rbjax.lanes import Lane, pack

#: function (set, row, forces, residual) -> numbers of a contact to store
Numbers = Callable[[Any, Any, list[Lane], list[Lane]], jax.Array]


class InUse(NamedTuple):
    """The contacts in use of a set, in the order of the narrow phase.

    Fields:
        length: their number.
        pairs: (n,) the pair of geoms of each contact.
        candidates: (n,) the candidate of each contact.
    """

    length: jax.Array
    pairs: jax.Array
    candidates: jax.Array

    @classmethod
    def of(cls, found: Found) -> InUse:
        """Return the contacts that a narrow phase has found."""
        return cls(found.length, found.pairs, found.candidates)


def wrenches_in_use(
    contacts: ContactSet, world: World, twists: jax.Array, used: InUse,
    numbers: Numbers | None = None, width: int = 0,
) -> list[jax.Array]:  # fmt: skip
    """Compute the wrenches (n + 1, 6) of the contacts in use on the links that can touch.

    twists: (n + 1, 6) of these links at the accelerations.
    numbers: function that gives `width` numbers of each contact. They are the second result, one
        row a candidate, and zeros for a candidate that is not in use.
    """
    places = _places(contacts, world, used)
    split = [SplitTables.of(x) for x in contacts.tables]
    ends = [np.ascontiguousarray(contacts.links[:, k]) for k in (0, 1)]
    moving = contacts.links.min(1)  # if one of the links is the world, it is the last one
    responses = world.responses
    given = [places, world.twists, twists]
    if world.poses is not None:
        given.append(world.poses)
    if responses is not None:  # one row a pair of links
        given.append(responses.swapaxes(0, 1).reshape(responses.shape[1], -1))
    counts = [len(x.arrays) for x in split]

    def loop(visit: Callable, carry: Any, counters: Sequence[Any]) -> Any:
        length, pairs, candidates = counters
        turn = lambda k, carry: visit((pairs[k], candidates[k]), carry)  # noqa: E731
        return jax.lax.fori_loop(0, length, turn, carry)

    def both(pair: Any) -> list[tuple[Any, int]]:
        return [(entry(x, pair), 1) for x in ends]

    def reads(at: Any) -> list[Rows]:
        pair, candidate = at
        own: list[Rows] = [[(candidate, 1)], both(pair), both(pair)]
        if world.poses is not None:
            own.append(both(pair) if contacts.coupled else [(entry(moving, pair), 1)])
        if responses is not None:
            own.append([(entry(contacts.link_pairs, pair), 1)])
        where: list[Rows] = [[(pair, 1)], [(candidate, 1)], None]
        return [*own, *(x for x, n in zip(where, counts, strict=True) for _ in range(n))]

    def writes(at: Any) -> list[Rows]:
        pair, candidate = at
        return [both(pair)] if numbers is None else [both(pair), [(candidate, 1)]]

    def term(at: Any, *rows: jax.Array) -> list[jax.Array]:
        rest = iter(rows)
        place, at_v, at_a = (next(rest) for _ in range(3))
        pose = None if world.poses is None else next(rest)
        response = None if responses is None else next(rest).reshape(2, 1, -1)
        own = [
            x.filled([next(rest) for _ in x.arrays], index)
            for x, index in zip(split, (at[0], at[1], None), strict=True)
        ]
        zero = np.zeros(1, int)
        one = replace(
            contacts.with_tables(own), geoms=np.zeros((1, 2), int), links=np.array([[0, 1]]),
            link_pairs=zero, grounded=False,
        )  # fmt: skip
        own_world = World(place, at_v, pose, responses=response)
        row = one.row_of_found(own_world, Found(1, place, zero, zero), 0)
        r = one.residual(row, at_a)
        f = one.cone(row).response(r).f
        wrenches = one.add_forces(row, jnp.zeros_like(at_a), f)
        return [wrenches] if numbers is None else [wrenches, numbers(one, row, f, r)[None]]

    results = [(len(twists), 6), (contacts.candidates, width)][: 1 if numbers is None else 2]
    operands = [*given, *(x for s in split for x in s.arrays)]
    return Turns(loop, reads, writes, term)(operands, used, results)


def _places(contacts: ContactSet, world: World, used: InUse) -> jax.Array:
    """Compute the place (n, 10) of each candidate in use, as `Found.contacts`."""
    ends = [np.ascontiguousarray(contacts.geoms[:, k]) for k in (0, 1)]
    dtype, given = world.geoms.dtype, contacts.parameters
    reach = SplitTables.of(given.margin + given.gap)
    heights = SplitTables.of(world.heights)
    starts, start = [], 0
    for kind, pairs in contacts.kinds.items():
        count = COUNTS[kind.kinds]
        starts.append((start, start + count * len(pairs), count))
        start += count * len(pairs)
    kinds = list(contacts.kinds)

    def loop(visit: Callable, carry: Any, counters: Sequence[Any]) -> Any:
        length, pairs, candidates = counters
        k, last = jnp.zeros_like(length), len(candidates) - 1
        for kind, (start, stop, count) in enumerate(starts):
            only = stop == starts[-1][1]

            def unfinished(at: tuple, stop: int = stop, only: bool = only) -> Any:
                k, _ = at
                more = k < length
                return more if only else more & (candidates[jnp.minimum(k, last)] < stop)

            def turn(at: tuple, kind: int = kind, start: int = start, count: int = count) -> tuple:
                k, carry = at
                pair, candidate = pairs[k], candidates[k]
                first = candidate - (candidate - start) % count
                carry = visit((kind, pair, first), carry)
                if count == 1:
                    return k + 1, carry

                def same(k: Any, pair: Any = pair) -> Any:  # other contacts of it
                    return (k < length) & (pairs[jnp.minimum(k, last)] == pair)

                return jax.lax.while_loop(same, lambda k: k + 1, k + 1), carry

            k, carry = jax.lax.while_loop(unfinished, turn, (k, carry))
        return carry

    def reads(at: Any) -> list[Rows]:
        _, pair, _ = at
        both = [(entry(x, pair), 1) for x in ends]
        return [both, *([(pair, 1)] for _ in reach.arrays), *(None for _ in heights.arrays)]

    def writes(at: Any) -> list[Rows]:
        kind, _, first = at
        return [[(first, starts[kind][2])]]

    def term(at: Any, geoms: jax.Array, *rest: jax.Array) -> list[jax.Array]:
        kind, pair, _ = at
        n = len(reach.arrays)
        bound = reach.filled(rest[:n], pair)[0]
        bound = float(bound) if isinstance(bound, np.generic) else bound.astype(dtype)
        one, other = (shape_of(x) for x in geoms)
        surfaces = heights.filled(rest[n:], None)
        found = pair_contacts(kinds[kind], one, other, bound, surfaces)
        return [jnp.stack([pack(x.lanes, geoms[0]) for x in found])]

    operands = [world.geoms, *reach.arrays, *heights.arrays]
    return Turns(loop, reads, writes, term)(operands, used, [(contacts.candidates, 10)])[0]
