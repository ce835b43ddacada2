"""Planning in the plane: shortest curves of a car, maps of obstacles, and searches among them."""

from rbjax.planning.curves import Curve, dubins, reeds_shepp

__all__ = ["Curve", "dubins", "reeds_shepp"]
