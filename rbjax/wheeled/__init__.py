"""Wheeled robots: rolling without slipping, and slipping.

parts          Body, Wheel, Drive, Steering -> Robot; its Arrangement
robots         kinds, with_trailers; from_file, of MJCF and URDF
fidelities     at(robot, name) -> RobotModel; fidelities
as a Model     full_model, with rolling constraints; full_model_state
as a file      write_mjcf, with wheels that touch a plane
motion         start, rates, rollout, simulate, contacts
following      commands, pure_pursuit, stanley, tracking_gains
control        controlled, the system of an rb.control.Problem
odometry       poses by the angles of wheels; HeadingSlip, a model of slip
equations      reduced, undetermined: the terms S, M, C, B, f, and A with its multipliers
motors         TorqueSource, SpeedServo, DCMotor
tyres          Linear, Coulomb, Fiala, Pacejka, TMeasy; Relaxing; RollingResistance
on any model   TyreOnGround, a force element
"""

from rbjax.wheeled.files.reading import from_file
from rbjax.wheeled.files.writing import write_mjcf
from rbjax.wheeled.kinematics.odometry import HeadingSlip, mean_twists, odometry, rolled_twists
from rbjax.wheeled.models.constrained import full_model_state
from rbjax.wheeled.models.reduction import Reduced, Undetermined, reduced, undetermined
from rbjax.wheeled.models.robot_model import Contacts, RobotModel, contacts, rates, start
from rbjax.wheeled.motion.control_system import RobotSystem, controlled
from rbjax.wheeled.motion.following import (
    Commands,
    commands,
    pure_pursuit,
    stanley,
    tracking_gains,
)
from rbjax.wheeled.motion.rollout import rollout, simulate
from rbjax.wheeled.multibody.full_model import full_model
from rbjax.wheeled.registry import at, fidelities
from rbjax.wheeled.robot.arrangement import Arrangement
from rbjax.wheeled.robot.catalogue import kinds, with_trailers
from rbjax.wheeled.robot.motors import DCMotor, Motor, SpeedServo, TorqueSource
from rbjax.wheeled.robot.robot import Body, Drive, Robot, Steering, Wheel
from rbjax.wheeled.tyres.element import Contact, TyreOnGround
from rbjax.wheeled.tyres.laws import Coulomb, Fiala, Linear, Pacejka, TMeasy
from rbjax.wheeled.tyres.relaxation import Relaxing
from rbjax.wheeled.tyres.tyre import RollingResistance, Tyre, traction_along

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
    "RobotModel",
    "HeadingSlip",
    "Linear",
    "Motor",
    "Pacejka",
    "Reduced",
    "Relaxing",
    "Robot",
    "RollingResistance",
    "SpeedServo",
    "Steering",
    "TMeasy",
    "TorqueSource",
    "Tyre",
    "TyreOnGround",
    "Undetermined",
    "RobotSystem",
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
    "reduced",
    "rolled_twists",
    "rollout",
    "simulate",
    "stanley",
    "start",
    "tracking_gains",
    "traction_along",
    "undetermined",
    "with_trailers",
    "write_mjcf",
]
