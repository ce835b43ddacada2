"""What a wheeled robot is made of: bodies, wheels, drives and steerings.

A body's frame lies on the ground, x ahead and y to the left. All numbers are leaves: they can be
differentiated, vmapped over and changed with no recompilation.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_number
from rbjax.errors import InputError, UnknownName
from rbjax.model.record import Record, check_fields, check_number, floats
from rbjax.wheeled.robot.motors import Motor, TorqueSource
from rbjax.wheeled.tyres.tyre import check_at_least

KINDS = ("fixed", "steered", "caster", "rollers")


def _number(default: float = 0.0) -> Any:
    return eqx.field(converter=floats, default_factory=lambda: jnp.asarray(float(default)))


def _pair() -> Any:
    return eqx.field(converter=floats, default_factory=lambda: jnp.zeros(2))


class Body(Record):
    """A chassis, or a trailer behind another body.

    Fields: mass, kg, and inertia, kg m^2, about the vertical through com, without the wheels; com
    (2,) m, the centre of mass; height, m, that of the centre of mass with the wheels above the
    ground. Of a trailer: hitch (2,) m, where it is coupled, in the frame of the body ahead;
    drawbar, m, how far ahead of its own origin that is; ahead, static, the number of that body.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.Body(mass=20.0, inertia=0.6, com=[0.05, 0.0]).ahead is None
        True
    """

    mass: jax.Array = _number()
    inertia: jax.Array = _number()
    com: jax.Array = _pair()
    height: jax.Array = _number()
    hitch: jax.Array = _pair()
    drawbar: jax.Array = _number()
    ahead: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        for name in ("mass", "inertia", "height", "drawbar"):
            check_number(self, name)
        check_at_least(self, mass=0.0, inertia=0.0, height=0.0)
        _pairs(self, "com", "hitch")


class Wheel(Record):
    """A wheel on the ground under a body.

    Kinds: "fixed", its axle fixed in the body; "steered", it turns about the vertical through its
    centre; "caster", it turns freely about a vertical ahead of its centre; "rollers", its rim has
    free rollers, as that of omnidirectional and mecanum wheels.

    Fields: position (2,) m, of the centre, of a caster's pivot; heading, rad, the direction where
    it rolls at a positive rate, from x to the left (of a steered wheel at zero steering; not used
    by a caster); radius m; inertia, kg m^2, about the axle, with all that turns with it; mass kg;
    yaw_inertia, kg m^2, about the vertical; roller, rad, the angle of the rollers' axes from the
    heading to the left (0 omnidirectional, +-pi/4 mecanum); trail, m, how far a caster's centre is
    behind its pivot;
    behind, m, how far its centre of mass with the fork is; damping, N m s/rad, of its axle, a
    torque against its rate. mass and yaw_inertia of a caster are those with its fork, the inertia
    about its pivot.
    Static: kind; body, the number of its body; shaft, a name that wheels which turn together share;
    skids, whether it may slide sideways where the others may not, as those of a skid-steer robot.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.Wheel([0.0, 0.2], radius=0.08).kind
        'fixed'
    """

    position: jax.Array = eqx.field(converter=floats)
    heading: jax.Array = _number()
    radius: jax.Array = _number(0.1)
    inertia: jax.Array = _number()
    mass: jax.Array = _number()
    yaw_inertia: jax.Array = _number()
    roller: jax.Array = _number()
    trail: jax.Array = _number(0.05)
    behind: jax.Array = _number()
    damping: jax.Array = _number()
    kind: str = eqx.field(static=True, default="fixed")
    body: int = eqx.field(static=True, default=0)
    shaft: str | None = eqx.field(static=True, default=None)
    skids: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        _pairs(self, "position")
        for name in ("heading", "inertia", "mass", "yaw_inertia", "roller", "behind", "damping"):
            check_number(self, name)
        check_number(self, "radius", positive=True)
        check_number(self, "trail", positive=True)
        check_at_least(self, inertia=0.0, mass=0.0, yaw_inertia=0.0, damping=0.0)
        if self.kind not in KINDS:
            raise UnknownName("kind of wheel", self.kind, KINDS)


class Drive(Record):
    """A motor on one wheel, or through a differential on several.

        torque of wheel i = split_i torque(u, W),     W = sum split_i phi'_i

    u is the control, W the speed of the differential's cage, phi' that of the wheels.

    Fields: motor, a `Motor`; split (k,), shares of the torque, 1 in sum behind a differential; of
    one wheel a gear ratio, negative where motor and wheel turn in opposite directions. Static:
    wheels, their k numbers.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.Drive((0, 1)).split.tolist()
        [0.5, 0.5]
    """

    wheels: tuple[int, ...] = eqx.field(static=True)
    motor: Motor = eqx.field(default_factory=TorqueSource)
    split: Any = None

    def __post_init__(self) -> None:
        numbers = isinstance(self.wheels, (tuple, list)) and all(
            isinstance(i, (int, np.integer)) for i in self.wheels
        )
        if not numbers or not self.wheels:
            raise InputError(f"Drive: wheels is {self.wheels!r}, expected indices, at least one")
        n = len(self.wheels)
        self.split = floats([1.0 / n] * n if self.split is None else self.split)

    def __check_init__(self) -> None:
        check_fields(self)
        if jnp.shape(self.split) != (len(self.wheels),) or not self.wheels:
            raise InputError(
                f"Drive: got {len(self.wheels)} wheels and a split of shape "
                f"{jnp.shape(self.split)}, expected one share for each of at least one wheel"
            )
        if not isinstance(self.motor, Motor):
            raise InputError(
                f"Drive: motor is {type(self.motor).__name__}, expected "
                "rbjax.wheeled.TorqueSource(), SpeedServo(gain) or DCMotor(resistance, "
                "torque_constant)"
            )


class Steering(Record):
    """One or several steered wheels with one angle b.

    A steering of one wheel turns it by b. One of several wheels has Ackermann's geometry: b is the
    angle of a wheel in the middle between them, and all axles meet in one point on the axle of the
    fixed wheels.

        b' = u,                 lag None: u is the rate of steering, rad/s
        b' = (u - b) / lag,     u is the angle that is asked for, rad

    Fields: lag, s, or None. Static: wheels, the numbers of the steered wheels.

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
            raise InputError("Steering: got no wheels, expected the numbers of at least one")
        if self.lag is not None and not isinstance(self.lag, jax.core.Tracer):
            real_number("Steering", "lag", self.lag, above=0.0)


def _pairs(record: Record, *names: str) -> None:
    check_fields(record)
    for name in names:
        if jnp.shape(getattr(record, name)) != (2,):
            raise InputError(
                f"{type(record).__name__}({name}=...): got shape "
                f"{jnp.shape(getattr(record, name))}, expected (2,), x and y in m"
            )
