"""The vector field of a step, y' = f(t, y), and its Jacobian J = df/dy.

Both are jitted, so a robot's field of thousands of operations is traced only once. Derivatives of
the stages of an implicit method use J, with n columns per stage.
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

IN_TIME = (diffrax.ODETerm, OnGroup)  # terms dy = f dt, with time as the control
IN_OTHERS = (diffrax.ControlTerm, diffrax.UnderdampedLangevinDiffusionTerm)


class SolverField(eqx.Module):
    """The function (t, y) -> rate in the solver's time, which always runs forwards.

    Fields:
        terms: a diffrax term, or a function (t, y, *args) -> rate.
        args: the user's arguments.
        unravel: function that rebuilds the state from a vector (`flatten`); None if y is the state.
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


def time_direction(terms: Any, t: Any) -> Any:
    """Return 1, with the dtype of t, or -1 if the caller's time runs backwards."""
    return jax.tree.leaves(_unit(terms, t))[0]  # a sum of terms has one control per term


def _unit(terms: Any, t: Any) -> Any:
    """Return the diffrax control over one unit of the solver's time. It is 1 or -1 for an
    ODE term."""
    return terms.contr(jnp.zeros_like(t), jnp.ones_like(t))


def _parts(terms: Any) -> list[Any]:
    """Return the ODE terms of a sum, and the terms of other types, without diffrax's wrappers."""
    whole = (*IN_TIME, *IN_OTHERS)
    return jax.tree.leaves(terms, is_leaf=lambda x: isinstance(x, whole))


def flatten(terms: Any, args: Any, t: Any, y: Any) -> tuple[SolverField, jax.Array]:
    """Return the field on vectors (n,), and y as a vector. Traced values in the closure of the
    user's function become arguments, which custom derivative rules require."""
    for part in _parts(terms):
        if isinstance(part, OnGroup) and not isinstance(part.group, Vector):
            raise InputError(
                f"{type(part).__name__}: the term moves its state on the group "
                f"{type(part.group).__name__}, expected a vector field, as diffrax.ODETerm; "
                "rb.solvers.rkmk(4) and others for Lie groups take the term"
            )
    vector, unravel = ravel_pytree(y)
    f = SolverField(terms, args, unravel)
    numbers, rest = eqx.partition(f, eqx.is_array)

    def rate(t, y, numbers):
        return eqx.combine(numbers, rest)(t, y)

    opened, closed_over = jax.closure_convert(rate, t, vector, numbers)
    return SolverField(opened, (numbers, *closed_over), unravel) if closed_over else f, vector


@eqx.filter_jit
def _rate(f: SolverField, t: Any, y: Any) -> Any:
    if not isinstance(f.terms, diffrax.AbstractTerm):
        return f.terms(t, y, *f.args)
    if f.unravel is None:
        return f.terms.vf_prod(t, y, f.args, _unit(f.terms, t))
    rate = f.terms.vf_prod(t, f.unravel(y), f.args, _unit(f.terms, t))
    return ravel_pytree(rate)[0]


@eqx.filter_jit
def linearize(f: SolverField, t: Any, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return f(t, y) (n,) and J (n, n) of a field on vectors."""
    rate, push = jax.linearize(lambda y: f(t, y), y)
    return rate, jax.vmap(push, out_axes=-1)(jnp.eye(y.size, dtype=y.dtype))


@eqx.filter_custom_jvp
def evaluate_stages(f: SolverField, t: jax.Array, y: jax.Array) -> jax.Array:
    """Evaluate a vector field f at all stages of a step: times t (s,) and states y (s, n)."""
    return batch_first(_batch(f, t, y))


def _batch(f: SolverField, t: jax.Array, y: jax.Array) -> jax.Array:
    return jax.vmap(f)(t, y)


@evaluate_stages.def_jvp
def _tangent(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    f, t, y = primals
    moving = jax.tree.leaves(tangents[:2])
    if moving or tangents[2] is None:
        return batch_first(eqx.filter_jvp(_batch, primals, tangents))
    rate, jacobian = jax.vmap(lambda t, y: linearize(f, t, y))(t, y)
    return batch_first((rate, matvec(jacobian, tangents[2])))
