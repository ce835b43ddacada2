"""Leaves of a model as lanes. Leaves that are constant while tracing become literals."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane, Vec3, quaternion_matrix
from rbjax.model.links import lane
from rbjax.model.model import Model
from rbjax.spatial import Transform


def table(x: Any, dtype: Any) -> Any:
    """Convert a constant array to numpy, and a traced array to the dtype."""
    if isinstance(x, jax.core.Tracer):
        return x.astype(dtype)
    return np.asarray(x, np.float64) if isinstance(x, (jax.Array, np.ndarray)) else x


def tables(dtype: Any, *numbers: Any) -> tuple[Any, list]:
    """Convert the leaves of one computation to arrays of one module, and return it with them.

    The module is numpy if all leaves are constant, else jax.numpy, with arrays of the dtype.
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
    sites = model.sites
    position, orientation = (table(x, dtype) for x in (sites.position, sites.orientation))
    return Transform(
        quaternion_matrix(*(lane(orientation[:, k], site) for k in range(4))),
        Vec3(*(lane(position[:, k], site) for k in range(3))),
    )
