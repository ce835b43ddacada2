"""Checks of the arguments of plotting functions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from rbjax.arguments import real_array, real_number
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
