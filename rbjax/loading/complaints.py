"""What MuJoCo's parser and compiler complain of, and what to do about it."""

from __future__ import annotations


def sentence(error: Exception) -> str:
    """What MuJoCo says, in one line."""
    return " ".join(str(error).split())


def fix_of(message: str) -> str:
    """The fix of what it says, to append; empty where none is known."""
    hints = {
        "mass and inertia of moving bodies": "; give the body an <inertial> with positive mass and "
        "inertia, or weld it (no joint, URDF type='fixed')",
        "A + B >= C": "; correct the inertia, or let MuJoCo balance it: "
        "<compiler balanceinertia='true'/>",
        "repeated name": "; give each body, joint or other element a name of its own",
        "opening file": "; put the file where the model names it, or remove the element",
        "free joint can only be used on top": "; put the body into <worldbody>, or give it three "
        "slides and a ball",
        "joint found in world body": "; the world cannot move: put the joint into a <body>",
        "inertia must have positive eigenvalues": "; give every principal moment a positive value",
    }
    return next((fix for key, fix in hints.items() if key in message), "")
