"""Occupancy grids of the plane, and exact signed distances from obstacles.

Cell (i, j) is the square of side h whose lower left corner is origin + h (i, j); i counts along x.
The signed distance d is positive in free space, negative in obstacles, and zero on the edges of
their cells. At the centres of cells it is exact:

    d = D(occupied) - D(free),   D(set)^2 = min over its cells of  a(i - i')^2 + a(j - j')^2

with a(k) = h max(|k| - 1/2, 0), the distance of a centre from a square k cells away. The minimum
is computed one axis after the other (Felzenszwalb & Huttenlocher, Theory of Computing 8 (2012)
415).

Between centres: d has slope one, so the bilinear interpolation `at` is within h / sqrt(2) of it,
on either side, and is differentiable. `below` is never more than d, and at least d - h sqrt(2), so
tests with it are conservative.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, floating_array
from rbjax.compiling import compiled
from rbjax.display import Display, field_rows, host, shape, value_text
from rbjax.errors import InputError
from rbjax.lanes import safe_sqrt
from rbjax.model.record import Record, check_fields, check_number, floats
from rbjax.planning.maps.ros_map import read
from rbjax.svg import cells

#: maps of more cells are not drawn in a notebook
MOST_CELLS = 4_000_000


class DistanceField(Record):
    """Signed distances from the obstacles of a map.

    Fields:
        values: (nx + 2, ny + 2), m, at the centres of the map's cells and of a ring of cells around
            the map. They are limited to the map's diagonal.
        resolution: (), the side of a cell, m.
        origin: (2,), the corner of cell (0, 0) of the map, m.
    """

    values: jax.Array
    resolution: jax.Array
    origin: jax.Array

    def at(self, points: ArrayLike) -> jax.Array:
        """Interpolate the distance (...), m, at points (..., 2), m. Beyond the ring around the map,
        the distance from the ring is subtracted."""
        u, v, away = self._place(points)
        nx, ny = self.values.shape
        i = jnp.clip(jnp.floor(u), 0, nx - 2).astype(int)
        j = jnp.clip(jnp.floor(v), 0, ny - 2).astype(int)
        a, b = u - i, v - j
        low = (1 - b) * self.values[i, j] + b * self.values[i, j + 1]
        high = (1 - b) * self.values[i + 1, j] + b * self.values[i + 1, j + 1]
        return (1 - a) * low + a * high - away

    def below(self, points: ArrayLike) -> jax.Array:
        """Compute a lower bound (...) of the distance at points (..., 2), m."""
        u, v, away = self._place(points)
        i, j = jnp.round(u), jnp.round(v)
        off = self.resolution * safe_sqrt((u - i) ** 2 + (v - j) ** 2)
        return self.values[i.astype(int), j.astype(int)] - off - away

    def _place(self, points: ArrayLike) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Clamp points (..., 2) to the rectangle of the cell centres.

        Return the indices along x and y, and the distance of each point from the rectangle, m.
        """
        nx, ny = self.values.shape
        points = _pairs("DistanceField", "points", points)
        u, v = ((points[..., k] - self.origin[k]) / self.resolution + 0.5 for k in (0, 1))
        inside, also = jnp.clip(u, 0.0, nx - 1.0), jnp.clip(v, 0.0, ny - 1.0)
        away = safe_sqrt((u - inside) ** 2 + (v - also) ** 2)
        return inside, also, self.resolution * away


