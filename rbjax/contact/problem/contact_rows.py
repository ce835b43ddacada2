"""Rows of the contact problem that belong to contacts of geoms.

A loop over the pairs of geoms runs the narrow phase and stores the active contacts in consecutive
slots. The rows, and all further loops, are of the active contacts, so their cost follows the number
of contacts and not of candidates. There is a slot for each candidate, so no contact is lost.

Rows are in world axes about one origin o near the robot. With b_k = [(p - o) x e_k; e_k] for the
axes e_k of a contact at p, and the twists V of its two links about o,

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
from rbjax.contact.problem.world import World, shape_of
from rbjax.contact.rows.contact_at_the_end import contact_at_the_end, stretch
from rbjax.contact.rows.options import Options
from rbjax.forces.impedance import impedance, reference, regularisation
from rbjax.lanes import Lane, Mat3, Vec3, mul, pack, sub, total, unpack
from rbjax.spatial import ArticulatedInertia, Force, Motion


class Row(NamedTuple):
    """The rows of one contact, on lanes.

    Fields:
        pair: index of its pair of geoms.
        axes: b_k = [(p - o) x e_k; e_k] of each row, for the axis e_k of the contact at p, about o.
        D: inverse regularization of the normal row, 0 if the contact is not active.
        reference: reference acceleration of each row.
        contact: the contact about the origin.
        candidate: index of the candidate in its set.
        first_axes: the axes b_k in the axes of the first link, if the axes of the two links differ.
        bristle: displacement of each friction row, if they have bristles.
        latch: the latched normal force, or None.
    """

    pair: Any
    axes: list[Motion]
    D: Lane
    reference: list[Lane]
    contact: Contact
    candidate: Any
    first_axes: Sequence[Motion] = ()
    bristle: Sequence[Lane] = ()
    latch: Lane | None = None

    def along(self, y: Motion) -> list[Lane]:
        """Compute the velocity along each row of the contact, b_k . y, for a relative twist y."""
        return [axis.dot(y) for axis in self.axes]

    def wrench(self, f: Sequence[Lane]) -> Force:
        """Compute the wrench of the forces f along the rows, the sum of b_k f_k."""
        return wrench_along(self.axes, f)

    def stiffness(self, H: Sequence[Sequence[Lane]]) -> ArticulatedInertia:
        """Compute the 6 by 6 stiffness of the contact, the sum of b_k H_kl b_l^T over its rows.

        H: lower triangle of the Hessian in the rows.
        """
        out, n = ArticulatedInertia.zero(), len(self.axes)
        for k, axis in enumerate(self.axes):
            row = [H[max(k, j)][min(k, j)] for j in range(n)]
            out = out + ArticulatedInertia.outer(Force(axis.ang, axis.lin), self.wrench(row))
        return out


def wrench_along(axes: Sequence[Motion], f: Sequence[Lane]) -> Force:
    """Compute the wrench sum of b_k f_k of forces f_k along axes b_k."""
    components = zip(*map(list, axes), strict=True)
    return Force.from_lanes(
        [total(mul(x, y) for x, y in zip(row, f, strict=True)) for row in components]
    )


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
            return row.along(Motion.from_lanes(unpack(twists[k])) * sign)
        one, other = (unpack(twists[k]) for k in self._ends(row))
        if not self.coupled:
            return row.along(Motion.from_lanes([y - x for x, y in zip(one, other, strict=True)]))
        first, second = Motion.from_lanes(one), Motion.from_lanes(other)
        both = zip(row.first_axes, row.axes, strict=True)
        return [b.dot(second) - a.dot(first) for a, b in both]

    def residual(self, row: Row, twists: jax.Array) -> list[Lane]:
        """Compute the residual J x - a_ref of a contact's rows from the link twists at x."""
        both = zip(self.rates(row, twists), row.reference, strict=True)
        return [sub(a, b) for a, b in both]

    def add_forces(self, row: Row, wrenches: jax.Array, f: Sequence[Lane]) -> jax.Array:
        """Add the forces f along the rows of a contact to the wrenches on its two links."""
        if self.grounded:
            k, sign = self._moving_end(row)
            return wrenches.at[k].add(jnp.stack(list(row.wrench(f) * sign)))
        one, other = self._ends(row)
        second = jnp.stack(list(row.wrench(f)))
        first = jnp.stack(list(wrench_along(row.first_axes, f))) if self.coupled else second
        return wrenches.at[one].add(-first).at[other].add(second)

    def _moving_end(self, row: Row) -> tuple[Any, Lane]:
        """Return the link of a contact with the world, and 1 if it is the second link, else -1."""
        signs = np.where(self.links[:, 1] < self.links[:, 0], 1.0, -1.0)
        return entry(self.links.min(1), row.pair), self._lane(signs, row.pair)

    def _ends(self, row: Row) -> list[Any]:
        """Return the indices of the two links of a contact."""
        return [entry(self.links[:, k], row.pair) for k in (0, 1)]

    def add_stiffness(self, row: Row, sums: jax.Array, K: ArticulatedInertia) -> jax.Array:
        """Add the stiffness K of a contact to the sum (n, 21) of its pair of links."""
        lanes = jnp.stack([*K.J, *K.H, *K.M])
        return sums.at[entry(self.link_pairs, row.pair)].add(lanes)

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
        row = Row(pair, axes[-1], 0.0, [], contact, candidate, axes[0] if self.coupled else ())
        v = self.rates(row, world.twists)
        r = jnp.where(active, contact.distance - margin, 0.0)
        D, references = self._reference(row, r, v)
        if world.responses is not None:
            mu = () if self.options.elliptic else self.cone(row).mu
            D = D * stretch(row.axes, mu, world.responses[:, entry(self.link_pairs, pair)])
        return row._replace(D=jnp.where(active, D, 0.0), reference=references)

    def axes(self, world: World, contact: Contact, pair: Any) -> list[list[Motion]]:
        """Compute the axes b_k of the rows of a contact: in the axes of both links if the set is
        coupled, else once."""
        e, p = contact_frame(contact.normal, contact.tangent), contact.position
        every = [Motion(p.cross(x), x) for x in e] + [Motion(x, Vec3.zero()) for x in e]
        axes = every[: self.dim]
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
        rows: (n, 7 dim + 1) D, reference accelerations and axes of each slot. Coupled sets have the
            axes of both links (n, 13 dim + 1).
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
            lanes = [x for axis in [*row.axes, *row.first_axes] for x in axis]
            return rows.at[k].set(pack([row.D, *row.reference, *lanes], rows[0]))

        shape = contacts.candidates, (13 if contacts.coupled else 7) * contacts.dim + 1
        none = jax.lax.empty(shape, world.geoms.dtype)
        return cls(found, found.fold(compute, none))

    def row(self, k: Any, dim: int) -> Row:
        """Return the rows of active contact k. dim: number of rows."""
        (D, *x), found = unpack(self.rows[k]), self.found
        starts = range(dim, len(x), 6)
        axes = [Motion.from_lanes(x[i : i + 6]) for i in starts]
        at = found.contact(k), found.candidates[k]
        return Row(found.pairs[k], axes[:dim], D, x[:dim], *at, axes[dim:])

    def fold(self, step: Callable[[Any, Any], Any], carry: Any) -> Any:
        """Run carry = step(k, carry) over the indices k of all active contacts."""
        return self.found.fold(step, carry)

    def unless(self, empty: Any) -> Slots:
        """Return these slots, or no active contacts if `empty`."""
        length = jnp.where(empty, 0, self.found.length)
        return self._replace(found=self.found._replace(length=length))


def _in_link(pose: jax.Array, axes: Sequence[Motion]) -> list[Motion]:
    """Transform axes about the origin to the axes of a link."""
    x = unpack(pose)
    E, p = Mat3(*x[:9]).T, Vec3(*x[9:])
    return [Motion(E @ (b.ang - p.cross(b.lin)), E @ b.lin) for b in axes]


def entry(table: Any, index: Any) -> Any:
    """Return a row of a table, without a gather if the table or the index is constant."""
    if not isinstance(table, np.ndarray):
        return table[index]
    if (table == table[:1]).all():
        return table[0]
    return table[index] if isinstance(index, int) else jnp.asarray(table)[index]
