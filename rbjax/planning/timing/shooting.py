"""Minimum-time control by single shooting and the Sl1QP method (sequential linearised programs).

n intervals have constant controls u_k, a torque for each drive and a rate for each steering, and
durations h_k. States z = (coordinates, velocities) follow from the start by the classical
Runge-Kutta method, with a few steps per interval. The constraints are

    e   (end - goal), and the velocities at the end                = 0
    b   speeds and angles minus their limits, and the required    <= 0
        clearance minus the clearance of each disc

Their derivatives by all controls are products of the derivatives of the intervals. With T the final
time,

    min   T / T_0 + p (|e|_1 + |max(b, 0)|_1)        controls and durations in their ranges

Each iteration linearises e and b, and solves the program of the step in a trust region, which is a
box (`elastic_program`). A second-order correction by e at the new controls restores the end. The
step is accepted if the sum falls. The box grows or shrinks by the ratio of actual to predicted
decrease. The last iterations minimise only the constraint violation.

Source: Fletcher, *Practical Methods of Optimization*, 14.4; Nocedal & Wright, *Numerical
Optimization*, 18.3, 18.5; Betts, *Practical Methods for Optimal Control*, 3.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes import safe_sqrt
from rbjax.model import State
from rbjax.planning.maps.footprint import Footprint, disc_centers
from rbjax.planning.maps.occupancy import DistanceField
from rbjax.planning.timing import elastic_program
from rbjax.planning.timing.driven_path import rk4
from rbjax.planning.timing.limits import Limits
from rbjax.wheeled.kinematics.parameters import stack_lanes
from rbjax.wheeled.models.robot_model import RobotModel

PRICE = 3.0  # p
SHORTEST, LONGEST = 0.05, 4.0  # range of durations, relative to the initial one
INNER = 12  # iterations of a program
CORRECTIONS = 3  # second-order corrections of a step
PROXIMAL = 0.3
FIRST, LEAST = 0.3, 1e-6  # initial and smallest trust-region radius, relative to the ranges
LAST, SMALL = 6, 1e-5  # number of last iterations, which only reduce |e| + |b|, and its target


class Shooting(NamedTuple):
    """A motion as a function of w (n, nu + 1), the scaled controls and durations of intervals."""

    model: RobotModel  # the robot
    limits: Limits  # with a finite steering angle
    units: jax.Array  # (nu,), the largest controls, the units of w
    duration: jax.Array  # the unit of durations, s
    length: jax.Array  # the unit of distances, m
    reach: jax.Array  # the lever arm by which rad are converted to m, m
    speeds: jax.Array  # (nv,), the units of velocities
    start: jax.Array  # (nz,), the initial state
    goal: jax.Array  # (3,), the goal pose
    field: DistanceField | None  # None without a map
    footprint: Footprint | None
    due: jax.Array  # (n * parts, discs), the required clearances, m
    parts: int  # steps of an interval, static

    @property
    def tracked(self) -> int:
        """The number of coordinates that affect the motion: all but the angles of shafts."""
        return self.model.robot.layout.casters.stop

    def state(self, z: jax.Array) -> State:
        m = self.tracked
        return State(jnp.zeros(self.model.nq, z.dtype).at[:m].set(z[:m]), z[m:])

    def rates(self, z: jax.Array, u: jax.Array) -> jax.Array:
        context = self.model.context(self.state(z), u)
        q, v, _ = self.model.rates(context)
        return stack_lanes([*q[: self.tracked], *v], z.dtype)

    def over(self, z: jax.Array, w: jax.Array) -> jax.Array:
        """Integrate one interval from the state z with scaled controls w (nu + 1,). Return its
        states (parts, nz), of which the last is at the end of the interval."""
        u, h = w[:-1] * self.units, w[-1] * self.duration / self.parts

        def step(z, _):
            z = rk4(lambda z, c: self.rates(z, u), z, h)
            return z, z

        return jax.lax.scan(step, z, length=self.parts)[1]

    def states(self, w: jax.Array) -> jax.Array:
        """Integrate all intervals. Return the states (n, parts, nz)."""

        def interval(z, w):
            inside = self.over(z, w)
            return inside[-1], inside

        return jax.lax.scan(interval, self.start, w)[1]

    def equal(self, z: jax.Array) -> jax.Array:
        """Compute the end constraints e (3 + nv,) of the last state."""
        off = z[:3] - self.goal
        return jnp.concatenate(
            [off[:2] / self.length, off[2:3] * self.reach / self.length,
             z[self.tracked :] / self.speeds]
        )  # fmt: skip

    def below(self, z: jax.Array, due: jax.Array) -> jax.Array:
        """Compute the inequality constraints b of a state. due: (discs,) m, required clearances."""
        x, y, turn = self.twist(z)
        speed = safe_sqrt(x * x + y * y)
        both = jnp.append(z[self.model.robot.layout.steerings] / self.limits.steering,
                          turn / self.limits.turn_rate)  # fmt: skip
        rows = [(speed / self.limits.speed)[None] - 1, both - 1, -both - 1]
        if self.field is None:
            return jnp.concatenate(rows)
        return jnp.concatenate([*rows, (due - self.clearances(z)) / self.length])

    def twist(self, z: jax.Array) -> jax.Array:
        """Compute the twist (3,) of the chassis."""
        context = self.model.context(self.state(z))
        return stack_lanes(self.model.full_velocities(context)[:3], z.dtype)

    def clearances(self, z: jax.Array) -> jax.Array:
        """Compute the clearance of each disc, m."""
        assert self.field is not None and self.footprint is not None
        return self.field.at(disc_centers(z[:3], self.footprint)) - self.footprint.radii

    def rows(self, w: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Evaluate the end constraints e (3 + nv,) and the path constraints b (rows,)."""
        z = self.states(w)
        flat = z.reshape(-1, z.shape[-1])
        return self.equal(flat[-1]), jax.vmap(self.below)(flat, self.due).ravel()

    def linear(self, w: jax.Array) -> tuple[tuple[jax.Array, jax.Array], ...]:
        """Evaluate end constraints e, path constraints b and derivatives: (e, de/dw), (b, db/dw).

        w is flattened.
        """
        z = self.states(w)
        n, parts, nz = z.shape
        before = jnp.concatenate([self.start[None], z[:-1, -1]])
        A, B = jax.vmap(jax.jacfwd(self.over, (0, 1)))(before, w)  # (n, parts, nz, ...)
        mine = jnp.eye(n, dtype=w.dtype)

        def chain(S, AB):
            A, B, e = AB
            # S (nz, n, nu + 1): states by all controls, to which this interval's are added
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


