"""Checks of the arguments of `ModelBuilder`: names, numbers and attributes of MuJoCo's elements."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import mujoco
import numpy as np

from rbjax.arguments import choice, flag, instance, integer, real_array, real_number
from rbjax.errors import InputError

#: attributes that cannot be negative
NOT_NEGATIVE = ("adhesion", "density", "friction", "mass", "solmix")
#: attributes of a geom that `ModelBuilder.add_geom` has as arguments, or that are not numbers
OTHERS = ("alt", "classname", "compiler", "frame", "fromto", "id", "info", "name", "parent",
          "plugin", "pos", "quat", "signature", "size", "type", "typeinertia",
          "userdata")  # fmt: skip


def new_name(where: str, kind: str, name: Any, elements: Sequence[Any]) -> str:
    """Return the name of a new element. Raise InputError if it is not a word, or taken."""
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: name is {name!r}, expected a word")
    if name in [x.name for x in elements]:
        raise InputError(f"{where}: {name!r} is the name of another {kind}, expected a new name")
    return name


def vector(where: str, name: str, value: Any, size: int) -> np.ndarray:
    """Convert a value to an array (size,) of finite numbers, or raise InputError."""
    found = real_array(where, name, value, f"({size},) numbers", ndim=1)
    if found.size != size:
        raise InputError(f"{where}: {name} has {found.size} numbers, expected {size}")
    return found


def pose(where: str, position: Any, orientation: Any) -> dict[str, np.ndarray]:
    """Return MuJoCo's pos and quat of a position (3,) and a quaternion (4,)."""
    quat = vector(where, "orientation", orientation, 4)
    if not np.linalg.norm(quat) > 0:
        raise InputError(
            f"{where}: orientation is a zero quaternion, expected a unit one (w, x, y, z); no "
            "rotation is (1, 0, 0, 0)"
        )
    return {"pos": vector(where, "position", position, 3), "quat": quat}


def limits(where: str, name: str, value: Any) -> np.ndarray:
    """Return the lower and the upper limit (2,), the lower one below the upper one."""
    low, high = found = vector(where, name, value, 2)
    if not low < high:
        raise InputError(
            f"{where}: {name} is {found.tolist()}, expected a lower limit below the upper one; "
            f"leave {name} out for no limits"
        )
    return found


def attributes(where: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a geom by name, in the types of MuJoCo.

    Raises:
        UnknownName: no such attribute. InputError: a value of another type, size or sign.
    """
    known = defaults()
    return {key: of_type(where, key, x, known[choice("attribute of a geom", key, known)])
            for key, x in given.items()}  # fmt: skip


@cache
def defaults() -> dict[str, Any]:
    """Return the attributes of MuJoCo's geom by name, with its default values."""
    geom = mujoco.MjSpec().worldbody.add_geom()
    names = [n for n in dir(geom) if not n.startswith("_") and n not in OTHERS]
    found = {n: getattr(geom, n) for n in names}
    return {n: np.array(x) if isinstance(x, np.ndarray) else x for n, x in found.items()
            if not callable(x)}  # fmt: skip


def of_type(where: str, name: str, value: Any, default: Any) -> Any:
    """Convert a value to the type of a default value."""
    if isinstance(default, bool):
        return flag(where, name, value)
    if isinstance(default, int):
        return integer(where, name, value, least=-(2**31), most=2**31 - 1)
    if isinstance(default, str):
        instance(where, name, value, str, "a name")
        return value
    positive = name in NOT_NEGATIVE
    if not isinstance(default, np.ndarray):
        return real_number(where, name, value, least=0.0 if positive else -math.inf)
    found = vector(where, name, value, default.size)
    if positive and (found < 0).any():
        raise InputError(f"{where}: {name} is {found.tolist()}, expected numbers of at least 0")
    return found


def found_by_name(find: Callable[[str], Any], name: Any) -> Any:
    """Return the element of a name, or None."""
    return find(name) if isinstance(name, str) else None
