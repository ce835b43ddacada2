"""Planning in the plane, from a map to a path and to a motion in time.

Path planning: plan -> Plan, which contains a Path.
Shortest curves without obstacles: dubins, reeds_shepp -> Path.
Maps: OccupancyGrid and its DistanceField.
Collision tests: Footprint, clear, clearance, clear_along.
Searches with Controls: hybrid_a_star, grid_a_star, grid_dijkstra, grid_dijkstra_many -> Plan.
Path smoothing: smooth -> SmoothedPath.
Time-optimal motions within Limits: time_scaling -> TimeScaled, refine -> Refined; Timed.

Poses are (x, y, heading) in m and rad. Leading axes are a batch.
"""

from rbjax.planning.maps.footprint import Footprint, clear, clearance
from rbjax.planning.maps.occupancy import DistanceField, OccupancyGrid
from rbjax.planning.paths.curves import dubins, reeds_shepp
from rbjax.planning.paths.path import Path, Plan, clear_along
from rbjax.planning.paths.smoothing import SmoothedPath, smooth
from rbjax.planning.planner import drives, methods, plan
from rbjax.planning.search.a_star import grid_a_star, hybrid_a_star
from rbjax.planning.search.controls import Controls
from rbjax.planning.search.grid_dijkstra import grid_dijkstra
from rbjax.planning.search.many_searches import grid_dijkstra_many
from rbjax.planning.timing.limits import Limits, Timed
from rbjax.planning.timing.refinement import Refined, Residuals, refine
from rbjax.planning.timing.time_scaling import TimeScaled, time_scaling

__all__ = [
    # from map to path
    "Path",
    "Plan",
    "drives",
    "methods",
    "plan",
    # shortest curves
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
    "SmoothedPath",
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

__dir__ = __all__.copy
