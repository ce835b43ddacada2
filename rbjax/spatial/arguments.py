"""Argument checks of the spatial functions: those of the rotations, and positive numbers."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax

from rbjax.arguments import real_array
from rbjax.errors import InputError
from rbjax.lanes import Mat3, Vec3
from rbjax.rotations.arguments import checked, entries, stacked, takes
from rbjax.spatial.vectors import Force, Motion

__all__ = ["checked", "force", "motion", "stacked", "pose_parts", "positive", "takes", "entries"]


def positive(*names: str) -> Callable[[Callable], Callable]:
    """Decorate a function whose named arguments must be numbers above zero, if they are known."""

    def decorate(f: Callable) -> Callable:
        signature = inspect.signature(f)

        @functools.wraps(f)
        def call(*args: Any, **kwargs: Any) -> Any:
            bound = signature.bind(*args, **kwargs)
            for name in names:
                x = bound.arguments.get(name)
                if x is None or any(isinstance(e, jax.core.Tracer) for e in jax.tree.leaves(x)):
                    continue
                if (real_array(f.__name__, name, x, finite=False) <= 0).any():
                    raise InputError(f"{f.__name__}: {name} is {x}, expected more than zero")
            return f(*args, **kwargs)

        return call

    return decorate


def pose_parts(T: jax.Array) -> tuple[Mat3, Vec3]:
    """R and p of a pose on lanes."""
    m = entries(T, 2)
    return Mat3(*m[0:3], *m[4:7], *m[8:11]), Vec3(m[3], m[7], m[11])


def motion(V: jax.Array) -> Motion:
    """A twist on lanes."""
    return Motion.from_lanes(entries(V))


def force(F: jax.Array) -> Force:
    """A wrench on lanes."""
    return Force.from_lanes(entries(F))