class OccupancyGrid(Record):
    """A map of free and occupied cells.

    Fields:
        occupied: (nx, ny), bool.
        resolution: (), the side of a cell, m.
        origin: (2,), the corner of cell (0, 0), m.

    Example:
        >>> walls = np.zeros((40, 30), bool)
        >>> walls[20, :15] = True
        >>> grid = OccupancyGrid(walls, 0.1)
        >>> grid.cell(jnp.array([2.05, 0.33])).tolist()
        [20, 3]
        >>> grid.center(jnp.array([20, 3])).tolist()
        [2.05..., 0.35...]
        >>> round(float(grid.distance_field().at(jnp.array([1.55, 0.95]))), 6)
        0.45
    """

    occupied: jax.Array = eqx.field(converter=lambda x: _cells(x))
    resolution: jax.Array = eqx.field(converter=floats)
    origin: jax.Array = eqx.field(converter=floats, default=(0.0, 0.0))

    if TYPE_CHECKING:

        def __init__(
            self,
            occupied: ArrayLike,
            resolution: ArrayLike,
            origin: ArrayLike | tuple[float, float] = (0.0, 0.0),
        ) -> None: ...

    def __check_init__(self) -> None:
        check_fields(self)
        check_number(self, "resolution", positive=True)
        if jnp.shape(self.origin) != (2,):
            raise InputError(
                f"OccupancyGrid(origin=...): got the shape {jnp.shape(self.origin)}, expected (2,)"
            )

    def _display_(self) -> Display:
        known, title = host(self.occupied), "OccupancyGrid"
        if len(shape(self.occupied)) == 2:
            nx, ny = shape(self.occupied)
            title += f": {nx} x {ny} cells of {value_text(self.resolution)} m"
        title += "" if known is None else f", {known.mean():.0%} occupied"
        return Display(title, field_rows(self), picture=self._picture)

    def _picture(self) -> str:
        known = host(self.occupied, most=MOST_CELLS)
        return "" if known is None or known.ndim != 2 else cells(known)

    @classmethod
    def from_ros(cls, file: Any, *, unknown: str = "occupied") -> OccupancyGrid:
        """Read a map of ROS's map_server: a `map.yaml` and its image.

        Args:
            file: path of the YAML file, with image, resolution, origin, negate, occupied_thresh and
                free_thresh. Mode is trinary or scale.
            unknown: "occupied" or "free", the treatment of cells between the thresholds.

        Raises:
            InputError: a file that cannot be read, keys that are missing, numbers out of range, a
                map with a yaw.
            UnknownName: another mode.
        """
        return cls(*map(jnp.asarray, read(file, unknown)))

    def cell(self, points: ArrayLike) -> jax.Array:
        """Return the cells (..., 2) of points (..., 2), m. They may be beyond the map."""
        points = _pairs("OccupancyGrid.cell", "points", points)
        return jnp.floor((points - self.origin) / self.resolution).astype(int)

    def center(self, cells: ArrayLike) -> jax.Array:
        """Return the centres (..., 2), m, of cells (..., 2)."""
        cells = _pairs("OccupancyGrid.center", "cells", cells)
        return self.origin + self.resolution * (cells + 0.5)

    def distance_field(self, closed: bool = True) -> DistanceField:
        """Compute the exact signed distances from the obstacles.

        It requires nx^2 ny operations, and may be used in `jit` and `vmap`. For a map of known
        values the result is cached.

        closed: whether cells beyond the map count as occupied.
        """
        if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(self)):
            return _distance_field(self, closed=closed)
        if closed not in self._fields:
            with jax.ensure_compile_time_eval():
                self._fields[closed] = _distance_field(self, closed=closed)
        return self._fields[closed]

    @functools.cached_property
    def _fields(self) -> dict[bool, DistanceField]:
        """Cache of the distance fields: `closed` -> field."""
        return {}


def _pairs(where: str, name: str, value: ArrayLike) -> jax.Array:
    return floating_array(where, name, value, lambda shape: shape[-1:] == (2,), "(..., 2)")


def _cells(occupied: Any) -> Any:
    try:
        cells = occupied if hasattr(occupied, "dtype") else np.asarray(occupied)
    except ValueError:
        cells = np.zeros(0, object)
    if len(np.shape(cells)) != 2 or 0 in np.shape(cells) or cells.dtype != bool:
        raise InputError(
            f"OccupancyGrid(occupied=...): got {type(occupied).__name__} of shape "
            f"{np.shape(cells)} and dtype {cells.dtype}, expected an array (nx, ny) of bool"
        )
    return jnp.asarray(cells)


def _field(grid: OccupancyGrid, closed: bool) -> DistanceField:
    solid = jnp.pad(grid.occupied, 1, constant_values=closed)
    h = grid.resolution
    most = jnp.sqrt(jnp.asarray(float(sum(n * n for n in grid.occupied.shape)), h.dtype))
    out, within = (jnp.minimum(_distance(cells, h.dtype), most) for cells in (solid, ~solid))
    return DistanceField(h * (out - within), h, grid.origin)


_distance_field = compiled(_field, static_argnames=("closed",))


def _distance(cells: jax.Array, dtype: Any) -> jax.Array:
    """Compute the distance D of all centres from a set of cells, in cells; infinite if it is
    empty."""
    nx, ny = cells.shape
    j = jnp.arange(ny)
    before = jax.lax.cummax(jnp.where(cells, j, -jnp.inf).astype(dtype), axis=1)
    after = jax.lax.cummin(jnp.where(cells, j, jnp.inf).astype(dtype), axis=1, reverse=True)
    column = _gap(jnp.minimum(j - before, after - j)) ** 2  # of the nearest in the same column x
    i = jnp.arange(nx, dtype=dtype)
    across = _gap(jnp.abs(i[:, None] - i)) ** 2
    return jnp.sqrt((across[:, :, None] + column[None]).min(1))


def _gap(k: jax.Array) -> jax.Array:
    """Compute the distance of a centre from a square k cells away, in cells."""
    return jnp.maximum(k - 0.5, 0.0)
