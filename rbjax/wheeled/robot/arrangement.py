"""Mobility and steerability of a robot, and its leading wheels.

A wheel that does not slide sideways is a constraint of the chassis' twist: c(b) . (vx, vy, w) = 0.
With C the rows of all such wheels,

    mobility      d_m = 3 - rank C          free velocities at any steering
    steerability  d_s = rank of the rows of steered wheels
(Campion, Bastin & D'Andrea-Novel 1996; Olguín Díaz, *3D Motion of Rigid Bodies*, ch. 8)

If the robot can move, at most two rows are independent. The wheels of independent rows are the
leading wheels. They define the basis of velocities (`velocities`), which must also satisfy the rows
of all other wheels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.rank_tolerances import rank_tolerance

if TYPE_CHECKING:
    from rbjax.wheeled.robot.robot import Robot, Wheel


@dataclass(frozen=True)
class Leader:
    """The source of an independent constraint row."""

    what: str  # "wheel", which is fixed, "steering" or "skidding"
    number: int = 0  # index of the wheel or steering
    backward: bool = False  # whether the heading of its wheel points backward


@displayed
@dataclass(frozen=True)
class Arrangement:
    """The motions that the wheels of a robot allow.

    Fields:
        mobility: the number of free velocities.
        steerability: the number of independently steered rows.
        leaders: the wheels and steerings whose constraint rows are independent.
        trailing: the leading wheel of each trailer.
        support: 1, 2 or 3 if the wheels of the chassis are at a point, on a line or around an area.
    """

    mobility: int
    steerability: int
    leaders: tuple[Leader, ...]
    trailing: tuple[int, ...] = ()
    support: int = 3

    @property
    def maneuverability(self) -> int:
        """The maneuverability, mobility + steerability."""
        return self.mobility + self.steerability


def arrange(robot: Robot) -> Arrangement:
    """Compute the arrangement of a robot with known values.

    Raises:
        InputError: values are traced; the wheels lock the robot; a trailer has no leading wheel, or
            several that contradict each other.
    """
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(robot)):
        raise InputError(
            "Robot: the parameters are traced, and the arrangement of wheels depends on them; "
            "build the robot outside of traced code and change its parameters with `replace` or "
            "`equinox.tree_at`, or give `arrangement`"
        )
    sources = _sources(robot)
    random = np.random.default_rng(0)
    angles = random.uniform(-0.7, 0.7, (8, len(robot.steerings)))
    leaders: list[Leader] = []
    for source in sources:
        ranks = [_rank(robot, [*leaders, source], b) for b in angles]
        if min(ranks) > len(leaders):
            leaders.append(source)
    if len(leaders) > 2:
        named = ", ".join(f"{x.what} {x.number}" for x in leaders)
        raise InputError(
            f"Robot: the wheels lock the chassis: {named} allow no motion together. Put wheels "
            "that are steered together into one `Steering`, or set skids=True on wheels that "
            "slide sideways"
        )
    for source in sources:
        if max(_rank(robot, [*leaders, source], b) for b in angles) > len(leaders):
            raise InputError(
                f"Robot: {source.what} {source.number} contradicts the others at some steering; "
                "put wheels that are steered together into one `Steering`"
            )
    steered = [x for x in leaders if x.what == "steering"]
    if len(leaders) == 2 and len(steered) == 2:
        leaders.sort(key=lambda x: _place(robot, x)[0])  # the second is ahead
    trailing = tuple(_trailing(robot, k) for k in range(1, len(robot.bodies)))
    places = np.array([np.asarray(w.position) for w in robot.wheels if w.body == 0])
    support = 1 + int(np.linalg.matrix_rank(places - places[0], tol=1e-6))
    return Arrangement(3 - len(leaders), len(steered), tuple(leaders), trailing, support)


def _sources(robot: Robot) -> list[Leader]:
    """Return the wheels and steerings that give the constraint rows of the chassis, fixed wheels
    first."""
    out = [
        Leader("wheel", i, _is_backward(wheel))
        for i, wheel in enumerate(robot.wheels)
        if wheel.body == 0 and wheel.kind == "fixed" and not wheel.skids
    ]
    if any(wheel.body == 0 and wheel.skids for wheel in robot.wheels):
        out.append(Leader("skidding"))
    firsts = [robot.wheels[steering.wheels[0]] for steering in robot.steerings]
    return out + [Leader("steering", j, _is_backward(wheel)) for j, wheel in enumerate(firsts)]


def _is_backward(wheel: Wheel) -> bool:
    """Return whether a wheel's heading points backward."""
    return bool(np.cos(float(wheel.heading)) < -1e-6)


def _place(robot: Robot, source: Leader) -> np.ndarray:
    if source.what == "skidding":
        return np.array([float(robot.turn_center), 0.0])
    numbers = (source.number,) if source.what == "wheel" else robot.steerings[source.number].wheels
    return np.mean([np.asarray(robot.wheels[i].position) for i in numbers], 0)


def constraint_row(robot: Robot, source: Leader, angles: np.ndarray) -> np.ndarray:
    """Return the row c (3,) of a leader at angles (steerings,), rad: c . (vx, vy, w) = 0."""
    x, y = _place(robot, source)
    heading = 0.0
    if source.what == "wheel":
        heading = float(robot.wheels[source.number].heading)
    elif source.what == "steering":
        first = robot.wheels[robot.steerings[source.number].wheels[0]]
        heading = float(first.heading) + angles[source.number]
    c, s = np.cos(heading), np.sin(heading)
    return np.array([-s, c, c * x + s * y])


def _rank(robot: Robot, sources: list[Leader], angles: np.ndarray) -> int:
    rows = np.array([constraint_row(robot, source, angles) for source in sources])
    reach = max(1e-3, max(float(np.hypot(*np.asarray(w.position))) for w in robot.wheels))
    values: Any = np.linalg.svd(rows / [1, 1, reach], compute_uv=False)
    return int((values > _zero(robot) * values.max()).sum())


def _zero(robot: Robot) -> float:
    """Return the tolerance of rank decisions, for the dtype of the headings (a heading of pi has an
    error)."""
    dtype = jnp.result_type(float, robot.wheels[0].heading.dtype)
    return rank_tolerance("wheels", dtype)


def _trailing(robot: Robot, k: int) -> int:
    """Return the leading wheel of trailer k.

    Raise `InputError` unless the axles of its other wheels give the same constraint.
    """
    body = robot.bodies[k]
    wheels = [
        i for i, w in enumerate(robot.wheels) if w.body == k and w.kind == "fixed" and not w.skids
    ]
    if not wheels:
        raise InputError(
            f"Robot: bodies[{k}] is a trailer without a fixed wheel; give it one that does not skid"
        )
    axles = []
    for i in wheels:
        heading, p = float(robot.wheels[i].heading), np.asarray(robot.wheels[i].position)
        e = np.array([np.cos(heading), np.sin(heading)])
        # lateral velocity of the wheel per velocity of the coupling, and per turning rate about it
        axles.append([-e[1], e[0], e @ (p - [float(body.drawbar), 0.0])])
    rows = np.array(axles)
    if abs(rows[0, 2]) < _zero(robot) * (1 + np.abs(rows).max()):
        raise InputError(
            f"Robot: the axle of wheels[{wheels[0]}] goes through the coupling of bodies[{k}], "
            "which leaves the angle of the trailer open; give a `drawbar`"
        )
    if np.linalg.matrix_rank(rows, tol=_zero(robot)) > 1:
        raise InputError(
            f"Robot: the axles of bodies[{k}] contradict each other; set skids=True on the wheels "
            "of all but one"
        )
    return wheels[0]
