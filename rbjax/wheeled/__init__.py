"""Models, motion and control of wheeled robots, with wheels that roll or slip.

Parts: Body, Wheel, Drive, Steering -> Robot; Arrangement, the motions that its wheels allow.
Robots by name: kinds, with_trailers.
Robots from MJCF and URDF files: from_file.
Models of a robot at a fidelity: at(robot, name) -> RobotModel; fidelities.
Multibody model with rolling constraints: full_model; full_model_state.
MJCF file with wheels in contact with a plane: write_mjcf.
Motion: start, rates, rollout, simulate, contacts.
Path following: commands, pure_pursuit, stanley, tracking_gains.
Optimal control: controlled, which makes the system of an rb.control.Problem.
Odometry: odometry, poses from wheel angles; HeadingSlip, a model of slip.
Terms of the equations of motion (S, M, C, B, f, A): reduced, undetermined.
Motors: TorqueSource, SpeedServo, DCMotor.
Tyre laws: LinearTyre, Coulomb, Fiala, Pacejka, TMeasy; Relaxing; RollingResistance.
Force element for a wheel of any model: TyreOnGround.
"""

from rbjax.wheeled.files.reading import from_file
from rbjax.wheeled.files.writing import write_mjcf
from rbjax.wheeled.kinematics.odometry import HeadingSlip, mean_twists, odometry, rolled_twists
from rbjax.wheeled.models.constrained import full_model_state
from rbjax.wheeled.models.reduction import Reduced, Undetermined, reduced, undetermined
from rbjax.wheeled.models.robot_model import RobotModel, WheelContacts, contacts, rates, start
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
from rbjax.wheeled.tyres.element import TyreContact, TyreOnGround
from rbjax.wheeled.tyres.laws import Coulomb, Fiala, LinearTyre, Pacejka, TMeasy
from rbjax.wheeled.tyres.relaxation import Relaxing
from rbjax.wheeled.tyres.tyre import RollingResistance, Tyre

__all__ = [
    "Arrangement",
    "Body",
    "Commands",
    "TyreContact",
    "WheelContacts",
    "Coulomb",
    "DCMotor",
    "Drive",
    "Fiala",
    "RobotModel",
    "HeadingSlip",
    "LinearTyre",
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
    "undetermined",
    "with_trailers",
    "write_mjcf",
]

__dir__ = __all__.copy
