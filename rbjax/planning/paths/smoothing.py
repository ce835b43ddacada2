"""Gradient-based smoothing of a path: shorter, with less curvature, further from obstacles.

The unknowns are the lengths l_i and the curvatures k_i of the arcs. r is the turning radius, m the
margin, and d_ij the clearance of disc j after arc i:

    min   1/2 sum l_i^2 / (r e_i)  +  1/2 sum (k_i+1 - k_i)^2 r^3 w / e_i
          +  1/2 sum max(1 - d_ij / m, 0)^2 c e_i / r
    with  the end at the goal,   |k_i| <= 1 / r,   e_i / 4 <= |l_i| <= 4 e_i

e_i is the initial length of an arc. Differences of curvature count only within a gear, since a
standing car can steer at no cost. Gears do not change, nor do steps that are not arcs (turning on
the spot, sliding). Poses are integrated exactly from the start, so each iterate is a path that a
robot can drive.

The method is Gauss-Newton with Levenberg-Marquardt damping and the linearised end as an equality.
Variables at active bounds are fixed in a step. Then Newton's method restores the end. A step is
accepted only if the cost falls, the end is met, the bounds hold, and the whole path is clear of
obstacles. So every iterate is feasible, and the worst result is the initial path.

Source: Nocedal & Wright, *Numerical Optimization*, 10.3 and 18.3; Dolgov et al., IJRR 29 (2010)
485, section 3, for the terms.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import instance, integer, real_number
from rbjax.compiling import alone, compiled, wide_vectors
from rbjax.errors import InputError
from rbjax.model.record import Record
from rbjax.planning.maps.footprint import Footprint, check_map, disc_centers
from rbjax.planning.maps.occupancy import DistanceField
from rbjax.planning.paths.path import Path, chain, clear_along

BENDING, CLEARANCE = 0.2, 10.0  # w and c
RESTORING = 3  # Newton steps to the goal
FACTOR = 4.0  # the largest change of a length


class SmoothedPath(Record):
    """A smoothed path. Leading axes are a batch.

    Fields:
        path: the `Path`.
        steps_taken: (...), the number of accepted steps; 0 if the path is unchanged.
        cost: (..., 2), the cost before and after.
    """

    path: Path
    steps_taken: jax.Array
    cost: jax.Array

    @property
    def status(self) -> str:
        """Status of one path: "smoothed", or "as it was" if no step was accepted."""
        return "smoothed" if int(self.steps_taken) else "as it was"


class _Problem(NamedTuple):
    """The smoothing problem of one path."""

    path: Path  # the initial path
    field: DistanceField
    footprint: Footprint
    radius: jax.Array  # the smallest turning radius, m
    margin: jax.Array  # the desired clearance, m
    arcs: jax.Array  # (n,), whether a step is an arc
    unit: jax.Array  # (n,), initial lengths of the arcs, m
    same: jax.Array  # (n - 1,), whether two neighbouring steps are arcs in one gear
    goal: jax.Array  # (3,), the end of the initial path

    def steps(self, z: jax.Array) -> jax.Array:
        """Compute the steps (n, 3) of an iterate.

        z: (2, n), lengths in units of the initial ones, and curvatures in units of 1 / radius.
        """
        length = jnp.where(self.path.steps[:, 0] < 0, -1.0, 1.0) * z[0] * self.unit
        arcs = jnp.stack([length, jnp.zeros_like(length), z[1] / self.radius * length], -1)
        return jnp.where(self.arcs[:, None], arcs, self.path.steps)

    def residuals(self, z: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Compute the residuals of the cost, and the deviation (3,) of the end from the goal, m."""
        poses = chain(self.path.start, self.steps(z))
        share = jnp.sqrt(self.unit / self.radius)  # zero for padding
        jump = jnp.where(self.same, z[1, 1:] - z[1, :-1], 0.0)
        pace = jnp.where(self.same, self.unit[1:] + self.unit[:-1], 1.0) / 2
        jump = jump * jnp.sqrt(BENDING * self.radius / pace)
        away = self.field.at(disc_centers(poses[1:], self.footprint)) - self.footprint.radii
        short = jnp.maximum(1 - away / self.margin, 0.0)
        short = jnp.where(self.arcs[:, None], math.sqrt(CLEARANCE) * share[:, None] * short, 0.0)
        length = jnp.where(self.arcs, share * z[0], 0.0)
        off = (poses[-1] - self.goal) * jnp.stack([1.0, 1.0, self.radius])
        return jnp.concatenate([length, jump, short.ravel()]), off

    def cost(self, z: jax.Array) -> jax.Array:
        return 0.5 * (self.residuals(z)[0] ** 2).sum()

    def limits(self, z: jax.Array) -> tuple[jax.Array, jax.Array]:
        one = jnp.ones_like(z[0])
        return jnp.stack([one / FACTOR, -one]), jnp.stack([one * FACTOR, one])

    def is_free(self, z: jax.Array, parts: int) -> jax.Array:
        path = Path(self.path.start, self.steps(z))
        return clear_along(self.field, path, self.footprint, parts)


