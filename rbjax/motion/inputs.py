"""Controls, generalized forces and wrenches over time: constants, arrays, or functions."""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.errors import InputError
from rbjax.forces.inputs import NAMES, Inputs, check_functions, check_returned, joined, shapes
from rbjax.model import Model, State

_FIXES = (
    "nu numbers for the controls; or a policy (t, state) -> (nu,), or None",
    "nv numbers; or a function (t, state) -> (nv,), or None",
    "wrenches on nb bodies; or a function (t, state) -> (nb, 6), or None",
)


class Held(eqx.Module):
    """A piecewise constant function (t, state) of time.

    starts: (n,) start time of each interval, s.
    rows: (n, ...) value on each interval.
    """

    starts: jax.Array
    rows: jax.Array

    def __call__(self, t: Any, state: State) -> jax.Array:
        last = (t >= self.starts[1:]).sum()
        return self.rows[last]


def inputs_between(where: str, model: Model, given: Inputs, ts: jax.Array) -> Inputs:
    """Check the inputs of a motion over the times ts (T,). Make arrays with T - 1 rows piecewise
    constant functions; keep constants and functions of (t, state)."""
    check_functions(where, given)
    out: list[Any] = []
    for name, x, own, fix in zip(NAMES, given, shapes(model), _FIXES, strict=True):
        if x is not None and not callable(x):
            rows = (ts.shape[0] - 1, *own)
            x = check_array(where, name, x, own, rows, fix=f": {fix}").astype(ts.dtype)
            x = Held(ts[:-1], x) if x.ndim > len(own) else x
        out.append(x)
    return Inputs(*out)


class Sources(eqx.Module):
    """The inputs of the steps of a rollout.

    rows: (steps, k), or (B, steps, k) for a batch: the array inputs side by side; None if none.
    functions: the inputs that are functions; None for each other input.
    listed: indices of the inputs in a row, in the order of its columns.
    """

    rows: jax.Array | None
    functions: Inputs
    listed: tuple[int, ...] = eqx.field(static=True)

    @property
    def has_functions(self) -> bool:
        """Whether any input is a function."""
        return any(f is not None for f in self.functions)

    def evaluate(self, model: Model, t: Any, state: State) -> jax.Array:
        """Evaluate the input functions and concatenate their values."""
        found = [
            check_returned("rollout", model, k, f(t, state), state.q.dtype).reshape(-1)
            for k, f in enumerate(self.functions)
            if f is not None
        ]
        return joined(found)

    def inputs(self, model: Model, *given: Any) -> Inputs:
        """Split the row of a step and the values of the functions into `Inputs`."""
        of_functions = tuple(k for k, f in enumerate(self.functions) if f is not None)
        out: list[Any] = [None, None, None]
        for numbers, which in zip(given, filter(None, (self.listed, of_functions)), strict=True):
            at = 0
            for k in which:
                shape = shapes(model)[k]
                n = math.prod(shape)
                out[k] = numbers[at : at + n].reshape(shape)
                at += n
        return Inputs(*out)


def check_sources(
    model: Model, given: Inputs, steps: int | None, batch: tuple[int, ...], dtype: Any
) -> tuple[Sources, int]:
    """Check the inputs of a rollout; return them as `Sources` with the number of steps."""
    arrays = {k: x for k, x in enumerate(given) if x is not None and not callable(x)}
    check_functions("rollout", given)
    if steps is None:
        for k, x in arrays.items():
            shape = shape_of("rollout", NAMES[k], x)
            axis = -1 - len(shapes(model)[k])
            if len(shape) >= -axis:
                steps = max(1, shape[axis])
                break
        else:
            for k, x in arrays.items():
                check_array("rollout", NAMES[k], x, shapes(model)[k], fix=f": {_FIXES[k]}")
            raise InputError(
                "rollout: steps is None, expected an integer unless an input has a row per step"
            )
    rows, listed = [], []
    for k, x in arrays.items():
        own = shapes(model)[k]
        due = [(*lead, int(steps), *own) for lead in dict.fromkeys([(), batch])]
        x = check_array("rollout", NAMES[k], x, *due, own, fix=f": a row a step, or {_FIXES[k]}")
        if x.ndim == len(own):
            x = jnp.broadcast_to(x, due[0])
        if math.prod(own):  # without actuators, ctrl gives only the number of steps
            listed.append(k)
            rows.append(x.reshape(*x.shape[: x.ndim - len(own)], -1).astype(dtype))
    functions = Inputs(*(x if callable(x) else None for x in given))
    return Sources(joined(rows) if rows else None, functions, tuple(listed)), int(steps)
