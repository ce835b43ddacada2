"""Constraints that are functions of the configuration.

    holonomic   f(t, q) = 0
                f' = G v + f_t,          G = d f(t, q (+) dq) / d dq  at  dq = 0
    Pfaffian    A(t, q) v = b(t, q)
                y = A v - b,    y' = A a + A' v - b'

Time derivatives are computed along the path with velocity v and acceleration a,

    q(s) = q (+) (s v + s^2 a / 2),      v(s) = v + s a,      time t + s,

so a function is always evaluated at a valid configuration, with unit quaternions. The function is a
compile-time constant that is compared by identity: define it once. Pass values that are
differentiated, batched or changed as `numbers`, a pytree that is the function's last argument.

Source: Goldstein, *Classical Mechanics*, 1.3; Masarati, *Multibody System Dynamics*, 4.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import integer
from rbjax.constraints.rows.row import Constraint, Row, derivatives
from rbjax.dynamics.algorithms.manifold import integrate_lanes
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError
from rbjax.forces import Loads
from rbjax.forces.context import Context
from rbjax.model.record import check_numbers


def arrays(numbers: Any) -> Any:
    """Convert the leaves of a pytree to arrays."""
    try:
        return jax.tree.map(jnp.asarray, numbers)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"numbers of a constraint's function: got {numbers!r}, expected a pytree of numbers"
        ) from error


def check_function(where: str, f: Any) -> None:
    """Raise InputError unless f is callable and hashable."""
    if not callable(f):
        raise InputError(f"{where}: got {type(f).__name__}, expected a function")
    try:
        hash(f)
    except TypeError as error:
        raise InputError(
            f"{where}: got a {type(f).__name__} without a hash, expected a function; give it its "
            "arrays as `numbers`"
        ) from error


def check_functions(constraint: Any, *names: str) -> None:
    """Check the named function fields of a constraint, and that its `numbers` are finite."""
    kind = type(constraint).__name__
    for name in names:
        check_function(f"{kind}({name}=...)", getattr(constraint, name))
    for x in jax.tree.leaves(constraint.numbers):
        check_numbers(f"{kind}(numbers=...)", x, infinite=False)


def evaluate(
    where: str, f: Callable, numbers: Any, args: tuple, shape: tuple[int, ...], dtype: Any
) -> jax.Array:
    """Evaluate f(*args), or f(*args, numbers) if there are numbers, and check the shape."""

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


def _on_path(context: Context, s: jax.Array, dq: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the time t + s and the configuration q (+) dq."""
    q = jnp.stack(integrate_lanes(context.model.topology, list(context.q), list(dq)))
    return jnp.asarray(context.t, context.q.dtype) + s, q


def _acceleration(context: Context) -> jax.Array:
    return jnp.zeros_like(context.v) if context.a is None else context.a


def _loads(gradient: jax.Array) -> Loads:
    return Loads({i: gradient[i] for i in range(gradient.shape[0])})


class Holonomic(Constraint):
    """A constraint f(t, q) = 0, with f a smooth function of the configuration.

    Fields:
        f: static, (t, q) or (t, q, numbers) -> (size,), with q (nq,) in MuJoCo's layout.
        size: static, number of rows.
        numbers: pytree of parameters of f, or None.

    Raises:
        InputError: f returns another shape.

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
        check_functions(self, "f")
        numbers = () if self.numbers is None else ("numbers",)
        check_takes("Holonomic", "f", self.f, "t", "q", *numbers)
        integer("Holonomic", "size", self.size, least=1)

    def _residual(self, context: Context, dq: jax.Array, s: jax.Array) -> jax.Array:
        at = _on_path(context, s, dq)
        return evaluate("Holonomic: f", self.f, self.numbers, at, (self.size,), context.q.dtype)

    def rows(self, context: Context) -> Sequence[Row]:
        v, a, zero = context.v, _acceleration(context), jnp.zeros((), context.q.dtype)
        value, first, second = derivatives(
            lambda s: self._residual(context, s * v + (s * s / 2) * a, s), zero
        )
        _, pull = jax.vjp(lambda dq: self._residual(context, dq, zero), jnp.zeros_like(v))
        (G,) = jax.vmap(pull)(jnp.eye(self.size, dtype=context.q.dtype))
        return [Row(value[r], first[r], _loads(G[r]), second[r]) for r in range(self.size)]


class Pfaffian(Constraint):
    """A constraint A(t, q) v = b(t, q) on the velocity, integrable or not.

    Fields:
        A: static, (t, q) or (t, q, numbers) -> (size, nv), with q (nq,) in MuJoCo's layout. v are
            the model's velocities; rotations of ball and free joints are in body axes.
        b: static, function of the same arguments -> (size,); None for zero.
        size: static, number of rows.
        numbers: pytree of parameters of A and b, or None.

    Raises:
        InputError: A or b returns another shape.

    Example: a gear of ratio two between two joints
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
        check_functions(self, "A", *(() if self.b is None else ("b",)))
        integer("Pfaffian", "size", self.size, least=1)

    def rows(self, context: Context) -> Sequence[Row]:
        v, a, dtype = context.v, _acceleration(context), context.q.dtype
        shape = self.size, context.model.nv

        def rate(s: jax.Array) -> tuple:
            at = _on_path(context, s, s * v + (s * s / 2) * a)
            A = evaluate("Pfaffian: A", self.A, self.numbers, at, shape, dtype)
            y = (A * (v + s * a)).sum(1)  # no `dot`, which rounds to TF32 on a GPU
            if self.b is not None:
                y = y - evaluate("Pfaffian: b", self.b, self.numbers, at, shape[:1], dtype)
            return y, A

        zero = jnp.zeros((), dtype)
        y, dy, A = jax.jvp(rate, (zero,), (jnp.ones_like(zero),), has_aux=True)
        return [Row(None, y[r], _loads(A[r]), dy[r]) for r in range(self.size)]