def _step(p: _Problem, z: jax.Array, damping: jax.Array) -> jax.Array:
    """Compute the next iterate: a damped step with the linearised end, clipped to the bounds."""
    (r, off), (J, A) = p.residuals(z), jax.jacfwd(p.residuals)(z)
    J, A = J.reshape(len(r), -1), A.reshape(3, -1)
    low, high = (x.ravel() for x in p.limits(z))
    x, g = z.ravel(), r @ J
    held = ((x <= low) & (g > 0)) | ((x >= high) & (g < 0)) | ~jnp.tile(p.arcs, 2)
    free = 1.0 - held.astype(x.dtype)
    H = free[:, None] * (J.T @ J) * free + jnp.diag(damping * free + (1 - free))
    # the multipliers of the end; the last term keeps the matrix regular if nothing moves the end
    A = A * free
    solved = jnp.linalg.solve(H, jnp.concatenate([A, (free * g)[None]]).T)
    S = A @ solved[:, :3]
    S = S + jnp.eye(3, dtype=x.dtype) * (1e-12 * jnp.trace(S) + jnp.finfo(x.dtype).tiny)
    multipliers = jnp.linalg.solve(S, off - A @ solved[:, 3])
    x = jnp.clip(x - solved[:, 3] - solved[:, :3] @ multipliers, low, high)
    return _restored(p, x.reshape(z.shape), low, high)


