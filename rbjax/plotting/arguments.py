"""Checks of the arguments of plotting functions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from rbjax.arguments import choice, flag, instance, integer, real_array, real_number, shown
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.motion.trajectory import Trajectory


def coordinates(q: Any) -> Any:
    """Return the coordinates q of a `State` or a `Trajectory`; another argument unchanged."""
    return q.q if isinstance(q, State | Trajectory) else q


def configurations(where: str, model: Model, q: Any) -> np.ndarray:
    """Convert configurations (T, nq) of one robot, or states with them, to an array.

    Raises:
        InputError: not a model, or q has another shape or is not finite.
    """
    check_model(where, model)
    x = real_array(where, "q", coordinates(q))
    if x.ndim != 2 or x.shape[1] != model.nq:
        raise InputError(f"{where}: q has shape {x.shape}, expected (T, {model.nq})")
    return x


def check_film(
    where: str, model: Any, trajectory: Any, *, fps: Any, speed: Any, samples: Any, camera: Any,
    follow: Any, tracked: Any, trace: Any, title: Any, floating_base: Any,
) -> None:  # fmt: skip
    """Raise InputError unless these are arguments of an animation of a trajectory."""
    check_model(where, model)
    instance(where, "trajectory", trajectory, Trajectory, "rb.Trajectory, of rollout or simulate")
    for name, x in (("fps", fps), ("speed", speed)):
        real_number(where, name, x, above=0.0)
    integer(where, "samples", samples, least=1)
    if camera is not None and not hasattr(camera, "axes"):
        raise InputError(f"{where}: camera is {shown(camera)}, expected an rb.plotting.Camera")
    if follow is not None:
        flag(where, "follow", follow)
    flag(where, "floating_base", floating_base)
    instance(where, "title", title, str, "a text")
    known = model.body_names
    several = trace if isinstance(trace, tuple | list) else [trace]
    for name in [*several, *([] if tracked is None else [tracked])]:
        choice("body", name, known)


def check_size(where: str, size: Any) -> None:
    """Raise InputError unless a size is a width and a height in pixels."""
    if not isinstance(size, tuple | list) or len(size) != 2:
        raise InputError(f"{where}: size is {shown(size)}, expected (width, height) in pixels")
    for n in size:
        integer(where, "size", n, least=1)


def check_solids(where: str, shapes: Any, R: Any, p: Any, alpha: Any) -> tuple[Any, Any]:
    """Check solids, and convert rotations (nb, 3, 3) and positions (nb, 3) of bodies to arrays.

    Raises:
        InputError: other shapes, values that are not finite, an opacity outside of 0 to 1.
    """
    if not isinstance(shapes, Iterable) or not all(hasattr(s, "placed") for s in shapes):
        raise InputError(
            f"{where}: shapes is {type(shapes).__name__}, expected what solids or skeleton returns"
        )
    R, p = real_array(where, "R", R), real_array(where, "p", p)
    if R.shape[1:] != (3, 3) or p.shape != (len(R), 3):
        raise InputError(
            f"{where}: R has shape {R.shape} and p {p.shape}, expected (nb, 3, 3) and (nb, 3)"
        )
    bodies = 1 + max((max(s.body, s.body if s.end is None else s.end) for s in shapes), default=-1)
    if len(R) < bodies:
        raise InputError(f"{where}: R and p have {len(R)} bodies, expected at least {bodies}")
    if real_number(where, "alpha", alpha, least=0.0) > 1:
        raise InputError(f"{where}: alpha is {alpha}, expected an opacity from 0 to 1")
    return R, p
