"""Paths in the plane as chains of twists, and the plans of searches.

A step xi = (a, b, phi) is a constant twist of the robot's frame over one unit of time. a is the
motion forwards and b to the left, in m, while the heading turns by phi. From pose to pose, exactly,

    (x, y) += R(theta + phi / 2) (a, b) sinc(phi / 2),   theta += phi

A car's arc has b = 0, the length |a| and the curvature phi / a. Turning on the spot has a = b = 0.
Sliding sideways has b != 0. A step of zeros has no effect, so paths of several lengths can be
padded to one batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, integer, real_number, shown
from rbjax.display import Display, displayed, field_rows, host, number, plural
from rbjax.errors import InputError
from rbjax.lanes import safe_sqrt
from rbjax.model.record import Record, check_fields, floats
from rbjax.planning.maps.footprint import Footprint, check_map, disc_centers
from rbjax.planning.maps.occupancy import DistanceField
from rbjax.svg import polygons

#: the largest number of parts of a step that `clear_along` accepts
MOST_PARTS = 1_000_000


def displacements(heading: Any, steps: Any, xp: Any = jnp) -> tuple[Any, Any]:
    """Compute the displacements (...), m, in the world by steps (..., 3) from headings (...)."""
    a, b, phi = (steps[..., i] for i in range(3))
    c, s = xp.cos(heading + phi / 2), xp.sin(heading + phi / 2)
    chord = xp.sinc(phi / (2 * math.pi))
    return chord * (c * a - s * b), chord * (s * a + c * b)


def chain(start: Any, steps: Any, xp: Any = jnp) -> Any:
    """Integrate steps (..., n, 3) from a pose (..., 3). Return the poses (..., n + 1, 3)."""
    turned = xp.cumsum(steps[..., 2], -1)
    turned = xp.concatenate([xp.zeros_like(start[..., 2:]), turned], -1)
    headings = start[..., 2:] + turned
    way = xp.stack(displacements(headings[..., :-1], steps, xp), -1)
    xy = xp.cumsum(xp.concatenate([start[..., None, :2], way], -2), -2)
    return xp.concatenate([xy, headings[..., None]], -1)


#: the largest number of steps of a path
MOST_STEPS = 1e7


class Path(Record):
    """A path as a chain of twists. Leading axes are a batch.

    Fields:
        start: (..., 3), the initial pose: x and y in m, the heading in rad.
        steps: (..., n, 3), m forwards, m to the left, rad to the left.

    Example:
        >>> quarter = Path([0.0, 0.0, 0.0], [[np.pi / 2, 0.0, np.pi / 2], [-1.0, 0.0, 0.0]])
        >>> quarter.poses.round(6).tolist()[-1]
        [1.0, 0.0, 1.57079...]
        >>> quarter.gears.tolist(), quarter.curvatures.tolist(), round(float(quarter.length), 4)
        ([1.0, -1.0], [1.0, 0.0], 2.5708)
        >>> quarter.word, quarter.pose_at(2.0708).round(4).tolist()
        ('L+S-', [1.0, 0.5, 1.5708])
    """

    start: jax.Array = eqx.field(converter=floats)
    steps: jax.Array = eqx.field(converter=floats)

    def __check_init__(self) -> None:
        check_fields(self)
        shapes = jnp.shape(self.start), jnp.shape(self.steps)
        if len(shapes[1]) < 2 or shapes[1][-1] != 3 or shapes[0] != (*shapes[1][:-2], 3):
            raise InputError(
                f"Path: got start and steps of shapes {shapes[0]} and {shapes[1]}, expected "
                "(..., 3) and (..., n, 3)"
            )

    @property
    def poses(self) -> jax.Array:
        """Poses (..., n + 1, 3) before and after each step."""
        return chain(self.start, self.steps)

    @property
    def end(self) -> jax.Array:
        """The last pose (..., 3). Its heading is not wrapped."""
        return self.poses[..., -1, :]

    def pose_at(self, s: Any) -> jax.Array:
        """Compute the pose (..., 3) after a length s (...) m of the path, by exact integration. s
        is clipped to the length of the path."""
        length = self.lengths
        left = jnp.asarray(s, length.dtype)[..., None] - (jnp.cumsum(length, -1) - length)
        moves = length > 0
        share = jnp.where(moves, left / jnp.where(moves, length, 1.0), left >= 0)
        steps = jnp.clip(share, 0.0, 1.0)[..., None] * self.steps
        start = jnp.broadcast_to(self.start, (*steps.shape[:-2], 3))
        return chain(start, steps)[..., -1, :]

    def sample_poses(self, n: int) -> jax.Array:
        """Compute n poses (..., n, 3) at equal distances along the path, ends included."""
        integer("Path.sample_poses", "n", n, least=2)
        wide = Path(self.start[..., None, :], self.steps[..., None, :, :])
        share = jnp.linspace(0.0, 1.0, n, dtype=self.steps.dtype)
        return wide.pose_at(self.length[..., None] * share).at[..., -1, :].set(self.end)

    @property
    def word(self) -> str:
        """Kinds and directions of the steps of one path, such as "L+R-S-L-".

        L, S and R are left, straight and right; + and - are forwards and backwards. Steps within
        rounding of zero are omitted.
        """
        if self.start.ndim != 1:
            raise InputError(
                f"Path.word: got a batch of shape {self.start.shape[:-1]}, expected one path; "
                "use jax.tree.map(lambda x: x[i], paths)"
            )
        a, _, turn = np.asarray(self.steps, float).T
        radii = np.abs(a) / np.where(turn == 0, np.inf, np.abs(turn))
        least = 64 * np.finfo(self.steps.dtype).eps * (np.abs(a).sum() + radii.max(initial=0.0))
        steps = zip(np.sign(a * turn).astype(int), a, strict=True)
        return "".join(f"{'SLR'[side]}{'-+'[int(x > 0)]}" for side, x in steps if abs(x) > least)

    @property
    def lengths(self) -> jax.Array:
        """Path lengths (..., n), m, of the frame's origin in each step."""
        square = self.steps[..., 0] ** 2 + self.steps[..., 1] ** 2
        return safe_sqrt(square)

    @property
    def length(self) -> jax.Array:
        """The total length (...), m."""
        return self.lengths.sum(-1)

    @property
    def gears(self) -> jax.Array:
        """Signs (..., n) of the forward speed."""
        return jnp.sign(self.steps[..., 0])

    @property
    def curvatures(self) -> jax.Array:
        """Curvatures (..., n), 1/m, positive to the left; infinite for turns on the spot."""
        length, turn = self.lengths, self.steps[..., 2]
        signed = jnp.where(self.steps[..., 0] < 0, -length, length)
        still = length == 0
        spot = jnp.where(turn == 0, 0.0, jnp.copysign(jnp.inf, turn))
        return jnp.where(still, spot, turn / jnp.where(still, 1.0, signed) + 0.0)  # no -0

    @property
    def cusps(self) -> jax.Array:
        """The number (...) of changes of gear."""
        gear = self.gears
        gear = jnp.where(gear == 0, jnp.nan, gear)
        last = jax.lax.associative_scan(
            lambda p, q: jnp.where(jnp.isnan(q), p, q), gear, axis=gear.ndim - 1
        )
        return (last[..., 1:] * last[..., :-1] < 0).sum(-1)

    def split(self, spacing: float) -> Path:
        """Divide one path into steps of at most `spacing` m or rad. It requires known values.
        Neighbouring steps with proportional twists are joined first."""
        real_number("Path.split", "spacing", spacing, "a number above zero", above=0.0, traced=True)
        if self.start.ndim != 1:
            raise InputError(f"Path.split: got a batch {self.start.shape[:-1]}, expected one path")
        runs = _joined(np.asarray(self.steps))
        size = np.maximum(np.hypot(runs[:, 0], runs[:, 1]), np.abs(runs[:, 2]))
        parts = np.maximum(1, np.ceil(size / spacing * (1 - _rounding(self.steps))))
        if parts.sum() > MOST_STEPS:
            raise InputError(
                f"Path.split: spacing {spacing} makes {parts.sum():.1e} steps, expected at most "
                f"{MOST_STEPS:.0e}; take a larger spacing"
            )
        parts = parts.astype(int)
        steps = np.repeat(runs / parts[:, None], parts, 0)
        return Path(self.start, jnp.asarray(steps, self.steps.dtype))