class ShootingIterate(NamedTuple):
    """Iterate of the optimisation."""

    w: jax.Array  # (n, nu + 1), the scaled controls
    radius: jax.Array  # (), of the trust region
    iterations_done: jax.Array  # the number of iterations
    taken: jax.Array  # the number of accepted steps


def optimise(s: Shooting, w: jax.Array, iterations: int) -> ShootingIterate:
    """Minimise the penalty function from initial controls w (n, nu + 1)."""
    n = len(w)
    one = jnp.ones_like(w)
    lowest = (-one).at[:, -1].set(SHORTEST)
    highest = one.at[:, -1].set(LONGEST)
    H = PROXIMAL / n * jnp.eye(w.size, dtype=w.dtype)
    by_time = jnp.zeros_like(w).at[:, -1].set(1 / n)

    def penalty(equal, below):
        return PRICE * (jnp.abs(equal).sum() + jnp.maximum(below, 0.0).sum())

    def iteration(now: ShootingIterate) -> ShootingIterate:
        w, first = now.w, now.iterations_done < iterations
        cost = first * by_time
        (e, E), (b, B) = s.linear(w)
        low = jnp.maximum(lowest - w, -now.radius).ravel()
        high = jnp.minimum(highest - w, now.radius).ravel()
        G, g = jnp.concatenate([E, -E, B]), jnp.concatenate([-e, e, -b])
        d, _ = elastic_program.solve(
            H, cost.ravel(), G, g, jnp.full_like(g, PRICE), low, high, INNER
        )
        merit = (cost * w).sum() + penalty(e, b)
        end = e + E @ d
        foreseen = (cost.ravel() * (w.ravel() + d)).sum() + penalty(end, b + B @ d)
        W = E * jnp.minimum(d - low, high - d)
        S = W @ E.T
        S = S + jnp.eye(len(e), dtype=w.dtype) * (1e-12 * jnp.trace(S) + jnp.finfo(w.dtype).tiny)

        def corrected(d, _):
            """Evaluate the constraints after a step d. Return the step with a second-order
            correction of the end, the uncorrected w, and its merit."""
            new = jnp.clip(w + d.reshape(w.shape), lowest, highest)
            equal, below = s.rows(new)
            value = (cost * new).sum() + penalty(equal, below)
            after = jnp.clip(d - W.T @ jnp.linalg.solve(S, equal - end), low, high)
            return after, (new, value)

        _, (steps, merits) = jax.lax.scan(corrected, d, length=CORRECTIONS)
        k = jnp.nanargmin(merits)
        share = (merit - merits[k]) / jnp.maximum(merit - foreseen, jnp.finfo(w.dtype).tiny)
        good = (merits[k] < merit) & (first | (merit > SMALL))
        radius = jnp.where(share > 0.75, 2 * now.radius, now.radius)
        radius = jnp.where(good & (share > 0.25), radius, now.radius / 3)
        radius = jnp.minimum(radius, 1.0)
        iterations_done = jnp.where(first & (radius < LEAST), iterations, now.iterations_done + 1)
        radius = jnp.where(iterations_done == iterations, FIRST, radius)
        return ShootingIterate(
            jnp.where(good, steps[k], w), radius, iterations_done, now.taken + good
        )

    def goes_on(now: ShootingIterate):
        return (now.iterations_done < iterations + LAST) & (now.radius > LEAST)

    zero = jnp.zeros((), int)
    w = jnp.clip(w, lowest, highest)
    begin = ShootingIterate(w, jnp.full((), FIRST, w.dtype), zero, zero)
    return jax.lax.while_loop(goes_on, iteration, begin)
