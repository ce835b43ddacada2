"""The wheels of a robot file: positions, radii, inertias.

The heading of a wheel is a x z, with a along its axle and z up. The position of a steered wheel is
on the axis of its steering, and its mass includes all bodies that turn with it. The position of a
caster is on the axis of its pivot, and its mass includes the fork.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rbjax.errors import InputError
from rbjax.loading.at_rest import AtRest, Composite, Round
from rbjax.wheeled.files.joints import Roles, check_upright

UP = np.array([0.0, 0.0, 1.0])
#: relative differences below this are rounding errors of the file
ROUNDING = 1e-6


@dataclass(frozen=True)
class FileWheel:
    """A wheel of a file in world axes, in m and kg. Other fields are as in `Wheel`."""

    joint: int  # the index of its hinge
    kind: str
    place: np.ndarray  # (3,), its position at the height of the axle
    ahead: np.ndarray  # (3,), the heading, or the direction in which a caster rolls
    radius: float
    inertia: float
    mass: float
    yaw_inertia: float
    damping: float
    trail: float = 0.05
    behind: float = 0.0
    sense: float = 1.0  # -1 for a caster that rolls ahead at negative rates of its joint, else 1

    @property
    def bottom(self) -> float:
        return float(self.place[2]) - self.radius


@dataclass
class LeftOut:
    """Descriptions of the features of a file that the robot does not have."""

    found: list[str] = field(default_factory=list)

    def add(self, what: str, size: float, scale: float, unit: str = "mm") -> None:
        """Add a note about a feature if its size exceeds rounding errors."""
        if abs(size) > ROUNDING * scale:
            factor = {"mm": 1e3, "": 1.0, "degrees": np.degrees(1.0)}[unit]
            self.found.append(f"{what} {abs(size) * factor:.3g} {unit}".rstrip())

    def resisting(self, roles: Roles, j: int, *, damps: bool = False) -> None:
        """Add notes of the friction and springs of a hinge, and of its damping unless `damps`."""
        if roles.rest.damping(j) and not damps:
            self.found.append(f"{roles.name(j)}: damping")
        self.found += [f"{roles.name(j)}: {what}" for what in roles.rest.resisting(j)]


def file_wheels(
    roles: Roles, radius: Any, rollers: Mapping[int, float], tolerance: float, out: LeftOut
) -> list[FileWheel]:
    """Read all wheels.

    radius: for all wheels, or by joint. rollers: joint -> angle of the rollers.

    Raises:
        InputError: a wheel without a shape, that leans, or that is not on one plane with the rest.
    """
    shapes = roles.rest.round_shapes(roles.wheels)
    wheels = [
        _wheel(roles, j, _size(roles, j, shape, radius), rollers, tolerance, out)
        for j, shape in zip(roles.wheels, shapes, strict=True)
    ]
    lowest = min(w.bottom for w in wheels)
    height = max(w.bottom for w in wheels) - lowest
    largest = max(w.radius for w in wheels)
    if height > tolerance * largest:
        above = ", ".join(
            f"{roles.name(w.joint)} {1e3 * (w.bottom - lowest):.3g} mm" for w in wheels
        )
        raise InputError(
            f"from_file: the wheels do not stand on one level ground: their lowest points are "
            f"above the lowest by {above}, expected at most {1e3 * tolerance * largest:.3g} mm; "
            "hold other joints with q, give radius, or raise the tolerance"
        )
    out.add("wheels at heights that differ by", height, largest)
    return wheels


def _wheel(
    roles: Roles, j: int, shape: Round, rollers: Mapping[int, float], tolerance: float,
    out: LeftOut,
) -> FileWheel:  # fmt: skip
    rest, name, (size, centre) = roles.rest, roles.name(j), shape
    axle = rest.axis(j)
    if abs(axle[2]) > tolerance:
        raise InputError(
            f"from_file: the axle of wheel {name!r} leans {np.degrees(np.arcsin(abs(axle[2]))):.3g}"
            f" degrees from the horizontal, expected at most {np.degrees(tolerance):.3g}; hold the "
            "robot upright with q, or raise the tolerance"
        )
    out.add(f"{name}: an axle that leans by", axle[2], 1.0, "degrees")
    ahead = np.cross(axle, UP)
    ahead /= np.linalg.norm(ahead)
    own = rest.composite(rest.behind(j))
    _note_unbalance(name, own, rest, j, size, out)
    out.resisting(roles, j, damps=True)
    inertia = own.about(axle, rest.anchor(j)) + rest.armature(j)
    numbers = {"radius": size, "inertia": inertia, "damping": rest.damping(j)}
    table = roles.turntable(j)
    if table is None:
        kind = "rollers" if j in rollers else "fixed"
        return FileWheel(j, kind, centre, ahead, mass=own.mass,
                         yaw_inertia=own.about(UP, centre), **numbers)  # fmt: skip
    if j in rollers:
        raise InputError(f"from_file: wheel {name!r} has rollers and is steered, expected one")
    if table in roles.casters:
        return _caster(roles, j, table, ahead, centre, numbers, tolerance, out)
    return _steered(roles, j, table, ahead, centre, numbers, tolerance, out)


def _steered(
    roles: Roles, j: int, table: int, ahead: np.ndarray, centre: np.ndarray,
    numbers: dict[str, float], tolerance: float, out: LeftOut,
) -> FileWheel:  # fmt: skip
    """Read a steered wheel."""
    place, whole = _pivot(roles, table, "steering", centre, tolerance, out)
    size, name = numbers["radius"], roles.name(table)
    off = _off(centre, place, UP)
    out.add(f"{roles.name(j)}: a centre off the axis of {name} by", off, size)
    out.add(f"{name}: a centre of mass off its axis by", _off(whole.com, place, UP), size)
    return FileWheel(j, "steered", place, ahead, mass=whole.mass,
                     yaw_inertia=whole.about(UP, place), **numbers)  # fmt: skip


def _caster(
    roles: Roles, j: int, table: int, ahead: np.ndarray, centre: np.ndarray,
    numbers: dict[str, float], tolerance: float, out: LeftOut,
) -> FileWheel:  # fmt: skip
    """Read a caster."""
    place, whole = _pivot(roles, table, "caster", centre, tolerance, out)
    size, name = numbers["radius"], roles.name(table)
    out.resisting(roles, table)
    sense = -1.0 if ahead @ (centre - place) > 0 else 1.0
    ahead = sense * ahead
    side = np.cross(UP, ahead)
    trail, aside = float(ahead @ (place - centre)), float(side @ (centre - place))
    if trail <= ROUNDING * size:
        raise InputError(
            f"from_file: the wheel of caster {name!r} has its centre {1e3 * trail:.3g} mm behind "
            "the pivot, expected above zero; is it a steering?"
        )
    if abs(aside) > tolerance * size:
        raise InputError(
            f"from_file: the wheel of caster {name!r} is {1e3 * abs(aside):.3g} mm to the side of "
            f"its pivot, expected at most {1e3 * tolerance * size:.3g} mm; raise the tolerance"
        )
    out.add(f"{name}: a wheel off its pivot to the side by", aside, size)
    out.add(
        f"{name}: a centre of mass off its pivot by",
        side @ (whole.com - place),
        size,
    )
    return FileWheel(j, "caster", place, ahead, mass=whole.mass,
                     yaw_inertia=whole.about(UP, place), trail=trail,
                     behind=float(ahead @ (place - whole.com)), sense=sense, **numbers)  # fmt: skip


def _pivot(
    roles: Roles, table: int, what: str, centre: np.ndarray, tolerance: float, out: LeftOut
) -> tuple[np.ndarray, Composite]:
    """Return the position of a steering or caster at its wheel's height, and the body that it
    turns."""
    leaning = check_upright(roles, table, what, tolerance)
    out.add(f"{roles.name(table)}: an axis that leans by", leaning, 1.0, "degrees")
    place = roles.rest.anchor(table)
    place[2] = centre[2]
    return place, roles.rest.composite(roles.rest.behind(table))


def _size(roles: Roles, j: int, found: Round | None, radius: Any) -> Round:
    """Return the radius of a wheel and its centre on the axle.

    The radius is the given one. If none is given, it is the radius of the wheel's shape.
    """
    given = radius.get(j) if isinstance(radius, Mapping) else radius
    if given is not None:
        if not (isinstance(given, (int, float)) and 0 < given < np.inf):
            raise InputError(f"from_file: radius is {given!r}, expected a length above zero, m")
        return Round(float(given), roles.rest.anchor(j) if found is None else found.centre)
    if found is None:
        name = roles.name(j)
        raise InputError(
            f"from_file: wheel {name!r} has no shape in the file that shows its radius: no "
            f"cylinder, sphere, capsule, ellipsoid or readable mesh; give radius={{{name!r}: ...}}"
        )
    return found


def _note_unbalance(
    name: str, own: Composite, rest: AtRest, j: int, size: float, out: LeftOut
) -> None:
    axle = rest.axis(j)
    out.add(f"{name}: a centre of mass off the axle by", _off(own.com, rest.anchor(j), axle), size)
    along = float(axle @ own.inertia @ axle)
    across = 0.5 * (np.trace(own.inertia) - along)
    # a body of revolution about the axle has this inertia
    even = across * np.eye(3) + (along - across) * np.outer(axle, axle)
    uneven = np.abs(own.inertia - even).max()
    scale = max(np.abs(own.inertia).max(), 1e-300)
    out.add(f"{name}: an inertia that is not even about the axle, by a part of", uneven / scale,
            1.0, "")  # fmt: skip


def _off(point: np.ndarray, anchor: np.ndarray, axis: np.ndarray) -> float:
    """Compute the distance of a point from the line through an anchor along an axis."""
    return float(np.linalg.norm(np.cross(axis, point - anchor)))
