"""The stage equations of all implicit methods for any vector field.

    k_i = h f(t_i, y_i + sum_j a_ij k_j),    i = 1 ... s
Runge-Kutta methods have s stages, a BDF or an Adams method has one. Their exact Newton matrix is
1 - h (a_ij J_i), with Jacobians J_i of the field. The chord iteration takes 1 - h A (x) J, with one
J at the start of the step (Hairer & Wanner, *Solving Ordinary Differential Equations II*, IV.8).
That needs n columns of derivatives a step instead of s n.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from rbjax.lanes import batch_first, matvec
from rbjax.solvers.common.field import Field, linearized, rates
from rbjax.solvers.common.newton import linear_solver, matrix_free, root
from rbjax.solvers.common.steps import mixed


class Start(NamedTuple):
    """The start of a step. The Jacobian is None for a matrix-free method."""

    t: Any
    y: jax.Array  # (n,)
    rate: jax.Array  # (n,)
    jacobian: jax.Array | None  # (n, n), held constant by derivatives of the step


def start(f: Field, t: Any, y: jax.Array, finder: Any) -> Start:
    """The rate and the Jacobian at (t, y), in one evaluation."""
    return Start(t, y, *((f(t, y), None) if matrix_free(finder) else _held(f, t, y)))


@eqx.filter_custom_jvp
def _held(f: Field, t: Any, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    return batch_first(linearized(f, t, y))


@_held.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    """Zero: roots and the size of an error do not depend on the matrix that finds them."""
    rate, jacobian = _held(*primals)
    _, moving = eqx.filter_jvp(lambda f, t, y: f(t, y), primals, tangents)
    return (rate, jacobian), batch_first((moving, jnp.zeros_like(jacobian)))


class Stages(eqx.Module):
    """The residual of the increments k (s, n)."""

    f: Field
    h: Any
    t: jax.Array  # (s,)
    y: jax.Array  # (n,) or (s, n)
    a: jax.Array  # (s, s)
    matrix_free: bool = eqx.field(static=True)

    def __call__(self, k: jax.Array) -> jax.Array:
        at = self.y + mixed(self.a, k)
        rate = jax.vmap(self.f)(self.t, at) if self.matrix_free else rates(self.f, self.t, at)
        return k - self.h * rate


class Chord(eqx.Module):
    """(1 - h A (x) J) k: replaces `Stages` where its derivative is needed."""

    h: Any
    a: jax.Array
    jacobian: jax.Array

    def __call__(self, k: jax.Array, args: Any) -> tuple[jax.Array, None]:
        return k - self.h * matvec(self.jacobian, mixed(self.a, k)), None


def solve(
    f: Field, h: Any, t: jax.Array, y: jax.Array, a: jax.Array, start: Start, guess: jax.Array,
    finder: Any, max_steps: int,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """The increments (s, n), and whether they were found."""
    residual = Stages(f, h, t, y, a, matrix_free(finder))
    near = None if start.jacobian is None else Chord(h, a, start.jacobian)
    return root(residual, finder, guess, start.y, max_steps, near)


def damped(f: Field, gamma_h: Any, start: Start, raw: jax.Array, finder: Any) -> jax.Array:
    """(1 - gamma h J)^-1 raw for an error estimate raw, with J at the start."""
    if start.jacobian is None:
        _, push = jax.linearize(lambda y: f(start.t, y), start.y)
        operator: Any = lx.FunctionLinearOperator(
            lambda x: x - gamma_h * push(x), jax.eval_shape(lambda: raw)
        )
    else:
        one = jnp.eye(raw.size, dtype=raw.dtype)
        operator = lx.MatrixLinearOperator(one - gamma_h * start.jacobian)
    return lx.linear_solve(operator, raw, linear_solver(finder), throw=False).value
