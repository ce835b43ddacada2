"""`plan`: from a pose to another on a map, with controls that fit the robot and the map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, flag, real_array, real_number
from rbjax.errors import InputError, UnknownName
from rbjax.planning.maps.footprint import Footprint
from rbjax.planning.maps.occupancy import OccupancyGrid
from rbjax.planning.paths.path import Path, Plan
from rbjax.planning.paths.smoothing import smooth
from rbjax.planning.search.controls import Controls
from rbjax.planning.search.grid_a_star import grid_a_star
from rbjax.planning.search.grid_dijkstra import check_poses, grid_dijkstra
from rbjax.planning.search.hybrid_a_star import hybrid_a_star
from rbjax.planning.search.many_searches import grid_dijkstra_many

HEADINGS = 72
UNIT = 10  # the price of driving a cell's diagonal straight ahead
ROW = 64  # lengths of paths that are smoothed by one program are multiples of this


def drives() -> dict[str, Callable[..., Controls]]:
    """name -> the controls of a robot that drives so, from the radius in m, the least length of a
    motion in m, and whether it drives backwards."""
    return {"car": _car, "differential": _differential, "omnidirectional": _omnidirectional}


def methods() -> dict[str, Callable[..., Plan]]:
    """name -> the search."""
    return {
        "hybrid_a_star": hybrid_a_star,
        "grid_a_star": grid_a_star,
        "grid_dijkstra": grid_dijkstra,
    }


def _car(radius: float, least: float, backwards: bool) -> Controls:
    """Arcs to both sides and straight segments. Driving backwards costs a little more; a reversal
    costs as much as driving `radius` metres forwards."""
    cell = 2 * math.pi / HEADINGS
    turn = cell * max(1, math.ceil(least / (radius * cell) * (1 - 1e-9)))
    reversal = max(1, round(UNIT * radius / (radius * turn)))
    n = 6 if backwards else 3
    costs = [UNIT + 1, UNIT, UNIT + 1, UNIT + 3, UNIT + 2, UNIT + 3][:n]
    speeds = np.repeat([1.0, -1.0], 3)[:n]
    bend = np.tile([1.0, 0.0, -1.0], 2)[:n] / radius
    return Controls(speeds, speeds * bend, radius * turn, costs, reversal, steering=1)


def _differential(radius: float, least: float, backwards: bool) -> Controls:
    """Straights, and turning on the spot by two cells; both take the same time."""
    spin = 2 * 2 * math.pi / HEADINGS / least
    speeds = np.array([1.0, -1.0, 0.0, 0.0])
    chosen = np.array([0, 1, 2, 3] if backwards else [0, 2, 3])
    rates = np.array([0, 0, spin, -spin])[chosen]
    costs = np.array([UNIT, UNIT + 2, 4, 4])[chosen]
    return Controls(speeds[chosen], rates, least, costs, UNIT // 2)


def _omnidirectional(radius: float, least: float, backwards: bool) -> Controls:
    """Eight directions, and turning on the spot by two cells."""
    spin = 2 * 2 * math.pi / HEADINGS / least
    course = np.arange(8) * math.pi / 4
    speeds = np.concatenate([np.cos(course), [0.0, 0.0]]).round(15)
    slides = np.concatenate([np.sin(course), [0.0, 0.0]]).round(15)
    rates = np.concatenate([np.zeros(8), [spin, -spin]])
    return Controls(speeds, rates, least, [UNIT] * 8 + [4] * 2, sideways=slides)


def plan(
    grid: OccupancyGrid,
    footprint: Footprint,
    start: Any,
    goal: Any,
    *,
    drive: str = "car",
    radius: float | None = None,
    backwards: bool = True,
    controls: Controls | None = None,
    method: str = "hybrid_a_star",
    smoothed: bool = True,
    margin: float | None = None,
    max_count: int | None = None,
    **options: Any,
) -> Plan | list[Plan]:
    """A path from a pose to another that is free of obstacles, or why there is none.

    Args:
        grid: the map; what is beyond it counts as occupied.
        footprint: what the robot covers.
        start, goal: poses (3,): x and y in m, the heading in rad. Or (q, 3), for q plans; one pose
            and q of the other are q plans, too.
        drive: "car"; "differential", which turns on the spot; "omnidirectional".
        radius: of a car, the smallest turning radius in m.
        backwards: whether the robot may drive backwards.
        controls: for the search, instead of those that fit drive, radius and map.
        method: "hybrid_a_star", which ends exactly at the goal; "grid_a_star", "grid_dijkstra",
            which end near it.
        smoothed: of a car: whether `smooth` has the last word.
        margin: the clearance in m that it seeks; None for four cells.
        max_count: of nodes that the search expands; None for no limit.
        options: others that the method takes: weight, cell, tolerance ...

    Returns:
        `Plan`, or a list of them. `path` is the exact motion, smoothed if `refinement` is
        "smoothed"; then poses and controls are still those of the search.

    Raises:
        InputError: wrong types or shapes, values that are not finite, a car without a radius.
        UnknownName: no such drive or method.

    Source: the methods'.

    Example:
        >>> walls = np.zeros((60, 40), bool)
        >>> walls[30, :25] = True
        >>> grid, shape = OccupancyGrid(walls, 0.1), Footprint.rectangle(0.6, 0.2, 0.4)
        >>> found = plan(grid, shape, [1.0, 1.0, 0.0], [5.0, 1.0, 0.0], radius=0.8)
        >>> found.status, found.refinement, int(found.path.cusps)
        ('found', 'smoothed', 0)
    """
    choice("method", method, methods())
    choice("drive", drive, drives())
    flag("plan", "backwards", backwards)
    if radius is not None:
        real_number("plan", "radius", radius, above=0.0)
    if not isinstance(grid, OccupancyGrid) or not isinstance(footprint, Footprint):
        raise InputError(
            f"plan: grid is {type(grid).__name__} and footprint {type(footprint).__name__}, "
            "expected rb.planning.OccupancyGrid and rb.planning.Footprint"
        )
    if controls is None:
        controls = _fitting(grid, drive, radius, backwards)
    if max_count is not None:
        options["max_count"] = max_count
    options = {"headings": HEADINGS} | options
    try:
        pair = [
            real_array("plan", name, x, "poses (3,) or (q, 3), in m and rad")
            for name, x in (("start", start), ("goal", goal))
        ]
        many = any(x.ndim == 2 for x in pair)
        starts, goals = np.broadcast_arrays(*map(np.atleast_2d, pair))
    except InputError:
        raise
    except ValueError as error:
        raise InputError(
            f"plan: start and goal have shapes {np.shape(start)} and {np.shape(goal)}, expected "
            "(3,) or (q, 3) each"
        ) from error
    starts, goals = check_poses("plan", starts, goals, 2)
    if many and method == "grid_dijkstra" and jax.default_backend() != "cpu":
        plans = grid_dijkstra_many(grid, footprint, starts, goals, controls, **options)
    else:
        search = methods()[method]
        plans = [
            search(grid, footprint, a, b, controls, **options)
            for a, b in zip(starts, goals, strict=True)
        ]
    tightest = np.abs(controls.curvatures).max()
    if smoothed and tightest > 0:
        plans = [_refined(p, grid, footprint, 1 / tightest, margin) for p in plans]
    return plans if many else plans[0]


def _fitting(grid: OccupancyGrid, drive: str, radius: float | None, backwards: bool) -> Controls:
    if not isinstance(drive, str) or drive not in drives():
        raise UnknownName("drive", drive, drives())
    try:
        if radius is not None:
            real_number("plan", "radius", radius, "a length above zero", above=0.0, traced=True)
        wrong = (radius is None) == (drive == "car")
    except InputError:
        wrong = True
    if wrong:
        want = "a length above zero" if drive == "car" else "none: it has no turning radius"
        raise InputError(f"plan(drive={drive!r}): radius is {radius!r}, expected {want}")
    least = float(grid.resolution) * math.sqrt(2) * (1 + 1e-9)  # it leaves any cell
    return drives()[drive](radius, least, backwards)


def _refined(
    found: Plan, grid: OccupancyGrid, footprint: Footprint, radius: float, margin: float | None
) -> Plan:
    if found.path is None:
        return found
    path = found.path.split(min(1.5 * float(grid.resolution), radius / 3))
    n = path.steps.shape[0]
    if n < 2:
        return replace(found, refinement="as it was")
    rest = np.zeros((-n % ROW, 3), path.steps.dtype)
    padded = Path(path.start, jnp.concatenate([path.steps, rest]))
    better = smooth(padded, grid.distance_field(), footprint, radius, margin)
    if better.status != "smoothed":
        return replace(found, refinement=better.status)
    path = Path(path.start, better.path.steps[:n])
    return replace(found, path=path, refinement=better.status)
