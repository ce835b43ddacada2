"""Known and traced values.

A leaf of a model that is closed over is known: its zeros vanish from the program. Custom rules (of
derivatives, of batches) turn all their arguments into tracers, so only traced values may be among
these. `split_tracers` separates the two.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

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


def with_jvp(f: Callable, rule: Callable) -> Callable:
    """f, whose derivative is rule(primals, tangents) -> (value, rate). Tangents may be symbolic
    zeros. Under `vmap` both return the batch first, as JAX assumes."""
    ruled = jax.custom_jvp(lambda *args: batch_first(f(*args)))
    ruled.defjvp(lambda *given: batch_first(rule(*given)), symbolic_zeros=True)
    return lambda *args: ruled(*jax.tree.map(of_jax, args))


def with_values(run: Callable, given: Any, *args: jax.Array) -> Any:
    """run(given, *args, values=) with the driver for values; its derivative uses the driver for
    derivatives. The first of `given` is the model."""
    moving, rebuilt = split_tracers(given)
    known = not split_tracers(given[0])[0]

    def plain(changed: list, *args: jax.Array) -> Any:
        return run(rebuilt(changed), *args, values=known)

    def tangent(primals: tuple, tangents: tuple) -> tuple:
        def f(changed: list, *args: jax.Array) -> Any:
            return run(rebuilt(changed), *args, values=False)

        return jvp_of(f, primals, tangents)

    return with_jvp(plain, tangent)(moving, *args)


def with_implicit_jvp(plain: Callable, solved: Callable, residual: Callable) -> Callable:
    """x = plain(*at), the solution of residual(*at, x) = 0, with the derivative of the implicit
    function:

        dx = solve(d residual(*at, x)),   x held constant

    Args:
        plain: *at -> x, used where nothing is differentiated.
        solved: *at -> x and the function solve.
        residual: linear in x, with the sign for which `solve` maps its change to that of x.

    Derivatives of higher order take only `solve` from `solved`, not x.
    """

    def tangent(primals: tuple, tangents: tuple) -> tuple:
        x, solve = solved(*primals)
        x = found(*primals, x)
        _, change = jvp_of(lambda *at: residual(*at, x), primals, tangents)
        return x, jnp.zeros_like(x) if change is None else solve(change)

    def again(at: tuple, moving: tuple) -> tuple:
        return at[-1], tangent(at[:-1], moving[:-1])[1]

    # x = plain(*at), already computed, with a rule for the next derivative
    found = with_jvp(lambda *at: at[-1], again)
    return with_jvp(plain, tangent)


def of_jax(x: Any) -> Any:
    """x, or a copy where NumPy arrays inside a batch or tangent tracer become JAX arrays: a custom
    rule inside a `jit` takes no others (jax 0.10.2 asserts this)."""
    inner = x
    while isinstance(inner, jax.core.Tracer):
        inner = getattr(inner, "val", getattr(inner, "primal", None))
    return jnp.copy(x) if isinstance(inner, (np.ndarray, np.generic)) else x


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
