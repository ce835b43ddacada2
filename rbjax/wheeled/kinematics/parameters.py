"""The parameters of a robot as lanes, in the form that the equations use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from rbjax.lanes import Lane, add, is_zero, mul, neg, total
from rbjax.model.leaves import numbers as lanes
from rbjax.model.leaves import scalar, table
from rbjax.wheeled.kinematics.planar import Pair, direction, dot

if TYPE_CHECKING:
    from rbjax.wheeled.robot.robot import Layout, Robot


@dataclass(frozen=True)
class BodyParameters:
    """A body including its wheels: mass, first moment (mass times com), inertia about its
    origin."""

    ahead: int | None
    mass: Lane
    moment: Pair
    inertia: Lane
    height: Lane
    hitch: Pair
    drawbar: Lane


@dataclass(frozen=True)
class WheelParameters:
    """The parameters of a wheel."""

    kind: str
    body: int
    shaft: int
    skids: bool
    position: Pair
    heading: Pair  # at zero steering
    radius: Lane
    inertia: Lane
    yaw_inertia: Lane
    slant: Lane  # tangent of `roller`
    trail: Lane


@dataclass(frozen=True)
class Parameters:
    """The parameters of a wheeled robot as lanes, part by part."""

    robot: Any
    dtype: Any
    layout: Layout
    bodies: tuple[BodyParameters, ...]
    #: casters and their forks, with only the first moment about the pivot
    forks: tuple[BodyParameters, ...]
    wheels: tuple[WheelParameters, ...]
    #: inertias of shafts, without those of motors, and their damping
    shafts: tuple[Lane, ...]
    damping: tuple[Lane, ...]
    #: the shares of the wheels of each drive
    splits: tuple[tuple[Lane, ...], ...]
    turn_center: Lane
    #: components of gravity along the ground, in world axes, and normal to it
    downhill: Pair
    gravity: Lane
    motors: tuple[Any, ...]
    resistance: Any

    def ahead(self, k: int) -> int:
        """Return the index of the body that pulls trailer k."""
        ahead = self.bodies[k].ahead
        assert ahead is not None
        return ahead

    @property
    def rigid(self) -> tuple[BodyParameters, ...]:
        """The bodies, then the forks of the casters."""
        return (*self.bodies, *self.forks)

    def lane(self, x: Any) -> Lane:
        """Convert a numeric field of a body, wheel or drive to a lane."""
        return scalar(x, self.dtype)

    def shaft_rates(self, w: Sequence[Lane]) -> Sequence[Lane]:
        """Return the rates of shafts among the full velocities w."""
        return w[2 + len(self.bodies) :]


def stack_lanes(lanes: Sequence[Lane], dtype: Any) -> jax.Array:
    """Stack lanes to an array (n,)."""
    return jnp.stack([jnp.asarray(x, dtype) for x in lanes]) if len(lanes) else jnp.zeros(0, dtype)


def indices(s: slice) -> range:
    """Return the indices of a slice of `Layout`."""
    return range(s.start, s.stop)


def with_lanes(part: Any, dtype: Any) -> Any:
    """Convert the numbers of a motor or tyre to lanes. An array with one entry for each axis stays
    an array."""

    def lane(x: Any) -> Any:
        return table(x, dtype) if jnp.ndim(x) else scalar(jnp.asarray(x), dtype)

    return jax.tree.map(lane, part)


def parameters_of(robot: Robot, dtype: Any) -> Parameters:
    """Convert the parameters of a robot to lanes. Values known while tracing become literals."""
    layout = robot.layout

    def number(x: Any) -> Lane:
        return scalar(x, dtype)

    def pair(x: Any) -> Pair:
        a, b = lanes(x, dtype)
        return a, b

    wheels = []
    for wheel, shaft in zip(robot.wheels, layout.shaft, strict=True):
        c, s = direction(number(wheel.roller)) if wheel.kind == "rollers" else (1.0, 0.0)
        wheels.append(
            WheelParameters(
                wheel.kind, wheel.body, shaft, wheel.skids, pair(wheel.position),
                direction(number(wheel.heading)), number(wheel.radius), number(wheel.inertia),
                number(wheel.yaw_inertia), 0.0 if is_zero(s) else s / c, number(wheel.trail),
            )
        )  # fmt: skip
    bodies = []
    for k, body in enumerate(robot.bodies):
        mass, com = number(body.mass), pair(body.com)
        masses = [(mass, com)]
        inertia = number(body.inertia)
        for wheel, n in zip(robot.wheels, wheels, strict=True):
            if wheel.body == k:
                masses.append((number(wheel.mass), n.position))
                # a caster turns freely about its pivot, so the body has none of its yaw inertia
                inertia = add(inertia, 0.0 if n.kind == "caster" else n.yaw_inertia)
        inertia = add(inertia, total(mul(m, dot(p, p)) for m, p in masses))
        bodies.append(
            BodyParameters(
                body.ahead,
                total(m for m, _ in masses),
                (total(mul(m, p[0]) for m, p in masses), total(mul(m, p[1]) for m, p in masses)),
                inertia, number(body.height), pair(body.hitch), number(body.drawbar),
            )
        )  # fmt: skip
    forks = []
    for i in layout.caster_wheels:
        moment = neg(mul(number(robot.wheels[i].mass), number(robot.wheels[i].behind)))
        forks.append(BodyParameters(None, 0.0, (moment, 0.0), 0.0, 0.0, (0.0, 0.0), 0.0))
    shafts: list[Lane] = [0.0] * len(layout.setters)
    damping: list[Lane] = [0.0] * len(layout.setters)
    for wheel, n in zip(robot.wheels, wheels, strict=True):
        shafts[n.shaft] = add(shafts[n.shaft], n.inertia)
        damping[n.shaft] = add(damping[n.shaft], number(wheel.damping))
    splits = tuple(tuple(lanes(drive.split, dtype)) for drive in robot.drives)
    fall = pair(robot.slope)
    across = number(robot.gravity)
    if not (is_zero(fall[0]) and is_zero(fall[1])):
        across = across * (1.0 + dot(fall, fall)) ** -0.5
    return Parameters(
        robot, dtype, layout, tuple(bodies), tuple(forks), tuple(wheels), tuple(shafts),
        tuple(damping), splits, number(robot.turn_center),
        (mul(across, fall[0]), mul(across, fall[1])), across,
        tuple(with_lanes(drive.motor, dtype) for drive in robot.drives),
        with_lanes(robot.resistance, dtype),
    )  # fmt: skip
