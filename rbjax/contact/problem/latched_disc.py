"""Coulomb friction with a latched normal force: contacts whose normal force ignores friction.

The friction of a contact is in an ellipsoid whose size is the normal force F, which is constant
during the minimisation. With U_k = mu_k r_k, T = |U| and a stiff row D_k = D_1 mu_k^2 / mu_1^2,

    normal     f_0 = -D r_0 for r_0 < 0
    friction   f_k = -D_k r_k               if D_1 T / mu_1^2 <= F, the contact sticks
               f_k = -F mu_k U_k / T        else, the contact slips
For a constant F these forces are the negative gradient of a convex cost, so the Newton method of
soft contact solves the problem. The cost, c T^2 / 2 up to F = c T and F T beyond, has a jump of the
curvature along the slip, from c to 0. At any T0 its bound F T^2 / (2 T0) has the curvature F / T0
in all directions (Weiszfeld). The solution has the true law of Coulomb if F = f_0 at the end.

Each candidate has a bristle: the displacement s that has accumulated since the contact began to
stick. A contact that sticks has the target velocity -share s / h after the step, and therefore no
creep: s <- s + h u sums up what the stiff row leaves. A contact that slips has s = 0.

Source: De Saxce & Feng, *The bipotential method*, 1998 (normal force as a parameter of the disc);
Dahl 1968 and Hayward & Armstrong, *A new computational model of friction*, 2000 (bristle).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.geometry.shapes import Contact, contact_frame
from rbjax.contact.problem.cones import TINY, Response
from rbjax.contact.problem.contact_rows import ContactSet, Found, Row, Slots, width_of_rows
from rbjax.contact.problem.world import World
from rbjax.forces.impedance import impedance, reference, regularisation
from rbjax.lanes import Lane, Vec3, mul, pack, total, unpack

#: entries of the memory of a candidate: normal force, displacement, and rotation if it resists
NORMAL, SLIDE, TURN = 0, slice(1, 4), slice(4, 7)


def memory_width(dim: int) -> int:
    """Return the number of memory entries of a candidate contact with `dim` rows."""
    return {1: 0, 3: 4}.get(dim, 7)


class Disc(NamedTuple):
    """The friction of a contact, as a cone whose normal force is latched.

    Fields:
        D, D_t: the inverse regularization of the normal row and of the first tangent.
        mu: friction coefficients of the other rows.
        latch: the normal force F; if None, the normal force at the residual.
        bounded: whether the Hessian of a slip is the one of the bound of the cost.
    """

    D: Lane
    D_t: Lane
    mu: tuple[Lane, ...]
    latch: Lane | None
    bounded: Any = False

    def normal(self, r: Lane) -> Lane:
        """Compute the normal force at the residual r of the normal row."""
        return jnp.where(r < 0, -self.D * r, 0.0)

    def slip(self, r: Sequence[Lane]) -> tuple[Any, Lane, list[Lane]]:
        """Return whether the contact sticks, F / T, and the unit direction t = U / T of slip."""
        F = self.normal(r[0]) if self.latch is None else self.latch
        U = [mul(m, x) for m, x in zip(self.mu, r[1:], strict=True)]
        square = total(mul(u, u) for u in U)
        some = square > TINY
        T = jnp.sqrt(jnp.where(some, square, 1.0))
        sticks = ~some | (self._c * T <= F)
        return sticks, F / T, [jnp.where(some, u / T, 0.0) for u in U]

    @property
    def _c(self) -> Lane:
        return self.D_t / (self.mu[0] * self.mu[0])

    def response(self, r: Sequence[Lane]) -> Response:
        """Compute the force and the Hessian of the cost at the residual r = J x - a_ref of each
        row."""
        active = jnp.where(r[0] < 0, self.D, 0.0)
        sticks, ratio, t = self.slip(r)
        scale, along = (
            jnp.where(sticks, self._c, ratio),
            jnp.where(sticks | self.bounded, 0.0, ratio),
        )
        f: list[Lane] = [-active * r[0]]
        H: list[list[Lane]] = [[active]]
        for i, m in enumerate(self.mu):
            f.append(-scale * m * m * r[i + 1])
            row: list[Lane] = [0.0]
            for j in range(i + 1):
                entry = (scale if i == j else 0.0) - along * t[i] * t[j]
                row.append(entry * m * self.mu[j])
            H.append(row)
        return Response(f, H)


class DiscSlots(NamedTuple):
    """The active contacts of a set, in consecutive slots.

    Fields:
        found: the contacts.
        rows: (n, m) D, reference accelerations and the lanes of the axes, as in `Slots`.
        bristles: (n, dim - 1) bristle of each contact.
        latches: (n,) the latched normal forces.
    """

    found: Found
    rows: jax.Array
    bristles: jax.Array
    latches: jax.Array

    def row(self, k: Any, dim: int) -> Row:
        """Return the rows of active contact k. dim: number of rows."""
        row = Slots(self.found, self.rows).row(k, dim)
        return row._replace(bristle=unpack(self.bristles[k]), latch=self.latches[k])

    def fold(self, step: Callable[[Any, Any], Any], carry: Any) -> Any:
        """Run carry = step(k, carry) over the indices k of all active contacts."""
        return self.found.fold(step, carry)

    def used(self, values: jax.Array) -> jax.Array:
        """Return values (n, ...) with zeros in entries beyond the number of active contacts."""
        here = jnp.arange(len(values)) < self.found.length
        return jnp.where(here.reshape(-1, *(1,) * (values.ndim - 1)), values, 0.0)

    def scan(self, step: Callable[[Any, Any], Any], carry: Any) -> Any:
        """Run carry = step(k, carry) over all n entries, by a loop with reverse-mode derivatives.
        Entries without a contact have no forces."""
        every = jnp.arange(self.rows.shape[0])
        return jax.lax.scan(lambda x, k: (step(k, x), None), carry, every)[0]


@dataclass(frozen=True)
class DiscSet(ContactSet):
    """Pairs of geoms with latched friction.

    Fields:
        memory: (n, width) of each candidate.
        step: h in s.
        share: the share of a bristle that a step removes.
        stiffness: impedance of the friction rows, below 1.
        bounded: field of `Disc`.
    """

    memory: Any
    step: Any
    share: Any
    stiffness: Any
    bounded: Any = False

    @classmethod
    def of(cls, given: ContactSet, memory: Any, step: Any, share: Any, stiffness: Any) -> DiscSet:
        """Return a set of contacts with bristles, from a set without.

        memory, step, share, stiffness: fields of `DiscSet`.
        """
        kept = {f.name: getattr(given, f.name) for f in fields(ContactSet)}
        return cls(**kept, memory=memory, step=step, share=share, stiffness=stiffness)

    @property
    def tables(self) -> tuple[Any, Any, Any]:
        """The parameters of the set: by pair, by candidate, and those that all contacts share."""
        by_pair, _, shared = super().tables
        return by_pair, self.memory, (shared, self.step, self.share, self.stiffness)

    def with_tables(self, tables: Sequence[Any]) -> DiscSet:
        """Return the set with other `tables`."""
        by_pair, memory, (options, step, share, stiffness) = tables
        given = super().with_tables((by_pair, (), options))
        return DiscSet.of(given, memory, step, share, stiffness)

    def cone(self, row: Any) -> Any:
        """Return the friction model of a contact."""
        mu = self._lanes(self.parameters.friction, row.pair)[: self.dim - 1]
        d, weight = self.stiffness, self._lane(self.weights, row.pair)
        return Disc(row.D, d / ((1.0 - d) * weight), tuple(mu), row.latch, self.bounded)

    def row_of(self, world: World, contact: Contact, pair: Any, candidate: Any, active: Any) -> Any:
        """Compute the rows of a contact. If it is not active, D is 0."""
        margin, (axes,) = self._lane(self.parameters.margin, pair), self.axes(world, contact, pair)
        e = contact_frame(contact.normal, contact.tangent)
        memory = self.memory[candidate]
        s = [x.dot(Vec3(*(memory[i] for i in range(1, 4)))) for x in e[1:]]
        if self.dim > 3:
            turn = Vec3(*(memory[i] for i in range(4, 7)))
            s += [x.dot(turn) for x in e][: self.dim - 3]
        row = Row(pair, axes, 0.0, [], contact, candidate, bristle=s)
        v = self.rates(row, world.twists)
        r = jnp.where(active, contact.distance - margin, 0.0)
        given = self.parameters
        solref, solimp = self._lanes(given.solref, pair), self._lanes(given.solimp, pair)
        d = impedance(r, solimp)
        push = reference(r, v[0], d, solref, solimp, self.step, refsafe=self.options.refsafe)
        h = self.step
        drag = [-(u + self.share * x / h) / h for u, x in zip(v[1:], s, strict=True)]
        D = 1.0 / regularisation(d, self._lane(self.weights, pair))
        return row._replace(D=jnp.where(active, D, 0.0), reference=[push, *drag])

    def collect(self, world: World, *, gap: bool = False) -> DiscSlots:
        """Run the narrow phase and store the active contacts, with the forces of the last step.

        gap: whether to include the contacts in the gap, which have no force.
        """
        n, m, dtype = self.candidates, width_of_rows(self.dim), world.geoms.dtype
        found = self.found(world, gap=gap)

        def compute(k: Any, carry: tuple) -> tuple:
            rows, bristles, latches = carry
            row: Any = self.row_of_found(world, found, k)
            values = pack([row.D, *row.reference, *row.axes.lanes], latches)
            bristle = pack(row.bristle, latches)
            latch = self.memory[row.candidate, NORMAL]
            return rows.at[k].set(values), bristles.at[k].set(bristle), latches.at[k].set(latch)

        none = tuple(jnp.zeros(x, dtype) for x in ((n, m), (n, self.dim - 1), (n,)))
        rows, bristles, latches = found.fold(compute, none)
        return DiscSlots(found, rows, bristles, latches)

    def next_memory(self, row: Any, r: Sequence[Lane], active: Any) -> jax.Array:
        """Compute the memory of a candidate after a step, from its residual at the solution.

        The velocity after the step is h r - share s / h, so a bristle that sticks becomes
        (1 - share) s + h^2 r.
        """
        cone, h = self.cone(row), self.step
        sticks, _, _ = cone.slip(r)
        kept = sticks & active
        s = [
            jnp.where(kept, (1.0 - self.share) * x + h * h * y, 0.0)
            for x, y in zip(row.bristle, r[1:], strict=True)
        ]
        e = contact_frame(row.contact.normal, row.contact.tangent)
        parts = [jnp.where(active, cone.normal(r[0]), 0.0), *(e[1] * s[0] + e[2] * s[1])]
        if self.dim > 3:
            turn = e[0] * s[2]
            if self.dim > 4:
                turn = turn + e[1] * s[3] + e[2] * s[4]
            parts += list(turn)
        return jnp.stack([jnp.asarray(x, self.memory.dtype) for x in parts])
