"""Rows of the contact problem that belong to contacts of geoms.

A loop over the pairs of geoms runs the narrow phase and stores the rows of the active contacts in
consecutive slots. All further loops run over the active contacts, so their cost follows the number
of contacts and not of candidates. There is a slot for each candidate, so no contact is lost.

Rows are in world axes about one origin o near the robot. With b_k = [(p - o) x e_k; e_k] for the
axes e_k of a contact at p, and the twists V of its two links about o,

    J v = b_k . (V_2 - V_1),    J^T f: the wrench sum of b_k f_k on link 2, its opposite on link 1
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact.cones import Cone
from rbjax.contact.geometry.candidates import PairKind, pair_contacts
from rbjax.contact.geometry.narrow_phase import COUNTS
from rbjax.contact.geometry.shapes import Contact, Shape, contact_frame
from rbjax.contact.parameters import tangential_solref
from rbjax.forces.impedance import impedance, reference, regularisation
from rbjax.lanes import Lane, Mat3, Vec3, mul, pack, total, unpack
from rbjax.spatial import ArticulatedInertia, Force, Motion


class Row(NamedTuple):
    """The rows of one contact, on lanes.

    Fields:
        pair: index of its pair of geoms.
        axes: b_k = [(p - o) x e_k; e_k] of each row, for the axis e_k of the contact at p, about o.
        D: inverse regularization of the normal row, 0 if the contact is not active.
        reference: reference acceleration of each row.
        contact: the contact about the origin, if the row is not from a slot.
        candidate: index of the candidate in its set, if the row is not from a slot.
    """

    pair: Any
    axes: list[Motion]
    D: Lane
    reference: list[Lane]
    contact: Contact | None = None
    candidate: Any = None

    def along(self, y: Motion) -> list[Lane]:
        """Compute b_k . y for each row."""
        return [axis.dot(y) for axis in self.axes]

    def wrench(self, f: Sequence[Lane]) -> Force:
        """Compute the wrench sum of b_k f_k."""
        components = zip(*map(list, self.axes), strict=True)
        return Force.from_lanes(
            [total(mul(x, y) for x, y in zip(row, f, strict=True)) for row in components]
        )

    def stiffness(self, H: Sequence[Sequence[Lane]]) -> ArticulatedInertia:
        """Compute the sum of b_k H_kl b_l^T, from the lower triangle of H."""
        out, n = ArticulatedInertia.zero(), len(self.axes)
        for k, axis in enumerate(self.axes):
            row = [H[max(k, j)][min(k, j)] for j in range(n)]
            out = out + ArticulatedInertia.outer(Force(axis.ang, axis.lin), self.wrench(row))
        return out


class Options(NamedTuple):
    """Options that all contacts of a problem share.

    Fields:
        elliptic: whether friction cones are elliptic or pyramids.
        impratio: impedance of friction over the impedance of the normal row.
        dt: step in s, from which the least time constant of a contact follows.
        refsafe: whether time constants are at least two steps.
    """

    elliptic: bool
    impratio: Lane
    dt: Any
    refsafe: bool


class World(NamedTuple):
    """The geoms and links that can touch, about the common origin.

    Fields:
        geoms: (n, 15) rotation, position and size of each geom.
        twists: (n, 6) twist of each link; the last one is the world.
        poses: (n, 12) rotation and position of each link, if rows are in the axes of the link that
            touches the world.
        heights: of the height fields, as `Geoms.heights`.
    """

    geoms: jax.Array
    twists: jax.Array
    poses: jax.Array | None = None
    heights: tuple[jax.Array, ...] = ()


@dataclass(frozen=True)
class ContactSet:
    """All pairs of geoms whose contacts have the same number of rows, with their parameters.

    Fields:
        dim: the number of rows of a contact, 1, 3, 4 or 6.
        kinds: the kind of a pair -> indices of its pairs.
        geoms, links: index of both geoms and both links of each pair (n, 2) in `World`.
        link_pairs: index of the pair of links of each pair of geoms (n,).
        parameters: `PairParameters` of all pairs.
        weights: (n,) sum of the translational inverse weights of both bodies.
        dtype: of all arrays.
    """

    dim: int
    kinds: dict[PairKind, list[int]]
    geoms: np.ndarray
    links: np.ndarray
    link_pairs: np.ndarray
    parameters: Any
    weights: Any
    options: Options
    dtype: Any

    @property
    def candidates(self) -> int:
        """The number of candidate contacts."""
        return sum(COUNTS[kind.kinds] * len(pairs) for kind, pairs in self.kinds.items())

    def cone(self, row: Row) -> Cone:
        """Return the friction cone of a contact."""
        mu = self._lanes(self.parameters.friction, row.pair)[: self.dim - 1]
        return Cone(self.options.elliptic, row.D, tuple(mu), self.options.impratio)

    def relative(self, row: Row, twists: jax.Array) -> Motion:
        """Compute the twist of the second link of a contact relative to the first one."""
        one, other = (twists[_entry(self.links[:, k], row.pair)] for k in (0, 1))
        return Motion.from_lanes([other[k] - one[k] for k in range(6)])

    def add_wrench(self, row: Row, wrenches: jax.Array, wrench: Force) -> jax.Array:
        """Add a wrench on the second link of a contact and its opposite on the first link."""
        lanes = jnp.stack(list(wrench))
        one, other = (_entry(self.links[:, k], row.pair) for k in (0, 1))
        return wrenches.at[one].add(-lanes).at[other].add(lanes)

    def add_stiffness(self, row: Row, sums: jax.Array, K: ArticulatedInertia) -> jax.Array:
        """Add K to the sum (n, 21) of the pair of links of a contact."""
        lanes = jnp.stack([*K.J, *K.H, *K.M])
        return sums.at[_entry(self.link_pairs, row.pair)].add(lanes)

    def scan(self, world: World, step: Callable[[Any, Row, Any], Any], carry: Any) -> Any:
        """Run carry = step(carry, row, active) over all candidates, in loops over the pairs."""
        start = 0
        for kind, pairs in self.kinds.items():
            count = COUNTS[kind.kinds]

            def of_pair(carry: Any, at: Any, kind: Any = kind) -> tuple[Any, None]:
                pair, first = at
                one, other = (_shape(world.geoms[_entry(self.geoms[:, k], pair)]) for k in (0, 1))
                margin = self._lane(self.parameters.margin, pair)
                reach = margin + self._lane(self.parameters.gap, pair)
                found = pair_contacts(kind, one, other, reach, world.heights)
                for k, contact in enumerate(found):
                    active = contact.exists & (contact.distance < margin)
                    row = self._row(world, contact, pair, first + k, margin, active)
                    carry = step(carry, row, active)
                return carry, None

            if len(pairs) == 1:
                carry, _ = of_pair(carry, (pairs[0], start))
            else:
                firsts = start + count * np.arange(len(pairs))
                carry, _ = jax.lax.scan(of_pair, carry, (jnp.asarray(pairs), jnp.asarray(firsts)))
            start += count * len(pairs)
        return carry

    def _row(
        self, world: World, contact: Contact, pair: Any, candidate: Any, margin: Lane, active: Any
    ) -> Row:
        e, p = contact_frame(contact.normal, contact.tangent), contact.position
        axes = [Motion(p.cross(x), x) for x in e] + [Motion(x, Vec3.zero()) for x in e]
        row = Row(pair, self._in_link(world, axes[: self.dim], pair), 0.0, [], contact, candidate)
        v = row.along(self.relative(row, world.twists))
        r = jnp.where(active, contact.distance - margin, 0.0)
        D, references = self._reference(row, r, v)
        return row._replace(D=jnp.where(active, D, 0.0), reference=references)

    def _in_link(self, world: World, axes: list[Motion], pair: Any) -> list[Motion]:
        """Transform axes to the link that touches the world, if all contacts are with the world."""
        if world.poses is None:
            return axes
        moving = _entry(self.links.min(1), pair)  # the world is the last one
        x = unpack(world.poses[moving])
        E, p = Mat3(*x[:9]).T, Vec3(*x[9:])
        return [Motion(E @ (b.ang - p.cross(b.lin)), E @ b.lin) for b in axes]

    def _reference(self, row: Row, r: Lane, v: list[Lane]) -> tuple[Lane, list[Lane]]:
        """Compute the inverse regularization and the reference accelerations of a contact.

        r: distance less margin, m. v: velocity of each row.
        """
        given, options, pair = self.parameters, self.options, row.pair
        solref, solimp = self._lanes(given.solref, pair), self._lanes(given.solimp, pair)
        d, weight, mu = impedance(r, solimp), self._lane(self.weights, pair), self.cone(row).mu

        def towards(r: Lane, v: Lane, solref: Sequence[Lane]) -> Lane:
            return reference(r, v, d, solref, solimp, options.dt, refsafe=options.refsafe)

        out = [towards(r, v[0], solref)]
        sliding: Sequence[Lane] = solref
        if mu and not options.elliptic:
            factor = 2.0 * mu[0] * mu[0] / options.impratio
            R = regularisation(d, weight * (1.0 + mu[0] * mu[0])) * factor
        else:
            R = regularisation(d, weight)
            sliding = tangential_solref(solref, self._lanes(given.solreffriction, pair))
        return 1.0 / R, out + [towards(0.0, x, sliding) for x in v[1:]]

    def _lanes(self, table: Any, pair: Any) -> list[Lane]:
        """Return the row of a pair in a table (n, m) as lanes."""
        found = _entry(table, pair)
        if isinstance(found, np.ndarray):
            return [float(x) for x in found]
        return list(found.astype(self.dtype))

    def _lane(self, table: Any, pair: Any) -> Lane:
        """Return the entry of a pair in a table (n,) as a lane."""
        found = _entry(table, pair)
        return float(found) if isinstance(found, np.generic) else found.astype(self.dtype)


class Places(NamedTuple):
    """The places of the contacts in slots.

    Fields:
        scanned: the number of candidates so far.
        candidates: (n,) index of the candidate of each slot.
        rows: (n, 13) distance, position about the origin, and axes of each slot.
    """

    scanned: jax.Array
    candidates: jax.Array
    rows: jax.Array

    @classmethod
    def empty(cls, n: int, dtype: Any) -> Places:
        """Return the places of n empty slots."""
        return cls(jnp.int32(0), jnp.zeros(n, jnp.int32), jnp.zeros((n, 13), dtype))

    def store(self, k: Any, row: Row) -> Places:
        """Store the place of the next candidate in slot k."""
        values = pack(place_of(row), self.rows[0])
        candidates = self.candidates.at[k].set(self.scanned)
        return Places(self.scanned + 1, candidates, self.rows.at[k].set(values))


def place_of(row: Row) -> list[Lane]:
    """Return distance, position about the origin, and axes of a contact, 13 lanes."""
    contact = row.contact
    assert contact is not None
    axes = contact_frame(contact.normal, contact.tangent)
    return [contact.distance, *contact.position, *(x for axis in axes for x in axis)]


class Slots(NamedTuple):
    """The active contacts of a set, in consecutive slots.

    Fields:
        length: the number of active contacts.
        rows: (n, 7 dim + 1) axes, D and reference accelerations of each slot.
        pairs: (n,) the pair of geoms of each slot.
        places: the places of the contacts, or None.
    """

    length: jax.Array
    rows: jax.Array
    pairs: jax.Array
    places: Places | None = None

    @classmethod
    def collect(cls, contacts: ContactSet, world: World, *, places: bool = False) -> Slots:
        """Run the narrow phase of a set and store the active contacts.

        places: whether to store the places of the contacts too, and the contacts in the gap, which
            have no force.
        """
        n, m, dtype = contacts.candidates, 7 * contacts.dim + 1, world.geoms.dtype
        like = jnp.zeros(m, dtype)

        def store(slots: Slots, row: Row, active: Any) -> Slots:
            # the next contact overwrites one that is not active
            lanes = [x for axis in row.axes for x in axis]
            values = pack([*lanes, row.D, *row.reference], like)
            rows = slots.rows.at[slots.length].set(values)
            pairs = slots.pairs.at[slots.length].set(jnp.asarray(row.pair, jnp.int32))
            at = slots.places
            if at is not None:
                assert row.contact is not None
                at, active = at.store(slots.length, row), row.contact.exists
            return Slots(slots.length + jnp.asarray(active, jnp.int32), rows, pairs, at)

        at = Places.empty(n, dtype) if places else None
        none = Slots(jnp.int32(0), jnp.zeros((n, m), dtype), jnp.zeros(n, jnp.int32), at)
        return contacts.scan(world, store, none)

    def row(self, k: Any, dim: int) -> Row:
        """Return the row of a slot."""
        x = self.rows[k]
        lanes = [x[i] for i in range(7 * dim + 1)]
        axes = [Motion.from_lanes(lanes[6 * i : 6 * i + 6]) for i in range(dim)]
        return Row(self.pairs[k], axes, lanes[6 * dim], lanes[6 * dim + 1 :])

    def fold(self, step: Callable[[Any, Any], Any], carry: Any) -> Any:
        """Run carry = step(k, carry) over the active slots."""
        return jax.lax.fori_loop(0, self.length, step, carry)


def _shape(row: jax.Array) -> Shape:
    lanes = [row[k] for k in range(15)]
    return Shape(Vec3(*lanes[9:12]), Mat3(*lanes[:9]), Vec3(*lanes[12:]))


def _entry(table: Any, index: Any) -> Any:
    """Return a row of a table, without a gather if the table or the index is constant."""
    if not isinstance(table, np.ndarray):
        return table[index]
    if (table == table[:1]).all():
        return table[0]
    return table[index] if isinstance(index, int) else jnp.asarray(table)[index]
