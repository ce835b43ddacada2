"""Custom derivative rules whose arguments are the traced values only.

A leaf of a model that is closed over is constant: its zeros vanish from the program. A custom rule
turns all its arguments into tracers. Therefore `split_tracers` separates traced values from
constants.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from rbjax._jax_compat import inside
from rbjax.lanes import batch_first


def split_tracers(tree: Any) -> tuple[list[jax.Array], Callable[[list], Any]]:
    """Return the traced leaves of a pytree, and a function that replaces them by new values."""
    leaves, treedef = jax.tree.flatten(tree)
    where = [i for i, x in enumerate(leaves) if isinstance(x, jax.core.Tracer)]

    def closed(moving: list) -> Any:
        filled = list(leaves)
        for i, x in zip(where, moving, strict=True):
            filled[i] = x
        return jax.tree.unflatten(treedef, filled)

    return [leaves[i] for i in where], closed


def is_traced(tree: Any) -> bool:
    """Return True if a leaf of a pytree is traced."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))


def with_jvp(f: Callable, rule: Callable) -> Callable:
    """Return f with the derivative rule(primals, tangents) -> (value, rate).

    Tangents may be symbolic zeros. Under `vmap` f and rule return the batch first, as JAX assumes.
    """
    ruled = _custom_jvp(lambda *args: batch_first(f(*args), args), rule)
    return lambda *args: ruled(*jax_arrays(*args))


def _custom_jvp(f: Callable, rule: Callable) -> Callable:
    """Return f with a derivative rule, for an f that returns `batch_first(results, args)`.
    The arguments of the result must be `jax_arrays`."""
    ruled = jax.custom_jvp(f)
    ruled.defjvp(lambda at, *to: batch_first(rule(at, *to), at), symbolic_zeros=True)
    return ruled


def with_implicit_jvp(plain: Callable, solved: Callable, *residuals: Callable) -> Callable:
    """Return `plain` with implicit derivatives of the solutions x_k of residual_k = 0.

        residual_k(*at, x_1, ..., x_k) = 0,
        dx_k = solve_k(d residual_k(*at, x_1, ..., x_k)),   x_k held constant

    Args:
        plain: a function of *at that returns `batch_first(solutions, at)`. It gives the values.
            Further values may follow the solutions; their derivatives are zero.
        solved: a function of *at that returns the solutions and a function solve_k for each,
            -(d residual_k / dx_k)^-1. It is used for derivatives. Further results are passed on to
            the residuals and held constant, for example which contacts touch.
        residuals: the functions residual_k.

    The arguments of the result must be `jax_arrays`. Derivatives of higher order use only the
    functions solve_k from `solved`, not the solutions.
    """

    def tangent(primals: tuple, tangents: tuple) -> tuple:
        xs, solves, *held = solved(*primals)
        xs, rates = found(*jax_arrays(*primals, xs)), list[Any]()
        for k, (residual, solve) in enumerate(zip(residuals, solves, strict=True)):
            at, moving = (*primals, *xs[:k]), (*tangents, *rates)
            _, change = jvp_of(functools.partial(_held, residual, (xs[k], *held)), at, moving)
            rates.append(jnp.zeros_like(xs[k]) if change is None else solve(change))
        rates += [jnp.zeros_like(x) for x in xs[len(rates) :]]
        return xs, tuple(rates)

    def again(at: tuple, moving: tuple) -> tuple:
        return at[-1], tangent(at[:-1], moving[:-1])[1]

    # return solutions that are already computed, with a rule for the next derivative
    found = _custom_jvp(lambda *at: batch_first(at[-1], at), again)
    return _custom_jvp(plain, tangent)


def _held(residual: Callable, held: Sequence[Any], *at: Any) -> Any:
    return residual(*at, *held)


def jax_arrays(*args: Any) -> Any:
    """Return the arguments, with tracers of NumPy arrays replaced by tracers of JAX arrays.
    A custom rule inside a `jit` accepts only tracers of JAX arrays (jax 0.10.2 asserts this)."""

    def copied(x: Any) -> Any:
        return jnp.copy(x) if isinstance(inside(x), (np.ndarray, np.generic)) else x

    return jax.tree.map(copied, args)


def jvp_of(f: Callable, primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Compute f and its tangent with `jax.jvp`, which may have symbolic zeros as tangents.

    Arguments whose tangents are symbolic zeros are not differentiated. The tangent of f is None if
    all tangents are zero.
    """
    leaves, treedef = jax.tree.flatten(primals)
    rates = jax.tree.leaves(tangents, is_leaf=lambda t: isinstance(t, SymbolicZero))
    moving = [i for i, t in enumerate(rates) if not isinstance(t, SymbolicZero)]

    def restricted(*changed):
        filled = list(leaves)
        for i, x in zip(moving, changed, strict=True):
            filled[i] = x
        return f(*jax.tree.unflatten(treedef, filled))

    if not moving:
        return restricted(), None
    return jax.jvp(restricted, [leaves[i] for i in moving], [rates[i] for i in moving])
