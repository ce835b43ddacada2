"""References of controllers: a constant, or a function of time with its velocity and acceleration.

    configuration   v = d/ds (q(t + s) - q(t)),  a = dv/dt         (minus on the manifold)
    frame           w = vee(R' R^T),  V = [w; p'],  A = [w'; p'']  in world axes
A function returns the reference itself; JAX differentiates it in forward mode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.manifold import difference
from rbjax.dynamics.arguments import check_array, check_quaternions, check_takes
from rbjax.errors import InputError
from rbjax.model import Model

Reference = Any  # an array, or a function of t that returns one


class Followed(NamedTuple):
    """A configuration q (nq,), its velocity v (nv,) and acceleration a (nv,)."""

    q: jax.Array
    v: jax.Array
    a: jax.Array


class Pose(NamedTuple):
    """A frame's attitude R (3, 3) and position p (3,), its twist V (6,) and the rate A (6,) of
    that, angular first, world axes."""

    R: jax.Array
    p: jax.Array
    V: jax.Array
    A: jax.Array


def check_configurations(where: str, model: Model, reference: Any, name: str = "reference") -> Any:
    """A reference of configurations: (nq,), a function t -> (nq,), or t -> (q, v, a)."""
    if callable(reference):
        check_takes(where, name, reference, "t")
        return reference
    q = check_array(where, name, reference, (model.nq,), fix=" or a function of t")
    check_quaternions(where, name, model, q)
    return q


def configuration(model: Model, reference: Any, t: Any, dtype: Any) -> Followed:
    """The configuration, velocity and acceleration of a reference at a time."""
    if not callable(reference):
        still = jnp.zeros(model.nv, dtype)
        return Followed(reference.astype(dtype), still, still)
    t = jnp.asarray(t, dtype)
    found = reference(t)
    if isinstance(found, tuple):
        return Followed(*(jnp.asarray(x, dtype) for x in found))
    _sized("reference(t)", found, (model.nq,))

    def velocity(t: jax.Array) -> jax.Array:
        q = reference(t).astype(dtype)
        return _rate(lambda s: difference(model, q, reference(s).astype(dtype)), t)

    v, a = jax.jvp(velocity, (t,), (jnp.ones_like(t),))
    return Followed(jnp.asarray(found, dtype), v, a)


def check_poses(where: str, reference: Any, rows: tuple[str, ...]) -> Any:
    """A reference of a frame: an array or a function of t, of the kind that `rows` says."""
    if isinstance(reference, Callable):  # type: ignore[arg-type]
        check_takes(where, "reference", reference, "t")
        return reference
    if rows == ("position",):
        return check_array(where, "reference", reference, (3,), fix=" or a function of t")
    if rows == ("rotation",):
        return check_array(where, "reference", reference, (3, 3), fix=" or a function of t")
    if not isinstance(reference, tuple) or len(reference) != 2:
        raise InputError(
            f"{where}: reference is {type(reference).__name__}, expected a pair (R (3, 3), p (3,)) "
            "or a function of t that returns one"
        )
    R, p = reference
    return check_array(where, "reference[0]", R, (3, 3)), check_array(
        where, "reference[1]", p, (3,)
    )


def pose(reference: Any, t: Any, rows: tuple[str, ...], dtype: Any) -> Pose:
    """The pose, twist and acceleration of a reference at a time; no rotation if it has only
    positions."""
    t = jnp.asarray(t, dtype)

    def at(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = reference(t) if callable(reference) else reference
        if rows == ("position",):
            R, p = jnp.eye(3, dtype=dtype), found
        elif rows == ("rotation",):
            R, p = found, jnp.zeros(3, dtype)
        else:
            R, p = found
        R, p = jnp.asarray(R, dtype), jnp.asarray(p, dtype)
        _sized("reference(t)", R, (3, 3))
        _sized("reference(t)", p, (3,))
        return R, p

    R, p = at(t)
    if not callable(reference):
        return Pose(R, p, jnp.zeros(6, dtype), jnp.zeros(6, dtype))

    def twist(t: jax.Array) -> jax.Array:
        (R, _), (R_rate, p_rate) = jax.jvp(at, (t,), (jnp.ones_like(t),))
        W = (R_rate[:, None, :] * R[None, :, :]).sum(-1)
        w = jnp.stack([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2
        return jnp.concatenate([w, p_rate])

    V, A = jax.jvp(twist, (t,), (jnp.ones_like(t),))
    return Pose(R, p, V, A)


def _rate(f: Callable, t: jax.Array) -> jax.Array:
    return jax.jvp(f, (t,), (jnp.ones_like(t),))[1]


def _sized(name: str, x: Any, shape: tuple[int, ...]) -> None:
    if jnp.shape(x) != shape:
        raise InputError(f"{name} has shape {jnp.shape(x)}, expected {shape}")
