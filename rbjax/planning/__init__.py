"""Planning in the plane: shortest curves of a car, maps of obstacles, and searches among them.

    shortest curves       dubins, reeds_shepp -> Curve
    maps                  OccupancyGrid, its DistanceField
    robots on maps        Footprint, clear, clearance
    searches              grid_dijkstra, grid_dijkstra_many, with Controls -> Plan
Poses are (x, y, heading) in m and rad; leading axes are a batch.
"""

from rbjax.planning.controls import Controls
from rbjax.planning.curves import Curve, dubins, reeds_shepp
from rbjax.planning.footprint import Footprint, clear, clearance
from rbjax.planning.grid_a_star import grid_a_star
from rbjax.planning.grid_dijkstra import grid_dijkstra
from rbjax.planning.hybrid_a_star import hybrid_a_star
from rbjax.planning.many_searches import grid_dijkstra_many
from rbjax.planning.occupancy import DistanceField, OccupancyGrid
from rbjax.planning.paths import Path, Plan, clear_along

__all__ = [
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
    "Path",
    "Plan",
    "grid_a_star",
    "grid_dijkstra",
    "grid_dijkstra_many",
    "hybrid_a_star",
]