def _restored(p: _Problem, z: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Project an iterate z onto the paths that end at the goal, with z within [low, high]."""

    def end(x):
        return p.residuals(x.reshape(z.shape))[1]

    x = z.ravel()
    for _ in range(RESTORING):
        off, A = end(x), jax.jacfwd(end)(x)
        room = jnp.tile(p.arcs, 2) * jnp.minimum(jnp.minimum(x - low, high - x), 1.0)
        W = A * room
        S = W @ A.T
        S = S + jnp.eye(3, dtype=x.dtype) * (1e-12 * jnp.trace(S) + jnp.finfo(x.dtype).tiny)
        x = x - W.T @ jnp.linalg.solve(S, off)
    return x.reshape(z.shape)


def _smooth(
    path: Path, field: DistanceField, footprint: Footprint, radius: jax.Array, margin: jax.Array,
    iterations: int, parts: int,
) -> SmoothedPath:  # fmt: skip
    a, b, turn = (path.steps[:, i] for i in range(3))
    arcs = (a != 0) & (b == 0)
    unit = jnp.where(arcs, jnp.abs(a), 0.0)
    bend = jnp.where(arcs, turn / jnp.where(arcs, a, 1.0), 0.0) * radius
    goal = chain(path.start, path.steps)[-1]
    same = arcs[1:] & arcs[:-1] & (a[1:] * a[:-1] > 0)
    p = _Problem(path, field, footprint, radius, margin, arcs, unit, same, goal)
    z = jnp.stack([jnp.ones_like(bend), jnp.clip(bend, -1.0, 1.0)])
    # the rounding of as many additions as there are steps
    close = 64 * jnp.finfo(z.dtype).eps * (path.length + radius + jnp.abs(path.start).max())
    gain = max(1e-6, 64 * float(jnp.finfo(z.dtype).eps))  # more than rounding
    first = p.cost(z)

    def iteration(carry, _):
        z, cost, damping, taken = carry
        new = _step(p, z, damping)
        low, high = p.limits(z)
        value, off = p.cost(new), p.residuals(new)[1]
        good = (value < cost * (1 - gain)) & (jnp.abs(off).max() <= close)
        good &= ((new >= low) & (new <= high) | ~arcs).all() & p.is_free(new, parts)
        z = jnp.where(good, new, z)
        damping = jnp.clip(jnp.where(good, damping / 4, damping * 4), 1e-6, 1e6)
        return (z, jnp.where(good, value, cost), damping, taken + good), None

    begin = z, first, jnp.full_like(first, 0.1), jnp.zeros((), int)
    (z, cost, _, taken), _ = jax.lax.scan(iteration, begin, length=iterations)
    steps = jnp.where(taken > 0, p.steps(z), path.steps)
    return SmoothedPath(Path(path.start, steps), taken, jnp.stack([first, cost]))


_program = compiled(_smooth, options=wide_vectors, static_argnames=("iterations", "parts"))


def smooth(
    path: Path,
    field: DistanceField,
    footprint: Footprint,
    radius: Any,
    margin: Any = None,
    iterations: int = 30,
    parts: int = 4,
) -> SmoothedPath:
    """Smooth a path with fixed ends and gears: shorter, with less curvature, further from
    obstacles.

    Use it after a search. `plan` calls it for a car.

    Args:
        path: one `Path` in steps that are short compared with obstacles, as from `Path.split`. The
            number of steps does not change. Use `jax.vmap` for many.
        field: `OccupancyGrid.distance_field()`.
        footprint: `Footprint`.
        radius: the smallest turning radius (), m.
        margin: the desired clearance (), m; None for four cells.
        iterations: the number of steps to try.
        parts: the number of parts of each step of the path in the collision test.

    Returns:
        `SmoothedPath`. Its path is clear of obstacles with a curvature of at most 1 / radius, or it
        is the given path.

    Raises:
        InputError: wrong types, a batch, a radius or margin that is not above zero.

    Example:
        >>> import numpy as np
        >>> from rbjax.planning import OccupancyGrid, reeds_shepp
        >>> field = OccupancyGrid(np.zeros((40, 30), bool), 0.1).distance_field()
        >>> bends = Path([0.7, 1.0, 0.0], [[0.5, 0.0, s] for s in (0.5, -0.5, -0.5, 0.5)])
        >>> better = smooth(bends.split(0.1), field, Footprint.disc(0.2), 1.0)
        >>> better.status, bool(better.path.length < bends.length)
        ('smoothed', True)
    """
    instance("smooth", "path", path, Path, "rb.planning.Path")
    check_map("smooth", field, footprint)
    if path.start.ndim != 1:
        raise InputError(
            f"smooth: got a batch of paths {path.start.shape[:-1]}, expected one; use jax.vmap"
        )
    for name, n in (("iterations", iterations), ("parts", parts)):
        integer("smooth", name, n, least=1)
    dtype = jnp.result_type(path.steps, field.values)
    margin = 4 * field.resolution if margin is None else margin
    sizes = []
    for name, x in (("radius", radius), ("margin", margin)):
        real_number("smooth", name, x, "a length above zero", above=0.0, traced=True)
        sizes.append(jnp.asarray(x, dtype))
    path = Path(path.start.astype(dtype), path.steps.astype(dtype))
    run = _program if alone() else _smooth
    return run(path, field, footprint, sizes[0], sizes[1], iterations=iterations, parts=parts)
