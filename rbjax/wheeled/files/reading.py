"""`from_file`: read a wheeled robot from an MJCF or URDF file and the names of its wheel joints.

The robot is in one configuration, in which its wheels are on level ground. A body of the robot is
the composite of the file's bodies on it,

    m = sum m_i,   m c = sum m_i c_i,   I_z = sum I_zi + m_i |c_i - c|^2
minus the masses and inertias of its wheels.
(Featherstone, *Rigid Body Dynamics Algorithms*, 2.13)
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance
from rbjax.errors import InputError, UnsupportedFeature, listed
from rbjax.loading.at_rest import at_rest
from rbjax.wheeled.files.drives import drives_of
from rbjax.wheeled.files.joints import Patterns, Roles, check_upright, roles
from rbjax.wheeled.files.wheels import FileWheel, LeftOut, file_wheels
from rbjax.wheeled.robot.robot import Body, Robot, Steering, Wheel

#: the number of approximations that a message lists
#: smaller lengths, m, and angles, rad, are rounding errors of the file's frames
_ROUNDING = 1e-12


def from_file(
    source: Any,
    wheels: Patterns,
    *,
    steerings: Sequence[str | Sequence[str]] = (),
    casters: Patterns = (),
    trailers: Patterns = (),
    skids: bool | Patterns = False,
    rollers: Mapping[str, float] | None = None,
    drives: Any = None,
    shafts: Mapping[str, Patterns] | None = None,
    radius: float | Mapping[str, float] | None = None,
    lag: float | None = None,
    q: Any = None,
    frame: str | None = None,
    tolerance: float = 0.01,
    strict: bool = False,
) -> Robot:
    """Read a wheeled robot from an MJCF or URDF file and the names of its wheel joints.

    Names are names of hinges, or glob patterns such as "*_wheel". All other joints are locked. The
    ground is level and touches all wheels.

    A wheel's rate, torque, control and angle in q have the sign of its joint. Its heading is the
    direction in which it rolls at a positive rate, so it is pi for a wheel whose axle points to the
    right. A caster's wheel turns at a positive rate if it rolls ahead of its pivot. Angles of
    steerings, trailers and casters are positive to the left for any axis of the file. Angles of
    steerings and trailers are zero in the given configuration. Each wheel's `shaft` is the name of
    its joint.

    Args:
        source: as for `rbjax.load`.
        wheels: hinges of wheels, including the wheels of casters.
        steerings: vertical hinges of steered wheels. A tuple of several is one steering with
            Ackermann's geometry.
        casters: vertical hinges of casters.
        trailers: vertical hinges at which trailers are coupled.
        skids: wheels that may slide sideways, or True for all of a skid-steer robot. It turns on
            the axis through their middle. Steered wheels, casters and rollers do not skid.
        rollers: wheel -> angle of the axes of its free rollers from the heading to the left, rad.
        drives: names of driven wheels; a tuple of names for wheels behind one differential; or a
            mapping of these to motors. None: the file's torque and speed actuators on wheels, or a
            torque on each wheel except casters if there are none.
        shafts: name of a shaft -> the wheels that turn together on it.
        radius: of all wheels or by name, m. None: the largest distance of each wheel's shapes from
            its axle, of collision shapes if there are any.
        lag: of all steerings, s; see `Steering`.
        q: the configuration: None for the file's; a keyframe's name; values of joints by name; or
            (nq,).
        frame: a body or site. Its x axis is forward, and the chassis' frame is on the ground below
            its origin. None: the root body.
        tolerance: the largest angles of axles and steerings from the horizontal and vertical, rad,
            and the largest difference of height, as a fraction of the largest radius.
        strict: whether to raise an error for approximations instead of a warning.

    Returns:
        `Robot`. A warning lists the approximations: wheels that are not balanced about their axles;
        steered wheels whose centre, or centre of mass with the knuckle, is off the axis of the
        steering; friction losses and springs. Ranges of joints, limits of controls and of forces on
        joints, and actuators of steerings are not read.

    Raises:
        ModelError: the source cannot be read.
        UnknownName: no hinge has a given name; the message lists them.
        InputError: a joint that is not a hinge, a steering without its wheel, an axle that leans, a
            wheel without a shape, wheels that are not on one plane, an actuator of another law.
        UnsupportedFeature: with `strict=True`, the list of approximations.

    Example:
        >>> import rbjax as rb
        >>> wheel = '''<body name="%s" pos="0 %s 0.1"><joint name="%s" axis="0 1 0"/>
        ...     <geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="1"/></body>'''
        >>> cart = rb.wheeled.from_file(
        ...     '<mujoco><worldbody><body name="cart"><freejoint/>'
        ...     '<geom type="box" size="0.3 0.2 0.05" pos="0.1 0 0.2" mass="8"/>'
        ...     + wheel % ("l", 0.25, "left") + wheel % ("r", -0.25, "right")
        ...     + "</body></worldbody></mujoco>", ["left", "right"])
        >>> cart.arrangement.mobility, round(float(cart.wheels[0].radius), 3)
        (2, 0.1)
    """
    if not (isinstance(tolerance, (int, float)) and 0 < tolerance < 1):
        raise InputError(f"from_file: tolerance is {tolerance!r}, expected a number from 0 to 1")
    rest = at_rest(source, q)
    named = roles(rest, wheels, steerings, casters, trailers)
    out = LeftOut()
    slanted = _by_wheel(named, "rollers", rollers or {})
    sizes = _by_wheel(named, "radius", radius) if isinstance(radius, Mapping) else radius
    found = file_wheels(named, sizes, slanted, tolerance, out)
    skidding = named.wheels_named("skids", "*" if skids is True else skids or ())
    groups = _mapping("shafts", shafts or {})
    on = {j: x for x, group in groups.items() for j in named.wheels_named("shafts", group)}
    view = view_of(named, found, frame, tolerance)
    bodies = bodies_of(view, found, out)
    made = [
        _wheel(view, w, slanted.get(w.joint, 0.0), w.joint in skidding,
               on.get(w.joint, named.name(w.joint)))
        for w in found
    ]  # fmt: skip
    sliding = [wheel.position[0] for wheel in made if wheel.skids]
    gravity, slope = _gravity(view)
    robot = Robot.of(
        bodies,
        made,
        drives_of(named, found, drives, out),
        [Steering(tuple(map(named.steered, group)), lag) for group in named.steerings],
        gravity=gravity,
        slope=slope,
        turn_center=float(np.mean(sliding)) if sliding else 0.0,
    )
    _check_shafts(robot)
    if out.found:
        text = f"from_file: left out of the robot: {listed(out.found)}"
        if strict:
            raise UnsupportedFeature(f"{text}. Take strict=False to go without.")
        warnings.warn(text, stacklevel=2)
    return jax.tree.map(lambda x: jnp.asarray(x, float), robot)


@dataclass(frozen=True)
class FileFrames:
    """The frames of the chassis and of trailers, with parallel axes."""

    roles: Roles
    origins: tuple[np.ndarray, ...]  # on the ground, in the world
    turn: np.ndarray  # (3, 3), the rotation from their axes to the world's

    def seen(self, point: np.ndarray, k: int) -> np.ndarray:
        """Express a point (3,) of the world in the frame of the chassis (k = 0) or of trailer k."""
        return self.turn.T @ (point - self.origins[k])

    def angle(self, ahead: np.ndarray) -> float:
        """Compute the heading angle of a direction in the world."""
        x, y, _ = self.turn.T @ ahead
        angle = float(np.arctan2(clean(y), x))
        return np.pi if angle == -np.pi else angle


def view_of(
    named: Roles, found: Sequence[FileWheel], frame: str | None, tolerance: float
) -> FileFrames:
    rest = named.rest
    name = rest.body_name(rest.root(named.wheels[0])) if frame is None else frame
    origin, axes = rest.frame(name)
    x, y = axes[:2, 0]
    length = float(np.hypot(x, y))
    if length < 0.5:
        raise InputError(
            f"from_file: the x axis of {name!r} is {np.degrees(np.arccos(length)):.3g} degrees "
            "from the horizontal, expected that it points ahead; give frame, a body or site whose "
            "x axis does"
        )
    c, s = x / length, y / length
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    ground = float(np.mean([w.bottom for w in found]))
    origins = [np.array([*origin[:2], ground])]
    for k, hitch in enumerate(named.hitches, start=1):
        check_upright(named, hitch, "trailer", tolerance)
        places = [w.place for w in found if named.body(w.joint) == k and w.kind != "caster"]
        if not places:
            raise InputError(
                f"from_file: the trailer behind {named.name(hitch)!r} has none of the wheels; name "
                "them, or leave the joint out to hold it"
            )
        # on its axle, straight behind the coupling
        seen, coupling = (turn.T @ p for p in (np.mean(places, 0), rest.anchor(hitch)))
        at = turn @ np.array([seen[0], coupling[1], 0.0])
        origins.append(np.array([*at[:2], ground]))
    return FileFrames(named, tuple(origins), turn)


def bodies_of(view: FileFrames, found: Sequence[FileWheel], out: LeftOut) -> list[Body]:
    """Compute the chassis and the trailers, without the masses and inertias of their wheels."""
    named = view.roles
    rest, made = named.rest, []
    forks = {b for j in named.casters for b in rest.behind(j)}
    for k in range(len(view.origins)):
        own = named.bodies(k)
        whole = rest.composite(own)
        rigid = rest.composite(own - forks)
        mine = [w for w in found if named.body(w.joint) == k]
        less = [w for w in mine if w.kind != "caster"]
        com = view.seen(rigid.com, k)[:2]
        mass = rigid.mass - sum(w.mass for w in less)
        moment = rigid.mass * com - sum(w.mass * view.seen(w.place, k)[:2] for w in less)
        inertia = rigid.inertia[2, 2] + rigid.mass * com @ com
        for w in less:
            p = view.seen(w.place, k)[:2]
            inertia -= w.yaw_inertia + w.mass * p @ p
        centre = moment / mass if mass > 0 else np.zeros(2)
        numbers: dict[str, Any] = {
            "mass": mass, "inertia": inertia - mass * centre @ centre, "com": clean(centre),
            "height": float(view.seen(whole.com, k)[2]),
        }  # fmt: skip
        if k:
            hitch = named.hitches[k - 1]
            out.resisting(named, hitch)
            coupling, ahead = rest.anchor(hitch), named.body(hitch)
            numbers |= {"hitch": clean(view.seen(coupling, ahead)[:2]), "ahead": ahead,
                        "drawbar": float(view.seen(coupling, k)[0])}  # fmt: skip
        made.append(Body(**numbers))
    return made


def clean(x: Any) -> Any:
    """Set values within rounding errors to zero."""
    return np.where(np.abs(x) < _ROUNDING, 0.0, x)


def _by_wheel(named: Roles, what: str, given: Mapping[str, float]) -> dict[int, float]:
    """Convert a mapping by names or patterns of wheels to a mapping by joint indices."""
    pairs = _mapping(what, given).items()
    return {j: value for name, value in pairs for j in named.wheels_named(what, name)}


def _mapping(what: str, given: Any) -> Mapping[str, Any]:
    instance("from_file", what, given, Mapping, "a mapping by names or patterns")
    return given


def _wheel(view: FileFrames, w: FileWheel, roller: float, skids: bool, shaft: str) -> Wheel:
    k = view.roles.body(w.joint)
    same = ("radius", "inertia", "mass", "yaw_inertia", "trail", "behind", "damping")
    numbers: dict[str, Any] = {name: getattr(w, name) for name in same}
    numbers |= {"position": clean(view.seen(w.place, k)[:2]), "roller": roller}
    if w.kind != "caster":
        numbers["heading"] = view.angle(w.ahead)
    skids = skids and w.kind == "fixed"  # steered wheels and rollers do not skid
    return Wheel(**numbers, kind=w.kind, body=k, shaft=shaft, skids=skids)


def _gravity(view: FileFrames) -> tuple[float, np.ndarray]:
    """Compute the magnitude of gravity, and the slope of the ground that is level in the file."""
    g = view.turn.T @ view.roles.rest.gravity
    if g[2] > 0 or (g[2] == 0 and g.any()):
        raise InputError(
            f"from_file: gravity is {view.roles.rest.gravity}, expected that it points down, or 0"
        )
    return float(np.linalg.norm(g)), clean(g[:2] / (-g[2] or 1.0))


def _check_shafts(robot: Robot) -> None:
    """Raise `InputError` if wheels on one shaft turn in opposite directions."""
    for i, shaft in enumerate(robot.layout.shaft):
        first = robot.wheels[robot.layout.setters[shaft]]
        wheel = robot.wheels[i]
        if wheel.kind != "caster" and np.cos(float(wheel.heading - first.heading)) < 0:
            raise InputError(
                f"from_file: wheels {i} and {robot.layout.setters[shaft]} turn on the shaft "
                f"{wheel.shaft!r}, and the axles of their joints point in opposite directions; "
                "turn one in the file, or leave the shaft out"
            )
