"""Fields of a compiled MuJoCo model: names, flags, numbers as leaves; MuJoCo's error messages."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

#: the flags by which a file switches features off
Off = mujoco.mjtDisableBit


def members(enum: Any) -> SimpleNamespace:
    """The members of an enumeration as integers, without their prefix."""
    return SimpleNamespace(**{n.split("_")[1]: int(x) for n, x in enum.__members__.items()})


def is_on(m: mujoco.MjModel, *flags: mujoco.mjtDisableBit) -> bool:
    """Whether the file switches none of these features off."""
    return not any(m.opt.disableflags & int(flag) for flag in flags)


def names_of(m: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> tuple[str, ...]:
    """The names of joints, bodies, ...; one without a name is named by its index, as joint0."""
    return tuple(
        mujoco.mj_id2name(m, kind, i) or f"{kind.name[6:].lower()}{i}" for i in range(count)
    )


def leaf(x: Any) -> jax.Array:
    """Numbers as a leaf of a model."""
    return jnp.asarray(np.asarray(x, np.float64))


#: part of a message of MuJoCo -> the fix
_FIXES = {
    "mass and inertia of moving bodies": "give the body an <inertial> with positive mass and "
    "inertia, or weld it (no joint, URDF type='fixed')",
    "A + B >= C": "correct the inertia, or let MuJoCo balance it: "
    "<compiler balanceinertia='true'/>",
    "repeated name": "give each body, joint or other element a name of its own",
    "opening file": "put the file where the model names it, or remove the element",
    "free joint can only be used on top": "put the body into <worldbody>, or give it three slides "
    "and a ball",
    "joint found in world body": "the world cannot move: put the joint into a <body>",
    "inertia must have positive eigenvalues": "give every principal moment a positive value",
}


def message_of(error: Exception) -> str:
    """The message of an error of MuJoCo in one line, with the fix if it is known."""
    message = " ".join(str(error).split())
    fix = next((f"; {fix}" for key, fix in _FIXES.items() if key in message), "")
    return message + fix
