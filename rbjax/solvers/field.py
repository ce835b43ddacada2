"""The vector field of a step. It is traced once and linearized once, however often it is used.

    y' = f(t, y),    J = df/dy
A robot's field has thousands of operations, and a solver's step is traced several times. So both
functions here are jitted, and JAX caches them by the term and the shapes.
The stages of an implicit method are evaluated as a batch. Their derivative with respect to the
state goes through J: n columns a stage, however many columns of the stage system are needed.
"""

from __future__ import annotations

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from rbjax.errors import InputError
from rbjax.lanes import batch_first, matvec
from rbjax.solvers.groups import OnGroup, Vector

IN_TIME = (diffrax.ODETerm, OnGroup)  # dy = f dt: f times the length of a step
IN_OTHERS = (diffrax.ControlTerm, diffrax.UnderdampedLangevinDiffusionTerm)


class Field(eqx.Module):
    """(t, y) -> rate, in the solver's time, which runs forwards.

    `terms` are those of diffrax, or a function (t, y, *args) -> rate. `unravel` rebuilds the state
    from one vector y, as `flattened` makes it.
    """

    terms: Any
    args: Any
    unravel: Any = None

    def __check_init__(self):
        for part in _parts(self.terms):
            if isinstance(part, IN_OTHERS):
                raise InputError(
                    f"{type(part).__name__}: the solver takes rates, "
                    "expected a term in time only; ControlTerm.to_ode() makes one from a control "
                    "that has a derivative"
                )

    def __call__(self, t: Any, y: Any) -> Any:
        return _rate(self, t, y)


def field(terms: Any, args: Any) -> Field:
    """The vector field of an ordinary differential equation, in the solver's time."""
    return Field(terms, args)


def forwards(terms: Any, t: Any) -> Any:
    """1, of the dtype of t, or -1 where the caller's time runs backwards."""
    return jax.tree.leaves(_unit(terms, t))[0]  # a sum of terms has as many


def _unit(terms: Any, t: Any) -> Any:
    """The control over one unit of the solver's time."""
    return terms.contr(jnp.zeros_like(t), jnp.ones_like(t))


def _parts(terms: Any) -> list[Any]:
    """The terms of a sum, without diffrax's wrappers."""
    whole = (*IN_TIME, *IN_OTHERS)
    return jax.tree.leaves(terms, is_leaf=lambda x: isinstance(x, whole))


def flattened(terms: Any, args: Any, t: Any, y: Any) -> tuple[Field, jax.Array]:
    """The field on vectors (n,), and y as a vector.

    A custom derivative rule sees only arguments. So differentiated values that the caller's
    function closes over become an argument.
    """
    for part in _parts(terms):
        if isinstance(part, OnGroup) and not isinstance(part.group, Vector):
            raise InputError(
                f"{type(part).__name__}: the term moves its state on the group "
                f"{type(part.group).__name__}, expected a vector field, as diffrax.ODETerm; "
                "rb.solvers.rkmk(4) and others for Lie groups take the term"
            )
    vector, unravel = ravel_pytree(y)
    f = Field(terms, args, unravel)
    numbers, rest = eqx.partition(f, eqx.is_array)

    def rate(t, y, numbers):
        return eqx.combine(numbers, rest)(t, y)

    opened, closed_over = jax.closure_convert(rate, t, vector, numbers)
    return Field(opened, (numbers, *closed_over), unravel) if closed_over else f, vector


@eqx.filter_jit
def _rate(f: Field, t: Any, y: Any) -> Any:
    if not isinstance(f.terms, diffrax.AbstractTerm):
        return f.terms(t, y, *f.args)
    if f.unravel is None:
        return f.terms.vf_prod(t, y, f.args, _unit(f.terms, t))
    rate = f.terms.vf_prod(t, f.unravel(y), f.args, _unit(f.terms, t))
    return ravel_pytree(rate)[0]


@eqx.filter_jit
def linearized(f: Field, t: Any, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """f(t, y) (n,) and J (n, n) of a field on vectors."""
    rate, push = jax.linearize(lambda y: f(t, y), y)
    return rate, jax.vmap(push, out_axes=-1)(jnp.eye(y.size, dtype=y.dtype))


@eqx.filter_custom_jvp
def rates(f: Field, t: jax.Array, y: jax.Array) -> jax.Array:
    """f at each of the stages t (s,), y (s, n)."""
    return batch_first(_batch(f, t, y))


def _batch(f: Field, t: jax.Array, y: jax.Array) -> jax.Array:
    return jax.vmap(f)(t, y)


@rates.def_jvp
def _tangent(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    f, t, y = primals
    moving = jax.tree.leaves(tangents[:2])
    if moving or tangents[2] is None:
        return batch_first(eqx.filter_jvp(_batch, primals, tangents))
    rate, jacobian = jax.vmap(lambda t, y: linearized(f, t, y))(t, y)
    return batch_first((rate, matvec(jacobian, tangents[2])))
