"""Rows of the contact problem that belong to contacts of geoms.

A loop over the pairs of geoms runs the narrow phase and stores the active contacts in consecutive
slots. The rows, and all further loops, are of the active contacts, so their cost follows the number
of contacts and not of candidates. There is a slot for each candidate, so no contact is lost.

Rows are in world axes about one origin o near the robot, or in the axes of the links. With the unit
motions b_k of the rows (`ContactAxes`), and the twists V of the two links,

    J v = b_k . (V_2 - V_1),    J^T f: the wrench sum of b_k f_k on link 2, its opposite on link 1
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact.geometry.candidates import PairKind, pair_contacts
from rbjax.contact.geometry.narrow_phase import COUNTS
from rbjax.contact.geometry.shapes import Contact, contact_frame
from rbjax.contact.parameters import tangential_solref
from rbjax.contact.problem.cones import Cone
from rbjax.contact.problem.contact_axes import ContactAxes
from rbjax.contact.problem.link_stiffness import LinkStiffness
from rbjax.contact.problem.world import World, shape_of
from rbjax.contact.rows.contact_at_the_end import contact_at_the_end, stretch
from rbjax.contact.rows.options import Options
from rbjax.contact.rows.split_tables import entry
from rbjax.forces.impedance import impedance, reference, regularisation
from rbjax.lanes import Lane, Mat3, Vec3, pack, sub, unpack
from rbjax.spatial import Motion


class Row(NamedTuple):
    """The rows of one contact, on lanes.

    Fields:
        pair: index of its pair of geoms.
        axes: point and axes of the contact, about o.
        D: inverse regularization of the normal row, 0 if the contact is not active.
        reference: reference acceleration of each row.
        contact: the contact about the origin.
        candidate: index of the candidate in its set.
        first_axes: point and axes in the axes of the first link, if those of the two links differ.
        bristle: displacement of each friction row, if they have bristles.
        latch: the latched normal force, or None.
    """

    pair: Any
    axes: ContactAxes
    D: Lane
    reference: list[Lane]
    contact: Contact
    candidate: Any
    first_axes: ContactAxes | None = None
    bristle: Sequence[Lane] = ()
    latch: Lane | None = None


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
        coupled: whether both links move and rows are in the axes of their links.
        grounded: whether one of the links of each contact is the world.
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
    coupled: bool
    grounded: bool

    @property
    def tables(self) -> tuple[Any, Any, Any]:
        """The parameters of the set: by pair, by candidate, and those that all contacts share."""
        columns = self.parameters._replace(condim=())
        return (columns, self.weights), (), self.options

    def with_tables(self, tables: Sequence[Any]) -> ContactSet:
        """Return the set with other `tables`."""
        (parameters, weights), _, options = tables
        return replace(self, parameters=parameters, weights=weights, options=options)

    @property
    def candidates(self) -> int:
        """The number of candidate contacts."""
        return sum(COUNTS[kind.kinds] * len(pairs) for kind, pairs in self.kinds.items())

    def cone(self, row: Row) -> Cone:
        """Return the friction cone of a contact."""
        mu = self._lanes(self.parameters.friction, row.pair)[: self.dim - 1]
        return Cone(self.options.elliptic, row.D, tuple(mu), self.options.impratio)

    def rates(self, row: Row, twists: jax.Array) -> list[Lane]:
        """Compute the velocity along each row of a contact, J v, from the link twists at v."""
        if self.grounded:
            k, sign = self._moving_end(row)
            return row.axes.rates(Motion.from_lanes(unpack(twists[k])) * sign)
        one, other = (unpack(twists[k]) for k in self._ends(row))
        if row.first_axes is None:
            difference = [y - x for x, y in zip(one, other, strict=True)]
            return row.axes.rates(Motion.from_lanes(difference))
        first = row.first_axes.rates(Motion.from_lanes(one))
        second = row.axes.rates(Motion.from_lanes(other))
        return [b - a for a, b in zip(first, second, strict=True)]

    def residual(self, row: Row, twists: jax.Array) -> list[Lane]:
        """Compute the residual J x - a_ref of a contact's rows from the link twists at x."""
        both = zip(self.rates(row, twists), row.reference, strict=True)
        return [sub(a, b) for a, b in both]

    def add_forces(self, row: Row, wrenches: jax.Array, f: Sequence[Lane]) -> jax.Array:
        """Add the forces f along the rows of a contact to the wrenches on its two links."""
        if self.grounded:
            k, sign = self._moving_end(row)
            return wrenches.at[k].add(jnp.stack(list(row.axes.wrench(f) * sign)))
        one, other = self._ends(row)
        second = jnp.stack(list(row.axes.wrench(f)))
        first = second if row.first_axes is None else jnp.stack(list(row.first_axes.wrench(f)))
        return wrenches.at[one].add(-first).at[other].add(second)

    def _moving_end(self, row: Row) -> tuple[Any, Lane]:
        """Return the link of a contact with the world, and 1 if it is the second link, else -1."""
        signs = np.where(self.links[:, 1] < self.links[:, 0], 1.0, -1.0)
        return entry(self.links.min(1), row.pair), self._lane(signs, row.pair)

    def _ends(self, row: Row) -> list[Any]:
        """Return the indices of the two links of a contact."""
        return [entry(self.links[:, k], row.pair) for k in (0, 1)]

    def add_stiffness(
        self, row: Row, sums: LinkStiffness, H: Sequence[Sequence[Lane]]
    ) -> LinkStiffness:
        """Add the stiffness of a contact with the Hessian H in its rows to its pair of links."""
        return sums.add(entry(self.link_pairs, row.pair), row.axes.stiffness(H))

    def _scan(self, world: World, step: Callable, carry: Any) -> Any:
        """Run carry = step(carry, contact, pair, candidate, active) over all candidate contacts."""
        start = 0
        for kind, pairs in self.kinds.items():
            count = COUNTS[kind.kinds]

            def of_pair(carry: Any, at: Any, kind: Any = kind) -> tuple[Any, None]:
                pair, first = at
                one, other = (shape_of(world.geoms[entry(self.geoms[:, k], pair)]) for k in (0, 1))
                margin = self._lane(self.parameters.margin, pair)
                reach = margin + self._lane(self.parameters.gap, pair)
                found = pair_contacts(kind, one, other, reach, world.heights)
                for k, contact in enumerate(found):
                    active = contact.exists & (contact.distance < margin)
                    carry = step(carry, contact, pair, first + k, active)
                return carry, None

            if len(pairs) == 1:
                carry, _ = of_pair(carry, (pairs[0], start))
            else:
                firsts = start + count * np.arange(len(pairs))
                carry, _ = jax.lax.scan(of_pair, carry, (jnp.asarray(pairs), jnp.asarray(firsts)))
            start += count * len(pairs)
        return carry

    def found(self, world: World, *, gap: bool = False) -> Found:
        """Run the narrow phase and store the active contacts.

        gap: whether to store the contacts in the gap too, which have no force.
        """

        def store(found: Found, contact: Contact, pair: Any, candidate: Any, active: Any) -> Found:
            # a branch, because stores at places that differ between the lanes of a warp are slow
            k, more = found.length, contact.exists if gap else active
            lanes = contact.lanes

            def stored() -> Found:
                return Found(
                    k + 1,
                    found.contacts.at[k].set(pack(lanes, found.contacts[0])),
                    found.pairs.at[k].set(jnp.asarray(pair, jnp.int32)),
                    found.candidates.at[k].set(jnp.asarray(candidate, jnp.int32)),
                )

            return jax.lax.cond(more, stored, lambda: found)

        n, dtype = self.candidates, world.geoms.dtype
        # what lies in slots that are not in use is never read
        index, none = jnp.zeros(n, jnp.int32), jax.lax.empty((n, 10), dtype)
        return self._scan(world, store, Found(jnp.int32(0), none, index, index))

    def row_of_found(self, world: World, found: Found, k: Any) -> Row:
        """Compute the rows of contact k of `found`, which the narrow phase has stored."""
        contact, pair = found.contact(k), found.pairs[k]
        active = contact.distance < self._lane(self.parameters.margin, pair)
        return self.row_of(world, contact, pair, found.candidates[k], active)

    def row_of(self, world: World, contact: Contact, pair: Any, candidate: Any, active: Any) -> Row:
        """Compute the rows of a contact. If it is not active, D is 0."""
        margin, axes = self._lane(self.parameters.margin, pair), self.axes(world, contact, pair)
        first = axes[0] if self.coupled else None
        row = Row(pair, axes[-1], 0.0, [], contact, candidate, first)
        v = self.rates(row, world.twists)
        r = jnp.where(active, contact.distance - margin, 0.0)
        D, references = self._reference(row, r, v)
        if world.responses is not None:
            mu = () if self.options.elliptic else self.cone(row).mu
            axis = row.axes.row(0) + row.axes.row(1) * mu[0] if mu else row.axes.row(0)
            D = D * stretch(axis, world.responses[:, entry(self.link_pairs, pair)])
        return row._replace(D=jnp.where(active, D, 0.0), reference=references)

    def axes(self, world: World, contact: Contact, pair: Any) -> list[ContactAxes]:
        """Compute the point and the axes of a contact: for each link if the set is coupled, else
        once."""
        frame = contact_frame(contact.normal, contact.tangent)
        axes = ContactAxes(contact.position, frame[: self.dim], self.dim)
        if world.poses is None:
            return [axes]
        # if one of the links is the world, it is the last one
        links = (self.links[:, 0], self.links[:, 1]) if self.coupled else (self.links.min(1),)
        return [_in_link(world.poses[entry(k, pair)], axes) for k in links]

    def _reference(self, row: Row, r: Lane, v: list[Lane]) -> tuple[Lane, list[Lane]]:
        """Compute the inverse regularization and the reference accelerations of a contact.

        r: distance less margin, m. v: velocity of each row.
        """
        given, options, pair = self.parameters, self.options, row.pair
        solref, solimp = self._lanes(given.solref, pair), self._lanes(given.solimp, pair)
        d, weight, mu = impedance(r, solimp), self._lane(self.weights, pair), self.cone(row).mu
        if options.discrete:
            own = self._lanes(given.solreffriction, pair)
            slides = tangential_solref(solref, own) if options.elliptic else None
            terms = d, weight, solref, slides, solimp, mu
            return contact_at_the_end(r, v, *terms, options.impratio, options.dt, options.refsafe)

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
        found = entry(table, pair)
        if isinstance(found, np.ndarray):
            return [float(x) for x in found]
        return list(found.astype(self.dtype))

    def _lane(self, table: Any, pair: Any) -> Lane:
        """Return the entry of a pair in a table (n,) as a lane."""
        found = entry(table, pair)
        return float(found) if isinstance(found, np.generic) else found.astype(self.dtype)


