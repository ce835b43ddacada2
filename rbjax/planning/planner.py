"""`plan`: plan a path between two poses on a map, with controls that fit the robot and the map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, flag, instance, real_array, real_number
from rbjax.errors import InputError
from rbjax.planning.maps.footprint import Footprint
from rbjax.planning.maps.occupancy import OccupancyGrid
from rbjax.planning.paths.path import Path, Plan
from rbjax.planning.paths.smoothing import smooth
from rbjax.planning.search.a_star import grid_a_star, hybrid_a_star
from rbjax.planning.search.controls import (
    HEADINGS,
    Controls,
    car_controls,
    differential_controls,
    omnidirectional_controls,
)
from rbjax.planning.search.grid_dijkstra import grid_dijkstra
from rbjax.planning.search.many_searches import grid_dijkstra_many
from rbjax.planning.search.robot_drive import drive_of
from rbjax.wheeled import Robot

ROW = 64  # paths are padded to multiples of this length, so that one program smooths them


def drives() -> dict[str, Callable[..., Controls]]:
    """Return the functions that make the `Controls` of a drive: name -> function.

    Their arguments are the turning radius in m, the least length of a motion in m, and whether the
    robot may drive backwards.

    Returns:
        Name -> function.

    Example:
        >>> from rbjax.planning import drives
        >>> sorted(drives())
        ['car', 'differential', 'omnidirectional']
    """
    return {
        "car": car_controls,
        "differential": differential_controls,
        "omnidirectional": omnidirectional_controls,
    }


def methods() -> dict[str, Callable[..., Plan]]:
    """Return the search algorithms: name -> function.

    Returns:
        Name -> function.

    Example:
        >>> from rbjax.planning import methods
        >>> sorted(methods())
        ['grid_a_star', 'grid_dijkstra', 'hybrid_a_star']
    """
    return {
        "hybrid_a_star": hybrid_a_star,
        "grid_a_star": grid_a_star,
        "grid_dijkstra": grid_dijkstra,
    }


def plan(
    grid: OccupancyGrid,
    robot: Robot | Footprint,
    start: Any,
    goal: Any,
    *,
    footprint: Footprint | None = None,
    drive: str | None = None,
    radius: float | None = None,
    steering: float = 0.6,
    backwards: bool = True,
    controls: Controls | None = None,
    method: str = "hybrid_a_star",
    smoothed: bool = True,
    margin: float | None = None,
    max_count: int | None = None,
    **options: Any,
) -> Plan | list[Plan]:
    """Plan a path from a pose to another that is free of obstacles.

    Choose `method` or `controls` for another search.

    Args:
        grid: the map. Cells beyond it count as occupied.
        robot: a `wheeled.Robot` without trailers, or a `Footprint`.
        start, goal: poses (3,): x and y in m, the heading in rad. Or (q, 3) for q plans; a single
            pose is used for all of them.
        footprint: of the robot; None for `Footprint.around_wheels(robot)`. A `wheeled.Robot` has no
            body shape, so give it if the body extends beyond the wheels.
        drive: "car"; "differential", which turns on the spot; "omnidirectional". None for the drive
            that the wheels of the robot allow, or for "car" with a `Footprint`.
        radius: the smallest turning radius of a car, m. None for the radius of the robot at the
            angle `steering`, and for other drives.
        steering: the largest steering angle of the robot, rad.
        backwards: whether the robot may drive backwards.
        controls: for the search; None for controls that fit drive, radius and map.
        method: "hybrid_a_star", which ends exactly at the goal, or "grid_a_star" or
            "grid_dijkstra", which end near it.
        smoothed: whether to apply `smooth` to the path of a car.
        margin: the desired clearance for `smooth`, m; None for four cells.
        max_count: the largest number of nodes that the search expands; None for no limit.
        options: further arguments of the method, such as weight, cell or tolerance.

    Returns:
        `Plan`, or a list of q plans. If there is no path, `status` has the reason. `path` is the
        exact motion; it is smoothed if `refinement` is "smoothed". `poses` and `controls` are
        always the result of the search, before smoothing.

    Raises:
        InputError: wrong types or shapes, values that are not finite, a `Footprint` of a car
            without a radius, a robot with trailers, or one that no drive fits.
        UnknownName: no such drive or method.

    Source: see the methods.

    Example:
        >>> walls = np.zeros((60, 40), bool)
        >>> walls[30, :25] = True
        >>> grid, shape = OccupancyGrid(walls, 0.1), Footprint.rectangle(0.6, 0.2, 0.4)
        >>> found = plan(grid, shape, [1.0, 1.0, 0.0], [5.0, 1.0, 0.0], radius=0.8)
        >>> found.status, found.refinement, int(found.path.cusps)
        ('found', 'smoothed', 0)

        With a robot, which has a drive and a turning radius:

        >>> import rbjax as rb
        >>> cart = rb.wheeled.kinds()["differential_drive"].make()
        >>> plan(grid, cart, [1.0, 1.0, 0.0], [5.0, 1.0, 0.0]).status
        'found'
    """
    choice("method", method, methods())
    flag("plan", "backwards", backwards)
    angle = "an angle above 0 and up to 1.5 rad"
    real_number("plan", "steering", steering, angle, above=0.0, least=0.0, most=1.5)
    instance("plan", "grid", grid, OccupancyGrid, "rb.planning.OccupancyGrid")
    instance(
        "plan", "robot", robot, (Robot, Footprint), "rb.wheeled.Robot or rb.planning.Footprint"
    )
    if isinstance(robot, Robot):
        footprint = Footprint.around_wheels(robot) if footprint is None else footprint
        if controls is None and drive is None:
            drive, least = drive_of(robot, steering)
            radius = least if radius is None else radius
    else:
        footprint = robot if footprint is None else footprint
    instance("plan", "footprint", footprint, Footprint, "rb.planning.Footprint")
    drive = choice("drive", "car" if drive is None else drive, drives())
    if controls is None:
        controls = _fitting(grid, drive, radius, backwards)
    instance("plan", "controls", controls, Controls, "rb.planning.Controls")
    options = {"headings": HEADINGS, "max_count": max_count} | options
    pair = [
        real_array("plan", name, x, "poses (3,) or (q, 3), in m and rad")
        for name, x in (("start", start), ("goal", goal))
    ]
    try:
        starts, goals = np.broadcast_arrays(*map(np.atleast_2d, pair))
    except ValueError:
        starts = goals = np.zeros((0, 0))
    if starts.ndim != 2 or starts.shape[-1] != 3:
        raise InputError(
            f"plan: start and goal have shapes {pair[0].shape} and {pair[1].shape}, expected "
            "(3,) or (q, 3) each"
        )
    many = any(x.ndim == 2 for x in pair)
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
        plans = [_smoothed(p, grid, footprint, 1 / tightest, margin) for p in plans]
    return plans if many else plans[0]


def _fitting(grid: OccupancyGrid, drive: str, radius: float | None, backwards: bool) -> Controls:
    """Make controls of a drive whose motions are long enough to leave a cell of the map."""
    if (radius is None) == (drive == "car"):
        want = "a length above zero" if drive == "car" else "none: it has no turning radius"
        raise InputError(f"plan(drive={drive!r}): radius is {radius!r}, expected {want}")
    if radius is not None:
        real_number("plan", "radius", radius, "a length above zero", above=0.0)
    least = float(grid.resolution) * math.sqrt(2) * (1 + 1e-9)
    return drives()[drive](radius, least, backwards)


def _smoothed(
    found: Plan, grid: OccupancyGrid, footprint: Footprint, radius: float, margin: float | None
) -> Plan:
    """Smooth the path of a plan, if the search found one."""
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
