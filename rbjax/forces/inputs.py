"""Inputs of a robot: controls, generalized forces, wrenches on bodies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import check_array, check_arrays, check_takes
from rbjax.model import Model, State

#: function (t, state) -> value of an input
Source = Callable[[Any, State], jax.Array]


class Inputs(NamedTuple):
    """The inputs of a robot; None for an absent input.

    ctrl: controls (nu,).
    tau: generalized forces (nv,).
    wrenches: (nb, 6) [moment; force] on bodies, in world axes at the bodies' origins.
    """

    ctrl: Any = None
    tau: Any = None
    wrenches: Any = None


NO_INPUTS = Inputs()
NAMES = Inputs._fields

#: subject of an error message about each input
_RETURNED = Inputs("the control returned", "what tau returned", "what wrenches returned")


def shapes(model: Model) -> Inputs:
    """Return the shapes of a model's inputs."""
    return Inputs((model.nu,), (model.nv,), (model.nb, 6))


def check_returned(where: str, model: Model, k: int, value: Any, dtype: Any) -> jax.Array:
    """Check the value that a function returned for input k."""
    names = ("model.actuator_names", "the velocity coordinates", "model.body_names")
    fix = f": one {'row' if k == 2 else 'number'} for each of {names[k]}"
    return check_array(where, _RETURNED[k], value, shapes(model)[k], fix=fix).astype(dtype)


def evaluated(where: str, model: Model, sources: Inputs, t: Any, state: State) -> Inputs:
    """Evaluate the inputs that are functions at a time and state; keep arrays unchanged."""

    def value(k: int, source: Any) -> Any:
        if not callable(source):
            return source
        return check_returned(where, model, k, source(t, state), state.q.dtype)

    return Inputs(*(value(k, source) for k, source in enumerate(sources)))


def check_functions(where: str, given: Inputs) -> None:
    """Raise InputError if a callable input is not a function of (t, state)."""
    for name, f in zip(NAMES, given, strict=True):
        if callable(f):
            check_takes(where, name, f, "t", "state")


def inputs_at(where: str, model: Model, given: Inputs, t: Any, state: State) -> Inputs:
    """Evaluate the inputs at a time and state."""
    if not any(map(callable, given)):
        return given
    check_functions(where, given)
    state = check_arrays(where, model, {"state": state})["state"]
    return evaluated(where, model, given, t, state)


def joined(arrays: list[jax.Array]) -> jax.Array:
    """Concatenate inputs (..., n_k) to (..., sum of n_k)."""
    lead = jnp.broadcast_shapes(*(x.shape[:-1] for x in arrays))
    return jnp.concatenate([jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in arrays], -1)
