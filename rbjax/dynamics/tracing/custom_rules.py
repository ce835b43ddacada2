"""Known and traced values.

A leaf of a model that is closed over is known: its zeros vanish from the program. Custom rules (of
derivatives, of batches) turn all their arguments into tracers, so only traced values may be among
these. `split_tracers` separates the two.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from rbjax._jax_compat import inside
from rbjax.lanes import batch_first


def split_tracers(tree: Any) -> tuple[list[jax.Array], Callable[[list], Any]]:
    """The traced leaves of a pytree, and the function that puts others in their places."""
    leaves, treedef = jax.tree.flatten(tree)
    where = [i for i, x in enumerate(leaves) if isinstance(x, jax.core.Tracer)]

    def closed(moving: list) -> Any:
        filled = list(leaves)
        for i, x in zip(where, moving, strict=True):
            filled[i] = x
        return jax.tree.unflatten(treedef, filled)

    return [leaves[i] for i in where], closed


def is_traced(tree: Any) -> bool:
    """Whether a leaf of a pytree is traced."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))


def with_jvp(f: Callable, rule: Callable) -> Callable:
    """f, whose derivative is rule(primals, tangents) -> (value, rate). Tangents may be symbolic
    zeros. Under `vmap` both return the batch first, as JAX assumes."""
    ruled = jax.custom_jvp(lambda *args: batch_first(f(*args), args))
    ruled.defjvp(lambda at, *to: batch_first(rule(at, *to), at), symbolic_zeros=True)
    return lambda *args: ruled(*jax.tree.map(of_jax, args))


def with_implicit_jvp(plain: Callable, solved: Callable, *residuals: Callable) -> Callable:
    """x_1, x_2, ... = plain(*at), the solutions of residual_k(*at, x_1, ..., x_k) = 0, one after
    another, with the derivative of the implicit function:

        dx_k = solve_k(d residual_k(*at, x_1, ..., x_k)),   x_k held constant

    Args:
        plain: *at -> the solutions, used where nothing is differentiated.
        solved: *at -> the solutions, and a function solve for each.
        residuals: each with the sign for which `solve` maps its change to that of its solution.

    Derivatives of higher order take only the functions `solve` from `solved`, not the solutions.
    """

    def tangent(primals: tuple, tangents: tuple) -> tuple:
        xs, solves = solved(*primals)
        xs, rates = found(*primals, xs), list[Any]()
        for k, (residual, solve) in enumerate(zip(residuals, solves, strict=True)):
            at, moving = (*primals, *xs[:k]), (*tangents, *rates)
            _, change = jvp_of(functools.partial(_held, residual, xs[k]), at, moving)
            rates.append(jnp.zeros_like(xs[k]) if change is None else solve(change))
        return xs, tuple(rates)

    def again(at: tuple, moving: tuple) -> tuple:
        return at[-1], tangent(at[:-1], moving[:-1])[1]

    # the solutions, already computed, with a rule for the next derivative
    found = with_jvp(lambda *at: at[-1], again)
    return with_jvp(plain, tangent)


def _held(residual: Callable, x: Any, *at: Any) -> Any:
    return residual(*at, x)


def of_jax(x: Any) -> Any:
    """x, or, if x is a batch or tangent tracer of a NumPy array, a copy that is one of a JAX array:
    a custom rule inside a `jit` accepts only JAX arrays (jax 0.10.2 asserts this)."""
    return jnp.copy(x) if isinstance(inside(x), (np.ndarray, np.generic)) else x


def jvp_of(f: Callable, primals: Any, tangents: Any) -> tuple[Any, Any]:
    """f and its tangent, as `jax.jvp`. Tangents may be symbolic zeros; their arguments are not
    differentiated. The tangent is None if all are zero."""
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
