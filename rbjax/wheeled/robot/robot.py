"""A wheeled robot: its parts, its coordinates, and what its wheels allow.

Coordinates q: the pose (x, y, heading) of the chassis, the angle of each trailer against the body
ahead, of each steering, of each caster, of each shaft. Full velocities w: the twist (vx, vy and the
turning rate) of the chassis in its own axes, and the rates of trailers and of shafts. Those of
casters follow from the others, those of steerings are given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.model.record import Record, check_number, floats
from rbjax.wheeled.robot.arrangement import Arrangement, arrange
from rbjax.wheeled.robot.parts import Body, Drive, Steering, Wheel
from rbjax.wheeled.tyres.rolling_resistance import RollingResistance


@dataclass(frozen=True)
class Layout:
    """Where coordinates are in q, and full velocities in w; the shaft of each wheel.

    shafts: of each shaft, the wheel that sets its rate: the first that is on it.
    """

    trailers: slice
    steerings: slice
    casters: slice
    shafts: slice
    shaft: tuple[int, ...]
    setters: tuple[int, ...]
    caster_wheels: tuple[int, ...]

    @property
    def nq(self) -> int:
        return self.shafts.stop

    @property
    def nw(self) -> int:
        """Full velocities: three, and the rates of trailers and of shafts."""
        return 3 + (self.trailers.stop - self.trailers.start) + len(self.setters)


class Robot(Record):
    """A chassis with wheels, drives and steerings, and perhaps trailers.

    Fields: bodies, the chassis first, each trailer behind the body that pulls it; wheels; drives;
    steerings; gravity, m/s^2; slope (2,), how steeply the ground falls along x and along y, as
    tangents; resistance, a `RollingResistance` of all wheels, or None; turn_center, m, the x of the
    axis on which a robot with skidding wheels turns. Static: arrangement, what its wheels allow.

    Controls u are one number a drive, then one a steering.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.wheeled import Body, Drive, Robot, Wheel
        >>> wheels = [Wheel([0.0, y], radius=0.08, mass=0.5) for y in (-0.2, 0.2)]
        >>> robot = Robot.of(Body(10.0, 0.4), wheels, [Drive((0,)), Drive((1,))])
        >>> robot.arrangement.mobility, robot.arrangement.steerability
        (2, 0)
    """

    bodies: tuple[Body, ...]
    wheels: tuple[Wheel, ...]
    drives: tuple[Drive, ...]
    steerings: tuple[Steering, ...] = ()
    gravity: jax.Array = eqx.field(converter=floats, default_factory=lambda: jnp.asarray(9.81))
    slope: jax.Array = eqx.field(converter=floats, default_factory=lambda: jnp.zeros(2))
    resistance: RollingResistance | None = None
    turn_center: jax.Array = eqx.field(converter=floats, default_factory=lambda: jnp.asarray(0.0))
    arrangement: Arrangement = eqx.field(static=True, default=None)

    def __post_init__(self) -> None:
        _check_numbers_of_parts(self)
        given: Any = self.arrangement
        self.arrangement = arrange(self) if given is None else given

    def __check_init__(self) -> None:
        for name in ("gravity", "turn_center"):
            check_number(self, name)
        if jnp.shape(self.slope) != (2,):
            raise InputError(f"Robot: slope has shape {jnp.shape(self.slope)}, expected (2,)")

    @classmethod
    def of(
        cls,
        bodies: Body | Sequence[Body],
        wheels: Sequence[Wheel],
        drives: Sequence[Drive] = (),
        steerings: Sequence[Steering] = (),
        **others: Any,
    ) -> Robot:
        """A robot of lists of parts; `others` are fields of `Robot`."""
        bodies = (bodies,) if isinstance(bodies, Body) else tuple(bodies)
        return cls(bodies, tuple(wheels), tuple(drives), tuple(steerings), **others)

    def replace(self, **changes: Any) -> Robot:
        """A copy with the given fields changed. If parts are among them, the arrangement is
        computed again, unless numbers are traced."""
        parts = {"bodies", "wheels", "steerings", "turn_center"} & changes.keys()
        known = not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((self, changes)))
        if parts and known and "arrangement" not in changes:
            changes["arrangement"] = None
        return super().replace(**changes)

    @property
    def layout(self) -> Layout:
        """Where coordinates and velocities are."""
        shaft: list[int] = []
        setters: list[int] = []
        named: dict[str | int, int] = {}
        for i, wheel in enumerate(self.wheels):
            name = i if wheel.shaft is None else wheel.shaft
            if name not in named:
                named[name] = len(setters)
                setters.append(i)
            shaft.append(named[name])
        casters = tuple(i for i, wheel in enumerate(self.wheels) if wheel.kind == "caster")
        a = 3 + len(self.bodies) - 1
        b = a + len(self.steerings)
        c = b + len(casters)
        slices = slice(3, a), slice(a, b), slice(b, c), slice(c, c + len(setters))
        return Layout(*slices, tuple(shaft), tuple(setters), casters)

    @property
    def nu(self) -> int:
        """The number of controls."""
        return len(self.drives) + len(self.steerings)


def _check_numbers_of_parts(robot: Robot) -> None:
    """Refuse numbers of bodies and of wheels that are not there, or that are taken twice."""
    n, bodies = len(robot.wheels), len(robot.bodies)
    if not n or not bodies:
        raise InputError(f"Robot: got {bodies} bodies and {n} wheels, expected at least one each")
    for k, body in enumerate(robot.bodies):
        if (body.ahead is None) != (k == 0) or (body.ahead is not None and not body.ahead < k):
            raise InputError(
                f"Robot: bodies[{k}].ahead is {body.ahead}, expected "
                + ("None for the chassis" if k == 0 else f"the number of a body before {k}")
            )
    for i, wheel in enumerate(robot.wheels):
        if not 0 <= wheel.body < bodies:
            raise InputError(f"Robot: wheels[{i}].body is {wheel.body}, expected 0 to {bodies - 1}")
        if wheel.kind == "steered" and wheel.body != 0:
            raise InputError(f"Robot: wheels[{i}] is steered on a trailer, expected on the chassis")
    taken: list[int] = []
    for name, group in (("drives", robot.drives), ("steerings", robot.steerings)):
        taken = []
        for part in group:
            if not all(0 <= i < n for i in part.wheels):
                raise InputError(f"Robot: {name} name wheels {part.wheels}, expected 0 to {n - 1}")
            # several differentials may share wheels: one to drive ahead, one to turn
            taken.extend(part.wheels if name == "steerings" or len(part.wheels) == 1 else ())
        twice = sorted({i for i in taken if taken.count(i) > 1})
        if twice:
            raise InputError(f"Robot: {name} name wheels {twice} twice, expected once")
    steered = sorted(i for i, wheel in enumerate(robot.wheels) if wheel.kind == "steered")
    if sorted(taken) != steered:
        raise InputError(
            f"Robot: the steerings turn wheels {sorted(taken)}, expected those of kind 'steered', "
            f"{steered}"
        )
