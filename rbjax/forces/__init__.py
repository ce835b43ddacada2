"""What acts on a robot: its own springs, dampers and actuators."""

from rbjax.forces.applied import applied_forces, elastic_energy

__all__ = ["applied_forces", "elastic_energy"]
