"""Leaves of a model as lanes. Leaves that are constant while tracing become literals."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.lanes import Lane, Mat3, Vec3, quaternion_matrix
from rbjax.model.frame import Frame
from rbjax.model.links import lane
from rbjax.model.model import Model
from rbjax.model.topology import WORLD
from rbjax.spatial import Transform


def table(x: Any, dtype: Any) -> Any:
    """Convert a constant array to numpy, and a traced array to the dtype."""
    if isinstance(x, jax.core.Tracer):
        return x.astype(dtype)
    return np.asarray(x, np.float64) if isinstance(x, (jax.Array, np.ndarray)) else x


def tables(dtype: Any, *numbers: Any) -> tuple[Any, list]:
    """Convert leaves to arrays of one module. Return the module and the arrays.

    The module is numpy if all leaves are constant. Otherwise it is jax.numpy, with arrays of the
    dtype.
    """
    found = [table(x, dtype) for x in numbers]
    if any(isinstance(x, jax.core.Tracer) for x in found):
        return jnp, [jnp.asarray(x, dtype) for x in found]
    return np, found


def scalar(x: jax.Array, dtype: Any) -> Lane:
    """Return an array of shape () as a lane."""
    return lane(table(x, dtype)[None], 0)


def numbers(x: jax.Array, dtype: Any) -> list[Lane]:
    """Return the entries of an array (n,) as lanes."""
    column = table(x, dtype)
    return [lane(column, i) for i in range(x.shape[0])]


def site_transform(model: Model, site: int, dtype: Any) -> Transform:
    """Return the pose of a site in the frame of its body."""
    return _row_transform(model.sites.position, model.sites.orientation, site, dtype)


def geom_transform(model: Model, geom: int, dtype: Any) -> Transform:
    """Return the pose of a geom in the frame of its body."""
    assert model.geoms is not None
    return _row_transform(model.geoms.position, model.geoms.orientation, geom, dtype)


def _row_transform(position: Any, orientation: Any, row: int, dtype: Any) -> Transform:
    position, orientation = table(position, dtype), table(orientation, dtype)
    return Transform(
        quaternion_matrix(*(lane(orientation[:, k], row) for k in range(4))),
        Vec3(*(lane(position[:, k], row) for k in range(3))),
    )


def frame_transform(model: Model, frame: Frame, dtype: Any) -> tuple[int, Transform]:
    """Return the body of a frame (or WORLD) and the pose of the frame in the body.

    Raises:
        InputError: not exactly one of body, site, geom and center. UnknownName: no such name.
    """
    places = (frame.body, frame.site, frame.geom, frame.center)
    if sum(x is not None for x in places) != 1:
        if frame.geom is not None or frame.center is not None:
            names = zip(("body", "site", "geom", "center"), places, strict=True)
            got = " and ".join(name for name, x in names if x is not None)
            raise InputError(f"a frame has {got}, expected exactly one of them")
        got = "neither" if all(x is None for x in places) else "both"
        raise InputError(f"got {got} of body and site, expected exactly one")
    if frame.site is not None:
        i = model.site(frame.site)
        body, placed = model.topology.site_bodies[i], site_transform(model, i, dtype)
    elif frame.geom is not None:
        i = model.geom(frame.geom)
        assert model.geoms is not None
        body, placed = model.geoms.bodies[i], geom_transform(model, i, dtype)
    elif frame.center is not None:
        body = model.body(frame.center)
        com = table(model.bodies.com, dtype)
        placed = Transform(Mat3.identity(), Vec3(*(lane(com[:, k], body) for k in range(3))))
    else:
        fixed = frame.body == "world" and frame.body not in model.body_names  # MuJoCo's name
        body = WORLD if fixed else model.body(frame.body)
        placed = Transform(Mat3.identity(), Vec3.zero())
    at = Vec3.zero() if frame.point is None else Vec3(*(frame.point[i] for i in range(3)))
    R = placed.R
    if frame.orientation is not None:
        R = R @ quaternion_matrix(*map(float, frame.orientation))
    return body, Transform(R, placed.p + placed.R @ at)
