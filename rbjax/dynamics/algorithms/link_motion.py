"""Poses and twists of single links, each computed on first use.

For force elements that need a few links: a spring between two points, an actuator at a site. The
recursions are those of `kinematics`, along the links from the base to the requested one.
`columns` and `scattered` are for elements that need many bodies at once.
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.algorithms.kinematics import (
    ACCELERATION,
    POSE,
    TWIST,
    Hop,
    Quantity,
    sweep,
)
from rbjax.dynamics.algorithms.link_forces import over_links
from rbjax.dynamics.drivers.choice import Driver
from rbjax.lanes import Lane, fusion_barrier
from rbjax.model import WORLD
from rbjax.spatial import Force, Motion, Transform


class LinkMotion:
    """Poses in the world, twists and accelerations of the links of a robot at (q, v, a); v None is
    at rest, a None is zero."""

    def __init__(self, d: Driver, q: jax.Array, v: jax.Array | None, a: jax.Array | None = None):
        self.driver, self._q, self._v, self._a = d, q, v, a
        #: quantity -> its value of each link that was asked for, or its columns
        self._found: dict[Quantity, Any] = {}

    def accelerating(self, a: jax.Array) -> LinkMotion:
        """The same motion, with the accelerations a (nv,)."""
        out = copy.copy(self)
        out._a, out._found = a, {k: x for k, x in self._found.items() if k is not ACCELERATION}
        return out

    def pose(self, link: int) -> Transform:
        """The pose of the link in the world."""
        return self._of(POSE, link)

    def twist(self, link: int) -> Motion:
        """The twist of the link in its own axes, at its origin."""
        return self._of(TWIST, link)

    def acceleration(self, link: int) -> Motion:
        """The angular acceleration of the link and the classical acceleration of its origin, in its
        own axes; gravity has no part in it."""
        return self._of(ACCELERATION, link)[1]

    def _of(self, quantity: Quantity, link: int) -> Any:
        """A quantity of a link: the recursion along the links from the base to it."""
        if link == WORLD:
            return quantity.root
        if not self.driver.listed:
            return _row(self._columns(quantity), link)
        found = self._found.setdefault(quantity, {WORLD: quantity.root})
        for i in self.driver.topology.ancestors[link]:
            if i in found:
                continue
            parent = found[self.driver.topology.dofs[i].parent]
            joint, constants = self._links[i]
            hop = Hop(joint.transform(constants), joint)
            if quantity is ACCELERATION and self._a is not None:
                hop = hop._replace(qdd=self._a[i])
            known = (parent, joint, constants)
            found[i] = fusion_barrier(quantity.step(hop, parent), known=known)
        return found[link]

    def to_parent(self, link: int) -> tuple[Transform, Motion]:
        """The pose of a link in its parent, and the axis of its joint."""
        joint, constants = self._links[link]
        return joint.transform(constants), joint.S

    def axis(self, link: int) -> Motion:
        """The axis S of a link in its own axes, where links are columns."""
        if self.driver.topology.constant_axes:
            kind = self.driver.topology.dofs[link].kind
            return kind.axis(self.driver.prepared.link(link).params)
        return _row(self._axes, link)

    def weld(self, body: int) -> Transform:
        """The pose of a body in the link that carries it."""
        return self.driver.prepared.weld(body)

    def columns(self, bodies: np.ndarray) -> tuple[Transform, Motion, Transform]:
        """For bodies that can move, as columns over them: the pose and the twist of the links that
        carry them, and their poses in these links."""
        links = np.array(self.driver.topology.body_links)[bodies]
        pose, twist = (_row(self._columns(x), links) for x in (POSE, TWIST))
        welds = self.driver.prepared.welds
        return pose, twist, jax.tree.map(lambda column: self.column(column, bodies), welds)

    def column(self, column: Any, rows: np.ndarray) -> Lane:
        """These rows of a column; a literal if they are known and agree."""
        if not isinstance(column, np.ndarray):
            return column[rows]
        found = np.asarray(column[rows], np.float64)
        alike = bool((found == found[0]).all())
        return float(found[0]) if alike else jnp.asarray(found, self._q.dtype)

    def scattered(self, bodies: np.ndarray, forces: Force) -> Force:
        """Forces on the links that carry these bodies, as columns over all links."""
        links = np.array(self.driver.topology.body_links)[bodies]
        return over_links(self.driver, links, forces, self._q.dtype)

    @cached_property
    def joints(self) -> Any:
        """The joint motion of each link, per link."""
        return self.driver.joints(self._q, self._v)

    @cached_property
    def _links(self) -> list:
        d = self.driver
        return list(zip(d.whole(self.joints), d.whole(d.constants), strict=True))

    def _columns(self, quantity: Quantity) -> Any:
        """A quantity of all links, as columns. Pose and twist share one sweep."""
        if quantity not in self._found:
            d, like = self.driver, jnp.zeros(self.driver.topology.nv, self._q.dtype)
            some = (ACCELERATION,) if quantity is ACCELERATION else (POSE, TWIST)
            a = d.lanes(self._a) if quantity is ACCELERATION else None
            for one, values in zip(some, sweep(d, self.joints, *some, a=a), strict=True):
                self._found[one] = d.columns(values, like)
        return self._found[quantity]

    @cached_property
    def _axes(self) -> Any:
        d, like = self.driver, jnp.zeros(self.driver.topology.nv, self._q.dtype)
        return d.columns(d.axes(self.joints)[0], like)


def _row(columns: Any, i: Any) -> Any:
    return jax.tree.map(lambda x: x[i], columns)
