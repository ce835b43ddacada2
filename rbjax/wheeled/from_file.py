"""A wheeled robot from a robot file: MJCF or URDF, with the names of its wheels' joints.

The file is held at one configuration, at which its wheels stand on level ground. Chassis and
trailers are the composite bodies of all that does not turn with a wheel:

    m = sum m_i,   m c = sum m_i c_i,   I_z = sum I_zi + m_i |c_i - c|^2
less what `Wheel` counts for itself, so that mass, centre of mass and inertia about the vertical are
those of the file. Equations of motion on the ground need no more of them.
(Featherstone, *Rigid Body Dynamics Algorithms*, 2.13; Olguín Díaz, *3D Motion of Rigid Bodies*,
ch. 8)
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnsupportedFeature, listed
from rbjax.loading.at_rest import at_rest
from rbjax.wheeled.file_drives import drives_of
from rbjax.wheeled.file_joints import Patterns, Roles, check_upright, hinges, roles
from rbjax.wheeled.file_wheels import FileWheel, LeftOut, file_wheels
from rbjax.wheeled.parts import Body, Steering, Wheel
from rbjax.wheeled.robot import Robot

_SHOWN = 12  # of what is left out
#: m, and radians: smaller is rounding of the file's frames
_NOTHING = 1e-12


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
    """A wheeled robot from an MJCF or URDF file whose wheel joints are named.

    Names are those of hinges of the file, or glob patterns such as "*_wheel". All joints that are
    not named are held. The ground is level and touches all wheels.

    Signs are the file's: a wheel's rate, the torque on it, the control of its drive and its angle
    in q are those of its joint. Its heading is where it rolls at a positive rate, so it is pi for a
    wheel whose axle points to the right. Angles of steerings, trailers and casters are positive to
    the left whatever the file's axis; those of steerings and trailers are zero at the configuration
    that is held. Each wheel's `shaft` is the name of its joint.

    Args:
        source: what `rbjax.load` takes.
        wheels: hinges of wheels, those of casters with them.
        steerings: vertical hinges of steered wheels; a tuple of several is one steering with
            Ackermann's geometry.
        casters: vertical hinges of casters.
        trailers: vertical hinges at which trailers are coupled.
        skids: wheels that may slide sideways, or True for all of a skid-steer robot. It turns on
            the axis through their middle.
        rollers: wheels of free rollers, with the angle of the rollers' axes from the heading to the
            left, rad.
        drives: what turns the wheels: names; a tuple of names for wheels behind one differential;
            or a mapping of these to motors. None: the file's torque and speed actuators on wheels;
            if it has none, a torque on each wheel that is no caster's.
        shafts: names of shafts, with the wheels that turn together on each.
        radius: m, of all wheels or by name. None: the farthest point from the axle of each wheel's
            shapes, collision shapes if there are any.
        lag: s, of all steerings, see `Steering`.
        q: the configuration: None, that of the file; a keyframe's name; values of joints by name;
            or (nq,).
        frame: a body or site whose x axis is ahead, and above whose origin the chassis' frame lies
            on the ground. None: the body on which all else hangs.
        tolerance: angles in rad, and heights as parts of the largest radius, up to which the ground
            is level, axles lie and steerings stand.
        strict: raise instead of warning about what the robot leaves out of the file.

    Returns:
        `Robot`. What it cannot have and approximates is listed in a warning: wheels that are not
        even about their axles; steered wheels whose centre, or centre of mass with the knuckle, is
        off the axis of the steering; friction losses and springs. Not taken: ranges of joints,
        limits of controls, actuators of steerings.

    Raises:
        ModelError: the source cannot be read.
        UnknownName: no hinge has a name; the message lists them.
        InputError: a joint that is no hinge, a steering without its wheel, an axle that leans, a
            wheel without a shape, wheels that do not stand on one plane, an actuator without a law
            here.
        UnsupportedFeature: with `strict=True`, the list of what would be left out.

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
    rest = at_rest(source, q)
    named = roles(rest, wheels, steerings, casters, trailers)
    out = LeftOut()
    slanted = _by_wheel(named, "rollers", {} if rollers is None else rollers)
    sizes = _by_wheel(named, "radius", radius) if isinstance(radius, Mapping) else radius
    found = file_wheels(named, sizes, slanted, tolerance, out)
    if skids is True:
        skidding = list(named.wheels)
    else:
        skidding = hinges(rest, "skids", skids or ())
    on = {
        j: shaft
        for shaft, group in ({} if shafts is None else shafts).items()
        for j in hinges(rest, "shafts", group)
    }
    view = _view(named, found, frame, tolerance)
    bodies = _bodies(view, found, out)
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
        text = f"from_file: left out of the robot: {listed(out.found, _SHOWN)}"
        if strict:
            raise UnsupportedFeature(f"{text}. Take strict=False to go without.")
        warnings.warn(text, stacklevel=2)
    return jax.tree.map(lambda x: jnp.asarray(x, float), robot)


