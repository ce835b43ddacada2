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

from rbjax.dynamics.algorithms.aba import velocity_step
from rbjax.dynamics.algorithms.kinematics import link_motions
from rbjax.dynamics.algorithms.link_forces import over_links
from rbjax.dynamics.drivers.choice import Driver
from rbjax.dynamics.drivers.joint_lanes import axes
from rbjax.lanes import Lane, Mat3, Vec3, fusion_barrier
from rbjax.model import WORLD
from rbjax.spatial import Force, Motion, Transform


class LinkMotion:
    """Poses in the world, twists and accelerations of the links of a robot at (q, v, a); v None is
    at rest, a None is zero."""

    def __init__(
        self, d: Driver, q: jax.Array, v: jax.Array | None, a: jax.Array | None = None
    ):
        self.driver, self._q, self._v, self._a = d, q, v, a
        self._poses = {WORLD: Transform(Mat3.identity(), Vec3.zero())}
        self._twists = {WORLD: Motion.zero()}
        self._accelerations = {WORLD: Motion.zero()}

    def accelerating(self, a: jax.Array) -> LinkMotion:
        """The same motion, with the accelerations a (nv,)."""
        out = copy.copy(self)
        out._a, out._accelerations = a, {WORLD: Motion.zero()}
        out.__dict__.pop("_acceleration_columns", None)
        return out

    def pose(self, link: int) -> Transform:
        """The pose of the link in the world."""
        if not self.driver.listed:
            return self._poses[link] if link == WORLD else _row(self._columns[0], link)
        for i in self._missing(link, self._poses):
            parent = self._poses[self.driver.topology.links[i].parent]
            joint, constants = self._links[i]
            pose = parent.then(joint.transform(constants))
            self._poses[i] = fusion_barrier(pose, known=(parent, joint, constants))
        return self._poses[link]

    def twist(self, link: int) -> Motion:
        """The twist of the link in its own axes, at its origin."""
        if not self.driver.listed:
            return self._twists[link] if link == WORLD else _row(self._columns[1], link)
        for i in self._missing(link, self._twists):
            parent = self._twists[self.driver.topology.links[i].parent]
            joint, constants = self._links[i]
            twist = joint.transform(constants)(parent) + joint.twist
            self._twists[i] = fusion_barrier(twist, known=(parent, joint, constants))
        return self._twists[link]

    def acceleration(self, link: int) -> Motion:
        """The angular acceleration of the link and the classical acceleration of its origin, in its
        own axes; gravity has no part in it."""
        if not self.driver.listed:
            still = self._accelerations
            return still[link] if link == WORLD else _row(self._acceleration_columns, link)
        for i in self._missing(link, self._accelerations):
            parent = self.driver.topology.links[i].parent
            joint, constants = self._links[i]
            _, step = velocity_step((constants, joint), self.twist(parent).ang)
            found = step.X(self._accelerations[parent]) + step.c
            if self._a is not None:
                found = found + joint.S * self._a[i]
            known = (self._accelerations[parent], joint, constants)
            self._accelerations[i] = fusion_barrier(found, known=known)
        return self._accelerations[link]

    def to_parent(self, link: int) -> tuple[Transform, Motion]:
        """The pose of a link in its parent, and the axis of its joint."""
        joint, constants = self._links[link]
        return joint.transform(constants), joint.S

    def axis(self, link: int) -> Motion:
        """The axis S of a link in its own axes, where links are columns."""
        if self.driver.topology.straight:
            kind = self.driver.topology.links[link].kind
            return kind.axis(self.driver.prepared.link(link).numbers)
        return _row(self._axes, link)

    def weld(self, body: int) -> Transform:
        """The pose of a body in the link that carries it."""
        return self.driver.prepared.weld(body)

    def columns(self, bodies: np.ndarray) -> tuple[Transform, Motion, Transform]:
        """For bodies that can move, as columns over them: the pose and the twist of the links that
        carry them, and their poses in these links."""
        links = np.array(self.driver.topology.body_links)[bodies]
        pose, twist = (_row(x, links) for x in self._columns)
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

    def _missing(self, link: int, found: dict) -> list[int]:
        path = () if link == WORLD else self.driver.topology.ancestors[link]
        return [i for i in path if i not in found]

    @cached_property
    def joints(self) -> Any:
        """The joint motion of each link, per link."""
        return self.driver.joints(self._q, self._v)

    @cached_property
    def _links(self) -> list:
        d = self.driver
        return list(zip(d.whole(self.joints), d.whole(d.constants), strict=True))

    @cached_property
    def _columns(self) -> tuple[Any, Any]:
        d, like = self.driver, jnp.zeros(self.driver.topology.nv, self._q.dtype)
        poses, twists = d.unzip(link_motions(d, self.joints), 2)
        return d.columns(poses, like), d.columns(twists, like)

    @cached_property
    def _acceleration_columns(self) -> Any:
        d, like = self.driver, jnp.zeros(self.driver.topology.nv, self._q.dtype)

        def step(x, parent):
            link, joint, qdd = x
            w, moved = velocity_step((link, joint), parent[0])
            a = moved.X(parent[1]) + moved.c + joint.S * qdd
            return (w, a), a

        given = d.zip(d.constants, self.joints, d.lanes(self._a))
        return d.columns(d.outward(step, (Vec3.zero(), Motion.zero()), given), like)

    @cached_property
    def _axes(self) -> Any:
        d, like = self.driver, jnp.zeros(self.driver.topology.nv, self._q.dtype)
        return d.columns(axes(d, self.joints)[0], like)


def _row(columns: Any, i: Any) -> Any:
    return jax.tree.map(lambda x: x[i], columns)
