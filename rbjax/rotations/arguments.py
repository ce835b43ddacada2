"""Checked and compiled functions of arrays, and conversions between arrays and lanes.

Arrays are (..., n). Leading axes are a batch and broadcast against each other. Outside traced code
the values are checked and the call is compiled. Inside traced code the function is inlined.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import check_positive, floating_array
from rbjax.compiling import compiled, wide_vectors
from rbjax.errors import InputError
from rbjax.lanes import Mat3, Vec3

P = ParamSpec("P")
R = TypeVar("R")

#: kind of argument -> shape of one sample
SHAPES: dict[str, tuple[int, ...]] = {
    "scalar": (),
    "scalar_or_infinite": (),
    "vector": (3,),
    "quaternion": (4,),
    "twist": (6,),
    "matrix": (3, 3),
    "rotation": (3, 3),
    "matrix4": (4, 4),
    "pose": (4, 4),
    "matrix6": (6, 6),
    "pair": (2,),
    "planar_pose": (3,),
    "inertial": (10,),
}
# Tolerance of R R^T - 1 for a rotation matrix R. Matrices that were measured, or rounded to half
# precision and cast back, pass.
ORTHONORMAL = 1e-2


def takes(
    static: Iterable[str] = (), positive: Iterable[str] = (), **kinds: str
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that compiles a function of arrays and checks its arguments.

    Args:
        static: names of arguments that are static (hashable).
        positive: names of arguments that must be above zero unless they are traced.
        kinds: name -> kind of array (`SHAPES`). "parameters" is the parameters of an attitude
            representation, for its methods.
    """
    static = tuple(static)

    def decorate(f: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(f)
        optional = {n: p.default is None for n, p in signature.parameters.items()}
        program = compiled(f, options=wide_vectors, static_argnames=static)

        @functools.wraps(f)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            bound = signature.bind(*args, **kwargs)
            given = {n: bound.arguments[n] for n in kinds if n in bound.arguments}
            given = {n: x for n, x in given.items() if x is not None or not optional[n]}
            check_positive(f.__name__, **{n: given.get(n) for n in positive})
            for name, value in given.items():
                shape = SHAPES.get(kinds[name])
                if shape is None:
                    shape = (bound.arguments["self"].size,)
                given[name] = _array(f.__name__, name, value, shape)
            dtype = jnp.result_type(*given.values())
            given = {n: x.astype(dtype) for n, x in given.items()}
            bound.arguments.update(given)
            if any(isinstance(x, jax.core.Tracer) for x in given.values()):
                return f(*bound.args, **bound.kwargs)
            for name, x in given.items():
                _check_values(f.__name__, name, np.asarray(x), kinds[name])
            return program(*bound.args, **bound.kwargs)

        return call

    return decorate


def checked(where: str, name: str, value: Any, kind: str) -> jax.Array:
    """Convert an argument to an array of a kind, and check its values unless it is traced.

    Raises:
        InputError: not an array, wrong shape or dtype, or values that are not finite.
    """
    x = _array(where, name, value, SHAPES[kind])
    if not isinstance(x, jax.core.Tracer):
        _check_values(where, name, np.asarray(x), kind)
    return x


def _array(where: str, name: str, value: Any, shape: tuple[int, ...]) -> jax.Array:
    def fits(given: tuple[int, ...]) -> bool:
        return len(given) >= len(shape) and given[len(given) - len(shape) :] == shape

    return floating_array(where, name, value, fits, f"({', '.join(['...', *map(str, shape)])})")


def _check_values(where: str, name: str, x: np.ndarray, kind: str) -> None:
    fine = ~np.isnan(x) if kind == "scalar_or_infinite" else np.isfinite(x)
    if not fine.all():
        bad = tuple(int(i) for i in np.argwhere(~fine)[0])
        raise InputError(f"{where}: {name}{list(bad)} is {x[bad]}, expected finite values")
    if kind == "quaternion" and not x.any(-1).all():
        raise InputError(
            f"{where}: {name} has a zero quaternion, expected a unit one (w, x, y, z); "
            f"no rotation is (1, 0, 0, 0)"
        )
    if kind in ("rotation", "pose"):
        R = x[..., :3, :3]
        off = np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max(initial=0.0)
        if off > ORTHONORMAL or (np.linalg.det(R) < 0).any():
            raise InputError(
                f"{where}: {name} is not a rotation (R R^T is {off:.2g} from the identity, or "
                f"det R < 0), expected a proper orthonormal matrix; so3.project gives the nearest"
            )
    if kind == "pose" and np.abs(x[..., 3, :] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0) > 0:
        raise InputError(f"{where}: the last row of {name} is not (0, 0, 0, 1), expected a pose")


def entries(x: jax.Array, axes: int = 1) -> list[jax.Array]:
    """Return the entries of the last `axes` axes, row by row, as arrays over the leading axes."""
    lead = x.shape[: x.ndim - axes]
    flat = x.reshape(*lead, math.prod(x.shape[x.ndim - axes :]))  # -1 fails in an empty batch
    return [flat[..., i] for i in range(flat.shape[-1])]


def pose_parts(T: jax.Array) -> tuple[Mat3, Vec3]:
    """Return R and p of a pose (..., 4, 4) on lanes."""
    m = entries(T, 2)
    return Mat3(*m[0:3], *m[4:7], *m[8:11]), Vec3(m[3], m[7], m[11])


def stacked(values: Iterable[Any], *shape: int) -> jax.Array:
    """Stack lanes, row by row, to one array (..., *shape), by default a vector.

    Up to 12 lanes are selected by index, axis by axis: XLA's CPU compiler unrolls the selection
    into one loop over the batch, but evaluates the operands of a concatenate several times.
    """
    if isinstance(values, jax.Array):
        return values
    values = list(values)
    like = jnp.result_type(*(v for v in values if isinstance(v, jax.Array)))
    batch = jnp.broadcast_shapes(*(jnp.shape(v) for v in values))
    values = [jnp.broadcast_to(jnp.asarray(v, like), batch) for v in values]
    if len(values) > 12:
        out = jnp.concatenate([v[..., None] for v in values], -1)
        return out.reshape(*batch, *shape) if shape else out
    return _chosen(values, shape or (len(values),))


def _chosen(values: list[jax.Array], shape: tuple[int, ...]) -> jax.Array:
    if not shape:
        return values[0]
    each = len(values) // shape[0]
    parts = [_chosen(values[i : i + each], shape[1:]) for i in range(0, len(values), each)]
    axis = -len(shape)
    index = jnp.arange(shape[0]).reshape(-1, *[1] * (len(shape) - 1))
    return _choose(index, [jnp.expand_dims(p, axis) for p in parts], 0)


def _choose(index: jax.Array, values: list[jax.Array], first: int) -> jax.Array:
    if len(values) == 1:
        return values[0]
    half = len(values) // 2
    return jnp.where(
        index < first + half,
        _choose(index, values[:half], first),
        _choose(index, values[half:], first + half),
    )


def spread(x: jax.Array, *shape: int) -> jax.Array:
    """Broadcast x (...) to (..., *shape) such that XLA treats each entry as a different value.

    XLA stores an expensive value that several entries share (a quotient, a root) in a separate
    array, which costs one more pass over memory. A value that depends on the entry stays in the
    loop over the entries, and LLVM recognizes that it is equal for all.
    """
    entry = sum(jnp.arange(n, dtype=x.dtype).reshape(-1, *[1] * k)
                for k, n in enumerate(reversed(shape)))  # fmt: skip
    return x.reshape(*x.shape, *[1] * len(shape)) + 0.0 * entry
