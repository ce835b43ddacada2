"""The chassis and the trailers of a robot from a file: their frames, and what they weigh.

A body is the composite of all that is on it,

    m = sum m_i,   m c = sum m_i c_i,   I_z = sum I_zi + m_i |c_i - c|^2
less what `Wheel` counts for itself, so that mass, centre of mass and inertia about the vertical are
the file's. Equations of motion on the ground need no more of them.
(Featherstone, *Rigid Body Dynamics Algorithms*, 2.13)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.errors import InputError
from rbjax.wheeled.files.joints import Roles, check_upright
from rbjax.wheeled.files.wheels import FileWheel, LeftOut
from rbjax.wheeled.robot.robot import Body

#: m, and radians: smaller is rounding of the file's frames
NOTHING = 1e-12


@dataclass(frozen=True)
class View:
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
        angle = float(np.arctan2(clean(y), x))
        return np.pi if angle == -np.pi else angle


def view_of(named: Roles, found: Sequence[FileWheel], frame: str | None, tolerance: float) -> View:
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
    return View(named, tuple(origins), turn)


def bodies_of(view: View, found: Sequence[FileWheel], out: LeftOut) -> list[Body]:
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
    """A number or array without what rounding leaves of zero."""
    return np.where(np.abs(x) < NOTHING, 0.0, x)
