"""Wheeled robots: rolling without slipping, and slipping when they must.

    parts          Body, Wheel, Drive, Steering -> Robot; its Arrangement
    robots         kinds, with_trailers; from_file, of MJCF and URDF
    fidelities     at(robot, name) -> a vehicle; fidelities
    as a Model     full_model, with rolling rows; full_model_state
    as a file      write_mjcf, with wheels that touch a plane
    motion         start, rates, rollout, simulate, contacts
    following      commands, pure_pursuit, stanley, tracking_gains
    control        controlled, the system of an rb.control.Problem
    odometry       poses by the angles of wheels; HeadingSlip, of floors where they slip
    motors         TorqueSource, SpeedServo, DCMotor
    tyres          Linear, Coulomb, Fiala, Pacejka, TMeasy; Relaxing; RollingResistance
    on any model   TyreOnGround, a force element
    recommend      the cheapest fidelity that is accurate enough for a manoeuvre
"""

from typing import Any

from rbjax.above import names_from_above
from rbjax.callable_modules import make_modules_callable
from rbjax.wheeled.arrangement import Arrangement
from rbjax.wheeled.constrained import full_model_state
from rbjax.wheeled.contacts import Contacts, contacts
from rbjax.wheeled.controlled import Vehicle, controlled
from rbjax.wheeled.fidelity import Fidelity
from rbjax.wheeled.following import (
    Commands,
    commands,
    pure_pursuit,
    stanley,
    tracking_gains,
)
from rbjax.wheeled.from_file import from_file
from rbjax.wheeled.full_model import full_model
from rbjax.wheeled.kinds import with_trailers
from rbjax.wheeled.motion import rollout, simulate
from rbjax.wheeled.motors import DCMotor, Motor, SpeedServo, TorqueSource
from rbjax.wheeled.odometry import HeadingSlip, mean_twists, odometry, rolled_twists
from rbjax.wheeled.parts import Body, Drive, Steering, Wheel
from rbjax.wheeled.registry import at, fidelities, kinds
from rbjax.wheeled.relaxation import Relaxing
from rbjax.wheeled.robot import Robot
from rbjax.wheeled.rolling_resistance import RollingResistance
from rbjax.wheeled.states import rates, start
from rbjax.wheeled.tyre_element import Contact, TyreOnGround
from rbjax.wheeled.tyre_laws import Coulomb, Fiala, Linear, Pacejka, TMeasy
from rbjax.wheeled.tyres import Tyre, traction_along
from rbjax.wheeled.write_mjcf import write_mjcf

#: names offered here whose module imports this package; `rbjax` fills this table
FROM_ABOVE = names_from_above("rbjax.wheeled")


def __getattr__(name: str) -> Any:
    """`recommend` runs manoeuvres, so its module imports this package; it is loaded on use."""
    if name in FROM_ABOVE:
        return FROM_ABOVE[name]()
    raise AttributeError(f"module 'rbjax.wheeled' has no attribute {name!r}")


__all__ = [
    "Arrangement",
    "Body",
    "Commands",
    "Contact",
    "Contacts",
    "Coulomb",
    "DCMotor",
    "Drive",
    "Fiala",
    "Fidelity",
    "HeadingSlip",
    "Linear",
    "Motor",
    "Pacejka",
    "Recommendation",
    "Relaxing",
    "Robot",
    "RollingResistance",
    "SpeedServo",
    "Steering",
    "TMeasy",
    "TorqueSource",
    "Tyre",
    "TyreOnGround",
    "Vehicle",
    "Wheel",
    "at",
    "commands",
    "contacts",
    "controlled",
    "fidelities",
    "from_file",
    "full_model",
    "full_model_state",
    "kinds",
    "mean_twists",
    "odometry",
    "pure_pursuit",
    "rates",
    "recommend",
    "rolled_twists",
    "rollout",
    "simulate",
    "stanley",
    "start",
    "tracking_gains",
    "traction_along",
    "with_trailers",
    "write_mjcf",
]

make_modules_callable(__name__)
