"""Sensors of a subtree of bodies and of the whole robot.

    subtreecom      C = sum of m c / M             subtreelinvel   V = sum of m c' / M
    subtreeangmom   sum of R I R^T w + (c - C) x m (c' - V)
    e_potential     -sum of m g.c + energy of springs,      e_kinetic   v^T M v / 2
(MuJoCo, *XML reference*, sensor.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics import kinetic_energy, potential_energy
from rbjax.forces.acting import elastic_energy
from rbjax.forces.context import Context
from rbjax.lanes import Lane, Mat3, Vec3, add, is_zero, total
from rbjax.model import WORLD, Frame, Model
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.sensors.fixed import AXES, FixedSensor, reading
from rbjax.sensors.protocol import register

_LEAST = 1e-15  # kg; MuJoCo's least mass of a subtree, below which its center is the body's


class Centers(NamedTuple):
    """The parts of a subtree: its bodies, then the inertias of its flexible links.

    Fields:
        masses: kg.
        positions, velocities: of the centers of mass, in the world.
        spins: angular momenta about the centers of mass in world axes.
    """

    masses: list[Lane]
    positions: list[Vec3]
    velocities: list[Vec3]
    spins: list[Vec3]


class SubtreeSensor(FixedSensor):
    """Base class of a sensor of a body and all bodies that it carries.

    A flexible link, such as a beam, belongs to the body that it moves.

    body: name or index of the body; "world" for the whole robot; static.
    """

    labels = AXES
    body: Any = eqx.field(static=True)

    def check(self, model: Model) -> None:
        self._root(model)

    def _root(self, model: Model) -> int:
        fixed = self.body == "world" and self.body not in model.body_names
        return WORLD if fixed or self.body == WORLD else model.body(self.body)

    def bodies(self, model: Model) -> list[int]:
        """Return the bodies of the subtree."""
        root, inside = self._root(model), set()
        for b, parent in enumerate(model.topology.body_parents):  # parents precede children
            if root in (WORLD, b) or parent in inside:
                inside.add(b)
        return sorted(inside)

    def centers(self, context: Context) -> Centers:
        """Return masses, positions and velocities of the centers of mass, and spins."""
        masses = table(context.model.bodies.mass, context.q.dtype)
        J = table(context.model.bodies.inertia, context.q.dtype)
        inside = self.bodies(context.model)
        frames = [context.frame(Frame(center=b)) for b in inside]

        def spin(b: int) -> Vec3:
            frame = context.body(b)
            inertia = Mat3(*(lane(J[:, i, j], b) for i in range(3) for j in range(3)))
            return frame.rotation @ (inertia @ frame.twist.ang)

        out = Centers(
            [lane(masses, b) for b in inside],
            [x.position for x in frames],
            [x.velocity for x in frames],
            [spin(b) for b in inside],
        )
        top = context.model.topology
        for i, link in enumerate(top.links if top.frames else ()):
            if link.body in inside:
                self._add_link(context, i, out)
        return out

    def _add_link(self, context: Context, link: int, out: Centers) -> None:
        """Append the inertia of the joint of a link, if it has a mass."""
        pose = context.links.pose(link)
        own, momentum = context.links.to_parent(link)[1].own_momentum(context.links.twist(link))
        if is_zero(own.m):
            return
        center = own.h * (1 / own.m)
        out.masses.append(own.m)
        out.positions.append(pose.p + pose.R @ center)
        out.velocities.append(pose.R @ (momentum.lin * (1 / own.m)))
        out.spins.append(pose.R @ (momentum.ang - center.cross(momentum.lin)))

    def mean(self, context: Context, masses: list[Lane], vectors: list[Vec3]) -> Vec3:
        """Return the mean of vectors weighted by mass; the vector of the first body if the subtree
        has no mass."""
        if not vectors:
            return Vec3.zero()
        mass = jnp.asarray(total(masses), context.q.dtype)
        some = mass > _LEAST
        share = jnp.where(some, 1 / jnp.where(some, mass, 1.0), 0.0)
        summed = Vec3.zero()
        for m, x in zip(masses, vectors, strict=True):
            summed = summed + x * m
        own = jnp.where(some, 0.0, 1.0)
        return summed * share + vectors[0] * own


@register("subtreecom", placed=True)
class SubtreeCenter(SubtreeSensor):
    """Measure the center of mass (3,) of a body and all bodies that it carries, in the world."""

    of = "m"

    def __call__(self, context: Context) -> jax.Array:
        own = self.centers(context)
        return reading(context, self.mean(context, own.masses, own.positions))


@register("subtreelinvel", placed=True)
class SubtreeVelocity(SubtreeSensor):
    """Measure the velocity (3,) of the center of mass of a subtree in world axes."""

    of = "m/s"

    def __call__(self, context: Context) -> jax.Array:
        own = self.centers(context)
        return reading(context, self.mean(context, own.masses, own.velocities))


@register("subtreeangmom", placed=True)
class SubtreeAngularMomentum(SubtreeSensor):
    """Measure the angular momentum (3,) of a subtree about its center of mass in world axes."""

    of = "kg m^2/s"

    def __call__(self, context: Context) -> jax.Array:
        own = self.centers(context)
        center = self.mean(context, own.masses, own.positions)
        velocity = self.mean(context, own.masses, own.velocities)
        out = Vec3.zero()
        for m, c, v, spin in zip(*own, strict=True):
            out = out + spin + (c - center).cross((v - velocity) * m)
        return reading(context, out)


@register("e_potential")
class PotentialEnergy(FixedSensor):
    """Measure the potential energy of gravity and of all springs, J."""

    of = "J"

    def __call__(self, context: Context) -> jax.Array:
        model, q = context.model, context.q
        return reading(context, [add(potential_energy(model, q), elastic_energy(model, q))])


@register("e_kinetic")
class KineticEnergy(FixedSensor):
    """Measure the kinetic energy, J."""

    of = "J"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, [kinetic_energy(context.model, context.q, context.v)])


@register("clock")
class Clock(FixedSensor):
    """Measure the time, s."""

    of = "s"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, [context.t])
