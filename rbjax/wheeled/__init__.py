"""Wheeled robots: rolling without slipping, and slipping when they must."""

from rbjax.wheeled.arrangement import Arrangement
from rbjax.wheeled.fidelity import Fidelity
from rbjax.wheeled.parts import Body, Drive, Steering, Wheel
from rbjax.wheeled.registry import at, fidelities, kinds
from rbjax.wheeled.robot import Robot

__all__ = [
    "Arrangement", "Body", "Drive", "Fidelity", "Robot", "Steering", "Wheel", "at", "fidelities",
    "kinds",
]  # fmt: skip
