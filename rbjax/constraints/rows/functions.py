"""Constraints that are functions of the configuration.

    holonomic   f(t, q) = 0
                f' = G v + f_t,          G = d f(t, q (+) dq) / d dq  at  dq = 0
    Pfaffian    A(t, q) v = b(t, q)
                y = A v - b,    y' = A a + A' v - b'

Their derivatives in time are those along the path on which the robot has the velocity v and the
acceleration a,

    q(s) = q (+) (s v + s^2 a / 2),      v(s) = v + s a,      time t + s.

So functions see only configurations: quaternions of unit length, never a derivative of one.
(Goldstein, *Classical Mechanics*, 1.3; Masarati, *Multibody System Dynamics*, ch. 7)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.rows.row import Constraint, Row
from rbjax.dynamics.algorithms.manifold import integrate_lanes
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError
from rbjax.forces import Loads
from rbjax.forces.context import Context
from rbjax.model.record import check_numbers


def arrays(numbers: Any) -> Any:
    """The pytree with arrays for its numbers."""
    try:
        return jax.tree.map(jnp.asarray, numbers)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"numbers of a constraint's function: got {numbers!r}, expected a pytree of numbers"
        ) from error


def check_function(where: str, f: Any) -> None:
    """Refuse what cannot be called, or cannot be a part of a program."""
    if not callable(f):
        raise InputError(f"{where}: got {type(f).__name__}, expected a function")
    try:
        hash(f)
    except TypeError as error:
        raise InputError(
            f"{where}: got a {type(f).__name__} without a hash, expected a function; give it its "
            "arrays as `numbers`"
        ) from error


def check_size(where: str, size: Any) -> None:
    """Refuse what counts no rows."""
    if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or size < 1:
        raise InputError(f"{where}: got {size!r}, expected a whole number of rows, at least 1")


def check_leaves(where: str, numbers: Any) -> None:
    """Refuse numbers that are not finite."""
    for x in jax.tree.leaves(numbers):
        check_numbers(where, x, infinite=False)


def evaluate(
    where: str, f: Callable, numbers: Any, args: tuple, shape: tuple[int, ...], dtype: Any
) -> jax.Array:
    """f(*args), or f(*args, numbers) where there are numbers, of this shape and dtype."""

    def cast(x: Any) -> jax.Array:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    out = f(*args) if numbers is None else f(*args, jax.tree.map(cast, numbers))
    if not hasattr(out, "dtype"):
        try:
            out = jnp.asarray(out, dtype)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{where} returned {type(out).__name__}, expected an array of shape {shape}"
            ) from error
    if out.shape != shape:
        raise InputError(f"{where} returned the shape {out.shape}, expected {shape}")
    return jnp.asarray(out, dtype)


def _moved(now: Context, dq: jax.Array) -> jax.Array:
    """q (+) dq."""
    return jnp.stack(integrate_lanes(now.model.topology, list(now.q), list(dq)))


def _acceleration(now: Context) -> jax.Array:
    return jnp.zeros_like(now.v) if now.a is None else now.a


def _start(now: Context) -> tuple[jax.Array, jax.Array]:
    """s = 0, and its rate."""
    return jnp.zeros((), now.q.dtype), jnp.ones((), now.q.dtype)


def _loads(gradient: jax.Array) -> Loads:
    return Loads({i: gradient[i] for i in range(gradient.shape[0])})


class Holonomic(Constraint):
    """f(t, q) = 0, any smooth function of the configuration.

    Fields: numbers, a pytree that f takes as its last argument, or None.
    Static: f, from t, q (nq,) in MuJoCo's layout with unit quaternions (and numbers) to (size,);
    size, how many rows it has. Define f once: a function defined again is another program.

    Raises: `InputError` where f returns another shape.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> def ellipse(t, q, axes):
        ...     return jnp.sum((q / axes) ** 2, keepdims=True) - 1.0
        >>> held = rb.constraints.Holonomic(ellipse, numbers=jnp.array([2.0, 1.0]))
        >>> rb.load("double_pendulum").with_constraints(held).constraints[0].size
        1
    """

    f: Callable = eqx.field(static=True)
    size: int = eqx.field(static=True, default=1)
    numbers: Any = eqx.field(converter=arrays, default=None)

    def __check_init__(self) -> None:
        check_function("Holonomic(f=...)", self.f)
        numbers = () if self.numbers is None else ("numbers",)
        check_takes("Holonomic", "f", self.f, "t", "q", *numbers)
        check_size("Holonomic(size=...)", self.size)
        check_leaves("Holonomic(numbers=...)", self.numbers)

    def _residual(self, now: Context, dq: jax.Array, s: jax.Array) -> jax.Array:
        at = jnp.asarray(now.t, now.q.dtype) + s, _moved(now, dq)
        return evaluate("Holonomic: f", self.f, self.numbers, at, (self.size,), now.q.dtype)

    def rows(self, now: Context) -> Sequence[Row]:
        v, a, (zero, one) = now.v, _acceleration(now), _start(now)

        def rate(s: jax.Array) -> tuple:
            def path(s: jax.Array) -> jax.Array:
                return self._residual(now, s * v + (s * s / 2) * a, s)

            return jax.jvp(path, (s,), (one,))

        (value, first), (_, second) = jax.jvp(rate, (zero,), (one,))
        _, pull = jax.vjp(lambda dq: self._residual(now, dq, zero), jnp.zeros_like(v))
        (G,) = jax.vmap(pull)(jnp.eye(self.size, dtype=now.q.dtype))
        return [Row(value[r], first[r], _loads(G[r]), second[r]) for r in range(self.size)]


class Pfaffian(Constraint):
    """A(t, q) v = b(t, q): constraints on the velocity, which need no function behind them.

    Fields: numbers, a pytree that A and b take as their last argument, or None.
    Static: A, from t, q (nq,) in MuJoCo's layout with unit quaternions (and numbers) to (size, nv);
    b, to (size,), or None for zero; size, how many rows it has. v is in the model's coordinates: of
    a ball and a free joint, rad/s in body axes.

    Raises: `InputError` where A or b returns another shape.

    Example:
        A gear of ratio two between two joints, which forgets where it began.

        >>> import rbjax as rb, jax.numpy as jnp
        >>> def gear(t, q):
        ...     return jnp.array([[1.0, -2.0]])
        >>> model = rb.load("double_pendulum").with_constraints(rb.constraints.Pfaffian(gear))
    """

    A: Callable = eqx.field(static=True)
    b: Callable | None = eqx.field(static=True, default=None)
    size: int = eqx.field(static=True, default=1)
    numbers: Any = eqx.field(converter=arrays, default=None)

    def __check_init__(self) -> None:
        check_function("Pfaffian(A=...)", self.A)
        if self.b is not None:
            check_function("Pfaffian(b=...)", self.b)
        check_size("Pfaffian(size=...)", self.size)
        check_leaves("Pfaffian(numbers=...)", self.numbers)

    def rows(self, now: Context) -> Sequence[Row]:
        v, a, dtype, (zero, one) = now.v, _acceleration(now), now.q.dtype, _start(now)
        shape = self.size, now.model.nv

        def rate(s: jax.Array) -> tuple:
            at = jnp.asarray(now.t, dtype) + s, _moved(now, s * v + (s * s / 2) * a)
            A = evaluate("Pfaffian: A", self.A, self.numbers, at, shape, dtype)
            y = (A * (v + s * a)).sum(1)  # no `dot`, which rounds to TF32 on a GPU
            if self.b is not None:
                y = y - evaluate("Pfaffian: b", self.b, self.numbers, at, shape[:1], dtype)
            return y, A

        y, dy, A = jax.jvp(rate, (zero,), (one,), has_aux=True)
        return [Row(None, y[r], _loads(A[r]), dy[r]) for r in range(self.size)]
