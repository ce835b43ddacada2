"""The fidelities of wheeled robots."""

from __future__ import annotations

import dataclasses
from typing import Any

from rbjax.arguments import choice, instance
from rbjax.errors import UnknownName
from rbjax.wheeled.models.constrained import Constrained
from rbjax.wheeled.models.robot_model import RobotModel
from rbjax.wheeled.models.rolling import Dynamical, Kinematic, QuasiVelocities, ReducedModel
from rbjax.wheeled.models.slipping import Slipping
from rbjax.wheeled.robot.robot import Robot

_FIDELITIES = (Kinematic, ReducedModel, Dynamical, QuasiVelocities, Constrained, Slipping)
#: the word of Olguín Díaz, 8.3
_SYNONYMS = {"kinematical": ReducedModel.name}


def fidelities() -> dict[str, type[RobotModel]]:
    """Return all fidelities, the cheapest first: name -> class.

    Example:
        >>> import rbjax as rb
        >>> list(rb.wheeled.fidelities())[0]
        'kinematic'
    """
    return {f.name: f for f in _FIDELITIES}


def at(robot: Robot, fidelity: str, **options: Any) -> RobotModel:
    """Make the model of a robot at a fidelity.

    Args:
        robot: `Robot`.
        fidelity: a name of `fidelities`. "kinematic" has no inertia; "reduced" has inertia and
            rolling wheels; "slipping" has tyres. The others give the motion of
            "reduced" by other equations.
        options: fields of the model's class, such as `tyre` of "slipping".

    Returns:
        `RobotModel`.

    Raises:
        InputError: `robot` is not a Robot.
        UnknownName: no such fidelity or option.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.at(rb.wheeled.kinds()["omni_3"].make(), "reduced").nv
        3
    """
    public = 'a Robot, as rbjax.wheeled.kinds()["car"].make() gives it'
    instance("at", "robot", robot, Robot, public)
    made = fidelities()[choice("fidelity", fidelity, fidelities(), _SYNONYMS)]
    valid = [f.name for f in dataclasses.fields(made) if f.name != "robot"]
    for name in options:
        if name not in valid:
            raise UnknownName(f"option of {fidelity!r}", name, valid)
    return made(robot, **options)
