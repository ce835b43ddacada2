"""Planning in the plane: a path on a map, and what it is made of.

    from map to path      plan -> Plan, with its Path
    shortest curves       dubins, reeds_shepp -> Curve
    maps                  OccupancyGrid, its DistanceField
    robots on maps        Footprint, clear, clearance, clear_along
    searches              hybrid_a_star, grid_a_star, grid_dijkstra, grid_dijkstra_many
                          with Controls -> Plan
    refinement            smooth -> Smoothed
    motions in time       time_scaling -> TimeScaled, refine -> Refined, within Limits; Timed
Poses are (x, y, heading) in m and rad; leading axes are a batch.
"""

from rbjax.callable_modules import make_modules_callable
from rbjax.planning.controls import Controls
from rbjax.planning.curves import Curve, dubins, reeds_shepp
from rbjax.planning.footprint import Footprint, clear, clearance
from rbjax.planning.front_door import drives, methods, plan
from rbjax.planning.grid_a_star import grid_a_star
from rbjax.planning.grid_dijkstra import grid_dijkstra
from rbjax.planning.hybrid_a_star import hybrid_a_star
from rbjax.planning.limits import Limits, Timed
from rbjax.planning.many_searches import grid_dijkstra_many
from rbjax.planning.occupancy import DistanceField, OccupancyGrid
from rbjax.planning.paths import Path, Plan, clear_along
from rbjax.planning.refinement import Refined, Residuals, refine
from rbjax.planning.smoothing import Smoothed, smooth
from rbjax.planning.time_scaling import TimeScaled, time_scaling

__all__ = [
    # from map to path
    "Path",
    "Plan",
    "drives",
    "methods",
    "plan",
    # shortest curves
    "Curve",
    "dubins",
    "reeds_shepp",
    # maps
    "DistanceField",
    "OccupancyGrid",
    # robots on maps
    "Footprint",
    "clear",
    "clear_along",
    "clearance",
    # searches
    "Controls",
    "grid_a_star",
    "grid_dijkstra",
    "grid_dijkstra_many",
    "hybrid_a_star",
    # refinement
    "Smoothed",
    "smooth",
    # motions in time
    "Limits",
    "Refined",
    "Residuals",
    "TimeScaled",
    "Timed",
    "refine",
    "time_scaling",
]

make_modules_callable(__name__)