class Found(NamedTuple):
    """The contacts that the narrow phase of a set has found, in consecutive slots.

    Fields:
        length: the number of contacts.
        contacts: (n, 10) distance, position about the origin, normal, and the direction of the
            first tangent, zero for none.
        pairs: (n,) the pair of geoms of each contact.
        candidates: (n,) the candidate of each contact.
    """

    length: Lane
    contacts: jax.Array
    pairs: Any  # a NumPy array if it is constant while tracing
    candidates: Any  # a NumPy array if it is constant while tracing

    def contact(self, k: Any) -> Contact:
        """Return contact k."""
        x = unpack(self.contacts[k])
        return Contact(x[0], Vec3(*x[1:4]), Vec3(*x[4:7]), True, Vec3(*x[7:]))

    def fold(self, step: Callable[[Any, Any], Any], carry: Any) -> Any:
        """Run carry = step(k, carry) over the indices k of all stored contacts."""
        return jax.lax.fori_loop(0, self.length, step, carry)


def place_of(contact: Contact) -> list[Lane]:
    """Return distance, position and axes of a contact, 13 lanes."""
    axes = contact_frame(contact.normal, contact.tangent)
    return [contact.distance, *contact.position, *(x for axis in axes for x in axis)]


class Slots(NamedTuple):
    """The active contacts of a set with their rows, in consecutive slots.

    Fields:
        found: the contacts.
        rows: (n, m) D, reference accelerations, and the lanes of the axes of each slot; those of
            the first link too if the set is coupled.
    """

    found: Found
    rows: jax.Array

    @classmethod
    def collect(cls, contacts: ContactSet, world: World, *, gap: bool = False) -> Slots:
        """Run the narrow phase of a set, and compute the rows of its contacts.

        gap: whether to include the contacts in the gap, which have no force.
        """
        found = contacts.found(world, gap=gap)

        def compute(k: Any, rows: jax.Array) -> jax.Array:
            row = contacts.row_of_found(world, found, k)
            first = row.first_axes.lanes if row.first_axes else []
            return rows.at[k].set(pack([row.D, *row.reference, *row.axes.lanes, *first], rows[0]))

        shape = contacts.candidates, width_of_rows(contacts.dim, contacts.coupled)
        none = jax.lax.empty(shape, world.geoms.dtype)
        return cls(found, found.fold(compute, none))

    def row(self, k: Any, dim: int) -> Row:
        """Return the rows of active contact k. dim: number of rows."""
        (D, *x), found = unpack(self.rows[k]), self.found
        size = ContactAxes.size(dim)
        axes = [ContactAxes.from_lanes(x[i : i + size], dim) for i in range(dim, len(x), size)]
        at = found.contact(k), found.candidates[k]
        return Row(found.pairs[k], axes[0], D, x[:dim], *at, *axes[1:])

    def fold(self, step: Callable[[Any, Any], Any], carry: Any) -> Any:
        """Run carry = step(k, carry) over the indices k of all active contacts."""
        return self.found.fold(step, carry)

    def unless(self, empty: Any) -> Slots:
        """Return these slots, or no active contacts if `empty`."""
        length = jnp.where(empty, 0, self.found.length)
        return self._replace(found=self.found._replace(length=length))


def width_of_rows(dim: int, coupled: bool = False) -> int:
    """Return the number of lanes of a slot of `Slots.rows`."""
    return 1 + dim + (2 if coupled else 1) * ContactAxes.size(dim)


def _in_link(pose: jax.Array, axes: ContactAxes) -> ContactAxes:
    """Transform a contact about the origin to the axes of a link."""
    x = unpack(pose)
    E, p = Mat3(*x[:9]).T, Vec3(*x[9:])
    return ContactAxes(E @ (axes.point - p), [E @ e for e in axes.axes], axes.dim)
