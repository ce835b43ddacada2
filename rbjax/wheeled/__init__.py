"""Wheeled robots: rolling without slipping, and slipping when they must."""

from rbjax.wheeled.arrangement import Arrangement
from rbjax.wheeled.fidelity import Fidelity
from rbjax.wheeled.motion import rollout, simulate
from rbjax.wheeled.parts import Body, Drive, Steering, Wheel
from rbjax.wheeled.registry import at, fidelities, kinds
from rbjax.wheeled.robot import Robot
from rbjax.wheeled.states import rates, start

__all__ = [
    "Arrangement", "Body", "Drive", "Fidelity", "Robot", "Steering", "Wheel", "at", "fidelities",
    "kinds", "rates", "rollout", "simulate", "start",
]  # fmt: skip