def _rounding(steps: Any) -> float:
    return max(1e-12, 8 * float(np.finfo(steps.dtype).eps))


def _joined(steps: np.ndarray) -> np.ndarray:
    """Join neighbouring steps with proportional twists, and drop steps of zeros."""
    same = _rounding(steps)
    out: list[np.ndarray] = []
    for step in steps.astype(float)[np.abs(steps).max(1, initial=0.0) > 0]:
        if out:
            last, size, more = out[-1], np.linalg.norm(out[-1]), np.linalg.norm(step)
            if np.abs(last * more - step * size).max() <= same * size * more:
                out[-1] = last + step
                continue
        out.append(step)
    return np.reshape(out, (-1, 3))


def clear_along(field: DistanceField, path: Path, footprint: Footprint, parts: int) -> jax.Array:
    """Test whether a footprint is certainly free of obstacles all along a path.

    Each step is tested at the middles of equal parts. Each disc is enlarged by half of its path
    length in a part, so the motion between the tested poses is covered too.

    Args:
        field: `OccupancyGrid.distance_field()`, m.
        path: `Path`; leading axes are a batch.
        footprint: `Footprint`, m.
        parts: the number of parts of each step. More parts are less conservative.

    Returns:
        (...) of bool.

    Raises:
        InputError: wrong types, or a number of parts out of range.

    Example:
        >>> from rbjax.planning import OccupancyGrid
        >>> field = OccupancyGrid(np.zeros((20, 20), bool), 0.1).distance_field()
        >>> out = Path([1.0, 1.0, 0.0], [[0.5, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> bool(clear_along(field, out, Footprint.disc(0.2), 8))
        False
    """
    where = "clear_along"
    check_map(where, field, footprint)
    instance(where, "path", path, Path, "rb.planning.Path")
    integer(where, "parts", parts, least=1)
    if parts > MOST_PARTS:
        raise InputError(f"{where}: parts is {shown(parts)}, expected at most {MOST_PARTS:,}")
    poses = path.poses[..., :-1, None, :]
    share = (jnp.arange(parts) + 0.5) / parts
    steps = path.steps[..., None, :]
    some = share[:, None] * steps
    x, y = displacements(poses[..., 2], some)
    there = jnp.stack([poses[..., 0] + x, poses[..., 1] + y, poses[..., 2] + some[..., 2]], -1)
    a, b = footprint.centers[:, 0], footprint.centers[:, 1]
    far = jnp.hypot(a, b)
    way = path.lengths[..., None] + jnp.abs(path.steps[..., 2:]) * far  # (..., n, discs)
    wide = footprint.radii + way[..., None, :] / (2 * parts)
    return (field.below(disc_centers(there, footprint)) > wide).all((-1, -2, -3))