def _by_wheel(named: Roles, what: str, given: Mapping[str, float]) -> dict[int, float]:
    """Numbers by joints, of numbers by names."""
    return {j: value for name, value in given.items() for j in hinges(named.rest, what, name)}


@dataclass(frozen=True)
class _View:
    """The frames of the chassis and of trailers, their axes parallel: origins (3,) on the ground,
    turn (3, 3) from their axes to the world's; hitch, the places of couplings."""

    roles: Roles
    origins: tuple[np.ndarray, ...]
    turn: np.ndarray

    def seen(self, point: np.ndarray, k: int) -> np.ndarray:
        """A point of the world in the frame of a body."""
        return self.turn.T @ (point - self.origins[k])

    def angle(self, ahead: np.ndarray) -> float:
        """The heading of a direction."""
        x, y, _ = self.turn.T @ ahead
        angle = float(np.arctan2(_clean(y), x))
        return np.pi if angle == -np.pi else angle


def _view(named: Roles, found: Sequence[FileWheel], frame: str | None, tolerance: float) -> _View:
    rest = named.rest
    name = rest.body_name(rest.root(named.wheels[0])) if frame is None else frame
    origin, axes = rest.frame(name)
    x, y = axes[:2, 0]
    length = float(np.hypot(x, y))
    if length < 0.5:
        raise InputError(
            f"from_file: the x axis of {name!r} is {np.degrees(np.arccos(length)):.3g} degrees from "
            "the horizontal, expected that it points ahead; give frame, a body or site whose x "
            "axis does"
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
    return _View(named, tuple(origins), turn)


def _bodies(view: _View, found: Sequence[FileWheel], out: LeftOut) -> list[Body]:
    """The chassis and the trailers, less what their wheels count."""
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
        numbers: dict[str, Any] = {}
        if k:
            hitch = named.hitches[k - 1]
            coupling, ahead = rest.anchor(hitch), named.body(hitch)
            for what in ("damping", *rest.resisting(hitch)):
                if what != "damping" or rest.damping(hitch):
                    out.found.append(f"{named.name(hitch)}: {what}")
            numbers = {"hitch": _clean(view.seen(coupling, ahead)[:2]), "ahead": ahead,
                       "drawbar": float(view.seen(coupling, k)[0])}  # fmt: skip
        height = float(view.seen(whole.com, k)[2])
        made.append(Body(mass, inertia - mass * centre @ centre, _clean(centre), height, **numbers))
    return made


def _wheel(view: _View, w: FileWheel, roller: float, skids: bool, shaft: str) -> Wheel:
    k = view.roles.body(w.joint)
    return Wheel(
        _clean(view.seen(w.place, k)[:2]), 0.0 if w.kind == "caster" else view.angle(w.ahead),
        w.radius, w.inertia, w.mass, w.yaw_inertia, roller, w.trail, w.damping,
        kind=w.kind, body=k, shaft=shaft, skids=skids and w.kind == "fixed",
    )  # fmt: skip


def _gravity(view: _View) -> tuple[float, np.ndarray]:
    """Its size, and the slope on which the level ground of the file is."""
    g = view.turn.T @ view.roles.rest.gravity
    if g[2] > 0 or (g[2] == 0 and g.any()):
        raise InputError(
            f"from_file: gravity is {view.roles.rest.gravity}, expected that it points down, or 0"
        )
    return float(np.linalg.norm(g)), _clean(g[:2] / (-g[2] or 1.0))


def _check_shafts(robot: Robot) -> None:
    """Refuse wheels that turn together in opposite directions."""
    for i, shaft in enumerate(robot.layout.shaft):
        first = robot.wheels[robot.layout.setters[shaft]]
        wheel = robot.wheels[i]
        if wheel.kind != "caster" and np.cos(float(wheel.heading - first.heading)) < 0:
            raise InputError(
                f"from_file: wheels {i} and {robot.layout.setters[shaft]} turn on the shaft "
                f"{wheel.shaft!r}, and the axles of their joints point in opposite directions; "
                "turn one in the file, or leave the shaft out"
            )


def _clean(x: Any) -> Any:
    """A number or array without what rounding leaves of zero."""
    return np.where(np.abs(x) < _NOTHING, 0.0, x)
