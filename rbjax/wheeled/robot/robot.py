"""A wheeled robot: bodies, wheels, drives and steerings.

The frame of a body lies on the ground, with x forward and y to the left. All numeric fields are
pytree leaves: they can be differentiated, mapped over and changed without recompilation.

Coordinates q: the pose (x, y, heading) of the chassis; the angles of trailers relative to the body
ahead, of steerings, of casters, and of shafts. Full velocities w: the twist (vx, vy, turning rate)
of the chassis in its own axes, and the rates of trailers and of shafts. The rates of casters follow
from w; the rates of steerings are inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, instance, real_number
from rbjax.display import Display, array_text, host, plural, value_text
from rbjax.errors import InputError
from rbjax.model.record import Record, check_fields, floats
from rbjax.svg import polygons
from rbjax.wheeled.fields import check_ranges, number
from rbjax.wheeled.robot.arrangement import Arrangement, arrange
from rbjax.wheeled.robot.motors import Motor, TorqueSource
from rbjax.wheeled.tyres.tyre import RollingResistance

KINDS = ("fixed", "steered", "caster", "rollers")


class Body(Record):
    """A chassis, or a trailer behind another body.

    Fields:
        mass: () kg, without the wheels.
        inertia: () kg m^2, about the vertical through `com`, without the wheels.
        com: (2,) m, the centre of mass without the wheels.
        height: () m, height of the centre of mass with the wheels above the ground.
        hitch: (2,) m, the coupling of a trailer, in the frame of the body ahead.
        drawbar: () m, the distance of the coupling ahead of the trailer's origin.
        ahead: static, the index of the body that pulls a trailer; None for a chassis.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.Body(mass=20.0, inertia=0.6, com=[0.05, 0.0]).ahead is None
        True
    """

    mass: jax.Array = number(default=0.0)
    inertia: jax.Array = number(default=0.0)
    com: jax.Array = number(default=(0.0, 0.0))
    height: jax.Array = number(default=0.0)
    hitch: jax.Array = number(default=(0.0, 0.0))
    drawbar: jax.Array = number(default=0.0)
    ahead: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        least = {"mass": 0.0, "inertia": 0.0, "height": 0.0}
        check_ranges(self, pairs=("com", "hitch"), least=least)


class Wheel(Record):
    """A wheel on the ground under a body.

    Kinds: "fixed" has an axle that is fixed in the body. "steered" turns about the vertical through
    its centre. "caster" turns freely about a vertical ahead of its centre. "rollers" has free
    rollers on the rim, as omnidirectional and mecanum wheels.

    Fields:
        position: (2,) m, of the centre; for a caster, of its pivot.
        heading: () rad, the direction in which it rolls at a positive rate, from x to the left; for
            a steered wheel, at zero steering. Not used for a caster.
        radius: () m.
        inertia: () kg m^2, about the axle, of everything that turns with the wheel.
        mass: () kg; for a caster, including its fork.
        yaw_inertia: () kg m^2, about the vertical; for a caster, including its fork and about the
            pivot.
        roller: () rad, the angle of the rollers' axes from the heading to the left: 0 for
            omnidirectional, +-pi/4 for mecanum wheels.
        trail: () m, the distance of a caster's centre behind its pivot.
        behind: () m, the distance of the centre of mass of a caster and fork behind its pivot.
        damping: () N m s/rad, of the axle.
        kind: static, "fixed", "steered", "caster" or "rollers".
        body: static, the index of its body.
        shaft: static, a name; wheels with the same name turn together.
        skids: static, whether it may slide sideways although other wheels may not, as the wheels of
            a skid-steer robot.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.Wheel([0.0, 0.2], radius=0.08).kind
        'fixed'
    """

    position: jax.Array = number()
    heading: jax.Array = number(default=0.0)
    radius: jax.Array = number(default=0.1)
    inertia: jax.Array = number(default=0.0)
    mass: jax.Array = number(default=0.0)
    yaw_inertia: jax.Array = number(default=0.0)
    roller: jax.Array = number(default=0.0)
    trail: jax.Array = number(default=0.05)
    behind: jax.Array = number(default=0.0)
    damping: jax.Array = number(default=0.0)
    kind: str = eqx.field(static=True, default="fixed")
    body: int = eqx.field(static=True, default=0)
    shaft: str | None = eqx.field(static=True, default=None)
    skids: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        least = dict.fromkeys(("inertia", "mass", "yaw_inertia", "damping"), 0.0)
        above = {"radius": 0.0, "trail": 0.0}
        check_ranges(self, pairs=("position",), above=above, least=least)
        choice("kind of wheel", self.kind, KINDS)


class Drive(Record):
    """A motor on one wheel, or on several wheels through a differential.

        torque of wheel i = split_i torque(u, W),     W = sum split_i phi'_i

    u is the control, W the speed of the differential's cage, phi' the rates of the wheels.

    Fields:
        wheels: static, the indices of its k wheels.
        motor: a `Motor`.
        split: (k,), the shares of the torque. For a differential their sum is 1. For one wheel it
            is a gear ratio, negative if motor and wheel turn in opposite directions.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.Drive((0, 1)).split.tolist()
        [0.5, 0.5]
    """

    wheels: tuple[int, ...] = eqx.field(static=True)
    motor: Motor = eqx.field(default_factory=TorqueSource)
    split: Any = None

    def __post_init__(self) -> None:
        indices = isinstance(self.wheels, (tuple, list)) and all(
            isinstance(i, (int, np.integer)) for i in self.wheels
        )
        if not indices or not self.wheels:
            raise InputError(f"Drive: wheels is {self.wheels!r}, expected indices, at least one")
        n = len(self.wheels)
        self.split = floats([1.0 / n] * n if self.split is None else self.split)

    def __check_init__(self) -> None:
        check_fields(self)
        if jnp.shape(self.split) != (len(self.wheels),):
            raise InputError(
                f"Drive: got {len(self.wheels)} wheels and a split of shape "
                f"{jnp.shape(self.split)}, expected one share for each of at least one wheel"
            )
        public = (
            "rbjax.wheeled.TorqueSource(), SpeedServo(gain) or DCMotor(resistance, torque_constant)"
        )
        instance("Drive", "motor", self.motor, Motor, public)


class Steering(Record):
    """One or several steered wheels with one angle b.

    A steering of one wheel turns it by b. A steering of several wheels has Ackermann's geometry: b
    is the angle of a virtual wheel in the middle between them, and all axles meet in one point on
    the axle of the fixed wheels.

        b' = u,                 lag None: u is the rate of steering, rad/s
        b' = (u - b) / lag,     u is the requested angle, rad

    Fields:
        wheels: static, the indices of the steered wheels.
        lag: () s, or None.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.Steering((2, 3)).lag is None
        True
    """

    wheels: tuple[int, ...] = eqx.field(static=True)
    lag: Any = eqx.field(default=None, converter=lambda x: None if x is None else floats(x))

    def __check_init__(self) -> None:
        check_fields(self)
        if not self.wheels:
            raise InputError("Steering: got no wheels, expected the index of at least one")
        if self.lag is not None and not isinstance(self.lag, jax.core.Tracer):
            real_number("Steering", "lag", self.lag, above=0.0)


@dataclass(frozen=True)
class Layout:
    """Slices of coordinates in q and of full velocities in w, and the shafts of wheels."""

    trailers: slice  # of q
    steerings: slice
    casters: slice
    shafts: slice
    shaft: tuple[int, ...]  # the index of the shaft of each wheel
    #: the first wheel of each shaft, whose rolling determines the shaft's rate
    setters: tuple[int, ...]
    caster_wheels: tuple[int, ...]  # the indices of casters

    @property
    def nq(self) -> int:
        return self.shafts.stop

    @property
    def nw(self) -> int:
        """The number of full velocities: three, plus the numbers of trailers and of shafts."""
        return 3 + (self.trailers.stop - self.trailers.start) + len(self.setters)


class Robot(Record):
    """A chassis with wheels, drives and steerings, and optionally trailers.

    The controls u are one number for each drive, then one for each steering.

    Fields:
        bodies: the chassis, then the trailers, each after the body that pulls it.
        wheels, drives, steerings: tuples of parts.
        gravity: () m/s^2.
        slope: (2,), the tangents of the descent of the ground along x and along y.
        resistance: a `RollingResistance` of all wheels, or None.
        turn_center: () m, the x of the axis on which a robot with skidding wheels turns.
        arrangement: static, the motions that the wheels allow.

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
    gravity: jax.Array = number(default=9.81)
    slope: jax.Array = number(default=(0.0, 0.0))
    resistance: RollingResistance | None = None
    turn_center: jax.Array = number(default=0.0)
    arrangement: Arrangement = eqx.field(static=True, default=None)

    def __post_init__(self) -> None:
        _check_indices(self)
        given: Any = self.arrangement
        self.arrangement = arrange(self) if given is None else given

    def __check_init__(self) -> None:
        check_ranges(self, pairs=("slope",))

    @classmethod
    def of(
        cls,
        bodies: Body | Sequence[Body],
        wheels: Sequence[Wheel],
        drives: Sequence[Drive] = (),
        steerings: Sequence[Steering] = (),
        **others: Any,
    ) -> Robot:
        """Make a robot from lists of parts. `others` are further fields of `Robot`."""
        bodies = (bodies,) if isinstance(bodies, Body) else tuple(bodies)
        return cls(bodies, tuple(wheels), tuple(drives), tuple(steerings), **others)

    def replace(self, **changes: Any) -> Robot:
        """Return a copy with the given fields changed. If parts change, the arrangement is computed
        again, unless values are traced."""
        parts = {"bodies", "wheels", "steerings", "turn_center"} & changes.keys()
        known = not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((self, changes)))
        if parts and known and "arrangement" not in changes:
            changes["arrangement"] = None
        return super().replace(**changes)

    def _display_(self) -> Display:
        mobility, steerability = (
            getattr(self.arrangement, n, "?") for n in ("mobility", "steerability")
        )
        parts = [plural(len(self.wheels), "wheel"), plural(len(self.bodies), "body")]
        parts += [plural(len(self.drives), "drive"), plural(len(self.steerings), "steering")]
        title = f"Robot: {', '.join(parts)}; mobility {mobility}, steerability {steerability}"
        drives = [(f"drive {k}", x.wheels) for k, x in enumerate(self.drives)]
        drives += [(f"steering {k}", x.wheels) for k, x in enumerate(self.steerings)]
        rows = []
        for i, x in enumerate(self.wheels):
            moved = [name for name, wheels in drives if i in wheels]
            values = (
                array_text(v, dtype=False) if hasattr(v, "dtype") else value_text(v)
                for v in (x.position, x.heading, x.radius, x.mass)
            )
            rows.append((str(i), x.kind, str(x.body), *values, ", ".join(moved)))
        columns = ("wheel", "kind", "body", "position", "heading", "radius", "mass", "moved by")
        return Display(title, rows, columns, picture=self._picture)

    def _picture(self) -> str:
        """Draw the wheels of the chassis from above."""
        outlines = []
        for x in self.wheels:
            known = [host(v) for v in (x.position, x.heading, x.radius)]
            if any(v is None or v.size > 2 for v in known):
                return ""
            if x.body != 0:
                continue
            at, heading, radius = (np.asarray(v, float) for v in known)
            along = np.array([np.cos(heading), np.sin(heading)]) * radius
            across = 0.3 * np.array([-along[1], along[0]])
            corners = [along + across, along - across, -along - across, -along + across]
            outlines.append(at + np.array(corners))
        box = np.concatenate(outlines)
        (x0, y0), (x1, y1) = box.min(0), box.max(0)
        chassis = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        return polygons([chassis, *outlines], [False, *[True] * len(outlines)])

    @property
    def layout(self) -> Layout:
        """The slices of coordinates and velocities."""
        setters: dict[str | int, int] = {}
        for i, wheel in enumerate(self.wheels):
            setters.setdefault(i if wheel.shaft is None else wheel.shaft, i)
        order = {name: shaft for shaft, name in enumerate(setters)}
        shaft = (order[i if x.shaft is None else x.shaft] for i, x in enumerate(self.wheels))
        casters = tuple(i for i, wheel in enumerate(self.wheels) if wheel.kind == "caster")
        a = 3 + len(self.bodies) - 1
        b = a + len(self.steerings)
        c = b + len(casters)
        slices = slice(3, a), slice(a, b), slice(b, c), slice(c, c + len(setters))
        return Layout(*slices, tuple(shaft), tuple(setters.values()), casters)

    @property
    def nu(self) -> int:
        """The number of controls."""
        return len(self.drives) + len(self.steerings)


def _check_indices(robot: Robot) -> None:
    """Raise `InputError` if indices of bodies or wheels are out of range or occur twice."""
    n, bodies = len(robot.wheels), len(robot.bodies)
    if not n or not bodies:
        raise InputError(f"Robot: got {bodies} bodies and {n} wheels, expected at least one each")
    for k, body in enumerate(robot.bodies):
        if (body.ahead is None) != (k == 0) or (body.ahead is not None and not body.ahead < k):
            raise InputError(
                f"Robot: bodies[{k}].ahead is {body.ahead}, expected "
                + ("None for the chassis" if k == 0 else f"the index of a body before {k}")
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
            f"Robot: the steerings turn wheels {sorted(taken)}, expected all of kind 'steered', "
            f"{steered}"
        )
