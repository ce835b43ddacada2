"""The joints of a URDF that mimic others: q = offset + multiplier times the other's q."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass

from rbjax.errors import ModelError

_MOVING = ("revolute", "continuous", "prismatic")  # of one coordinate
_USUAL = {"multiplier": 1.0, "offset": 0.0}


@dataclass(frozen=True)
class Mimic:
    """A joint that follows a driver; `held` where that is fixed: then q = offset."""

    joint: str
    driver: str
    held: bool
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Mimics:
    """Those of a file: of joints of one coordinate; and in words of joints of several, which
    cannot."""

    coupled: tuple[Mimic, ...] = ()
    others: tuple[str, ...] = ()

    def left_out(self, *, constraints: bool) -> tuple[str, ...]:
        """What the model has not of them, for `Model.dropped`."""
        named = () if constraints else tuple(f"{x.joint} of {x.driver}" for x in self.coupled)
        names = ", ".join((*named, *self.others))
        return (f"mimic joints, which move on their own ({names})",) if names else ()


def take_mimics(robot: ET.Element, name: str) -> Mimics:
    """The mimics of a robot, of which no joint has one afterwards. A fixed joint has nothing to
    mimic with."""
    kinds = {joint.get("name", ""): joint.get("type", "") for joint in robot.findall("joint")}
    found, others = [], []
    for joint in robot.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
            own, driver = joint.get("name", ""), mimic.get("joint", "")
            if driver not in kinds or driver == own:
                raise ModelError(
                    f"{name}: joint {own!r} mimics {driver!r}, expected another one of the joints "
                    f"{', '.join(sorted(kinds))}"
                )
            numbers = [_number(mimic, key, x, own, name) for key, x in _USUAL.items()]
            pair = kinds[own], kinds[driver]
            if pair[0] in _MOVING and pair[1] in (*_MOVING, "fixed"):
                found.append(Mimic(own, driver, pair[1] == "fixed", *numbers))
            elif pair[0] != "fixed":
                others.append(f"{own} of {driver}")
    return Mimics(tuple(found), tuple(others))


def _number(mimic: ET.Element, key: str, usual: float, joint: str, name: str) -> float:
    text = mimic.get(key, str(usual))
    try:
        x = float(text)
    except ValueError:
        x = math.nan
    if not math.isfinite(x):
        raise ModelError(
            f"{name}: joint {joint!r} mimics with the {key} {text!r}, expected a finite number"
        )
    return x
