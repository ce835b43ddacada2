"""A motion by its controls, and how all that it must satisfy changes with them.

n intervals have constant controls u_k, a torque for each drive and a rate for each steering, and
durations h_k. States z = (coordinates, velocities) follow from the start by the classical
Runge-Kutta method, a few steps an interval, so every motion here is one that the robot makes. What
a motion must satisfy is a row of numbers,

    equal   (end - goal) and the velocities at the end             = 0
    below   speeds and angles against their limits, and the        <= 0
            clearance that is due minus the clearance of each disc

whose derivatives by all controls are products of those of the intervals.

Source: Bock & Plitt, *A multiple shooting algorithm for direct solution of optimal control
problems*, IFAC 1984 (with one shot here); Betts, *Practical Methods for Optimal Control*, 3.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.model import State
from rbjax.planning.maps.footprint import Footprint, placed
from rbjax.planning.maps.occupancy import DistanceField
from rbjax.planning.timing.driven_path import rk4
from rbjax.planning.timing.limits import Limits
from rbjax.wheeled.kinematics.parameters import stack_lanes
from rbjax.wheeled.models.robot_model import RobotModel


class Shooting(NamedTuple):
    """Fields: vehicle; limits, of finite steering; units (nu,), the largest controls; duration (),
    the unit of durations, s; length () m, reach () m, which makes m of rad, and speeds (nv,), units
    of deviations; start (nz,); goal (3,); field and footprint, or None; due (n parts, discs) m,
    clearances; none without a map. Static: parts, the steps of an interval.

    Unknown is w (n, nu + 1): controls and a duration, in these units.
    """

    vehicle: RobotModel
    limits: Limits
    units: jax.Array
    duration: jax.Array
    length: jax.Array
    reach: jax.Array
    speeds: jax.Array
    start: jax.Array
    goal: jax.Array
    field: DistanceField | None
    footprint: Footprint | None
    due: jax.Array
    parts: int

    @property
    def tracked(self) -> int:
        """How many coordinates matter; those of shafts act on nothing."""
        return self.vehicle.robot.layout.casters.stop

    def state(self, z: jax.Array) -> State:
        m = self.tracked
        return State(jnp.zeros(self.vehicle.nq, z.dtype).at[:m].set(z[:m]), z[m:])

    def rates(self, z: jax.Array, u: jax.Array) -> jax.Array:
        now = self.vehicle.context(self.state(z), u)
        q, v, _ = self.vehicle.rates(now)
        return stack_lanes([*q[: self.tracked], *v], z.dtype)

    def over(self, z: jax.Array, w: jax.Array) -> jax.Array:
        """The states (parts, nz) in an interval, the last at its end."""
        u, h = w[:-1] * self.units, w[-1] * self.duration / self.parts

        def step(z, _):
            z = rk4(lambda z, c: self.rates(z, u), z, h)
            return z, z

        return jax.lax.scan(step, z, length=self.parts)[1]

    def states(self, w: jax.Array) -> jax.Array:
        """(n, parts, nz)."""

        def interval(z, w):
            inside = self.over(z, w)
            return inside[-1], inside

        return jax.lax.scan(interval, self.start, w)[1]

    def equal(self, z: jax.Array) -> jax.Array:
        """What vanishes at the end (3 + nv,)."""
        off = z[:3] - self.goal
        return jnp.concatenate(
            [off[:2] / self.length, off[2:3] * self.reach / self.length,
             z[self.tracked :] / self.speeds]
        )  # fmt: skip

    def below(self, z: jax.Array, due: jax.Array) -> jax.Array:
        """What is at most zero in a state."""
        x, y, turn = self.twist(z)
        square = x * x + y * y
        speed = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        both = jnp.append(z[self.vehicle.robot.layout.steerings] / self.limits.steering,
                          turn / self.limits.turn_rate)  # fmt: skip
        rows = [(speed / self.limits.speed)[None] - 1, both - 1, -both - 1]
        if self.field is None:
            return jnp.concatenate(rows)
        return jnp.concatenate([*rows, (due - self.clearances(z)) / self.length])

    def twist(self, z: jax.Array) -> jax.Array:
        """Of the chassis (3,)."""
        now = self.vehicle.context(self.state(z))
        return stack_lanes(self.vehicle.full_velocities(now)[:3], z.dtype)

    def clearances(self, z: jax.Array) -> jax.Array:
        """Of each disc, m."""
        assert self.field is not None and self.footprint is not None
        return self.field.at(placed(z[:3], self.footprint)) - self.footprint.radii

    def rows(self, w: jax.Array) -> tuple[jax.Array, jax.Array]:
        """What is zero, and what is at most zero: (3 + nv,) and (rows,)."""
        z = self.states(w)
        flat = z.reshape(-1, z.shape[-1])
        return self.equal(flat[-1]), jax.vmap(self.below)(flat, self.due).ravel()

    def linear(self, w: jax.Array) -> tuple[tuple[jax.Array, jax.Array], ...]:
        """`rows` with their derivatives: (equal, by w), (below, by w), w as a row."""
        z = self.states(w)
        n, parts, nz = z.shape
        before = jnp.concatenate([self.start[None], z[:-1, -1]])
        A, B = jax.vmap(jax.jacfwd(self.over, (0, 1)))(before, w)  # (n, parts, nz, ...)
        mine = jnp.eye(n, dtype=w.dtype)

        def chain(S, AB):
            A, B, e = AB
            # S (nz, n, nu + 1): this interval's own controls act from here on
            inside = jnp.einsum("pij,jkc->pikc", A, S) + B[:, :, None, :] * e[:, None]
            return inside[-1], inside

        _, S = jax.lax.scan(chain, jnp.zeros((nz, *w.shape), w.dtype), (A, B, mine))
        S = S.reshape(n * parts, nz, -1)
        flat = z.reshape(-1, nz)
        end, by_end = self.equal(flat[-1]), jax.jacfwd(self.equal)(flat[-1])
        low, by_z = (
            jax.vmap(self.below)(flat, self.due),
            jax.vmap(jax.jacfwd(self.below))(flat, self.due),
        )
        G = jnp.einsum("krz,kzw->krw", by_z, S)
        return (end, by_end @ S[-1]), (low.ravel(), G.reshape(-1, G.shape[-1]))
