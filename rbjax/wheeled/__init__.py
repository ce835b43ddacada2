"""Wheeled robots."""

from rbjax.wheeled.motors import DCMotor, Motor, SpeedServo, TorqueSource
from rbjax.wheeled.relaxation import Relaxing
from rbjax.wheeled.rolling_resistance import RollingResistance
from rbjax.wheeled.tyre_element import Contact, TyreOnGround
from rbjax.wheeled.tyre_laws import Coulomb, Fiala, Linear, Pacejka, TMeasy
from rbjax.wheeled.tyres import Tyre, traction_along

__all__ = [
    "Contact",
    "Coulomb",
    "DCMotor",
    "Fiala",
    "Linear",
    "Motor",
    "Pacejka",
    "Relaxing",
    "RollingResistance",
    "SpeedServo",
    "TMeasy",
    "TorqueSource",
    "Tyre",
    "TyreOnGround",
    "traction_along",
]