@displayed
@dataclass(frozen=True, eq=False)
class Plan:
    """The result of a search.

    Fields:
        status: "found", "no path", "start in collision", "goal in collision" or "count exhausted".
        cost: in the unit of the controls, or None.
        poses: (n + 1, 3), the start, and the pose after each control.
        controls: (n,), indices of the controls; -1 for steps of a direct connection.
        expanded: the number of visited cells.
        path: the exact motion, or None.
        refinement: by `plan`: "none", "smoothed", or "as it was" if smoothing failed.
    """

    status: str
    cost: float | None = None
    poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    controls: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    expanded: int = 0
    path: Path | None = None
    refinement: str = "none"

    def _display_(self) -> Display:
        cost = "" if self.cost is None else f", cost {number(self.cost)}"
        title = f"Plan: {self.status}{cost}, {plural(self.expanded, 'visited cell')}"
        names = ["poses", "controls", "path", "refinement"]
        return Display(title, field_rows(self, names), picture=self._picture)

    def _picture(self) -> str:
        """Draw the path."""
        start, steps = (
            host(getattr(self.path, "start", None)),
            host(getattr(self.path, "steps", None)),
        )
        if start is None or steps is None or start.ndim != 1:
            return ""
        points = chain(start, np.repeat(steps / 4, 4, axis=0), np)[:, :2]
        return polygons([np.concatenate([points, points[::-1]])], [False])

    @property
    def found(self) -> bool:
        return self.status == "found"
