"""Where the inputs of a rollout come from: a row of numbers a step, or functions of (t, state)."""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax

from rbjax.dynamics.arguments import check_array, check_takes, shape_of
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs, check_returned, joined, shapes
from rbjax.model import Model, State

NAMES = ("ctrl", "tau", "wrenches")


class Sources(eqx.Module):
    """Inputs along the steps of a rollout.

    rows: (steps, k), or (B, steps, k) for a batch, of the inputs that are numbers; None if none is;
    functions: of the others, or None; listed: which inputs stand in a row, in this order.
    """

    rows: jax.Array | None
    functions: Inputs
    listed: tuple[int, ...] = eqx.field(static=True)

    @property
    def asks(self) -> bool:
        """Whether any input is a function."""
        return any(f is not None for f in self.functions)

    def asked(self, model: Model, t: Any, state: State) -> jax.Array:
        """What the functions return, side by side."""
        found = [
            check_returned("rollout", model, k, f(t, state), state.q.dtype).reshape(-1)
            for k, f in enumerate(self.functions)
            if f is not None
        ]
        return joined(found)

    def inputs(self, model: Model, *given: Any) -> Inputs:
        """The inputs of a step: of its row and of what the functions return, whichever there
        are."""
        answered = tuple(k for k, f in enumerate(self.functions) if f is not None)
        out: list[Any] = [None, None, None]
        for numbers, which in zip(given, filter(None, (self.listed, answered)), strict=True):
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
    """The checked inputs of a rollout, and how many steps they ask for."""
    arrays = {k: x for k, x in enumerate(given) if x is not None and not callable(x)}
    if steps is None:
        if not arrays:
            raise InputError(
                "rollout: steps is None, expected a number with a policy or no controls"
            )
        k, x = next(iter(arrays.items()))
        axis = -1 - len(shapes(model)[k])
        shape = shape_of("rollout", NAMES[k], x)
        steps = max(1, shape[axis]) if len(shape) >= -axis else 1
    fixes = (
        ": a row of nu numbers a step; or a policy (t, state) -> (nu,), or None",
        ": a row of nv numbers a step; or a function (t, state) -> (nv,), or None",
        ": wrenches on nb bodies a step; or a function (t, state) -> (nb, 6), or None",
    )
    rows, listed = [], []
    for k, x in arrays.items():
        own = shapes(model)[k]
        due = [(*lead, int(steps), *own) for lead in dict.fromkeys([(), batch])]
        x = check_array("rollout", NAMES[k], x, *due, fix=fixes[k])
        if math.prod(own):  # of a robot without actuators the controls only say how many steps
            listed.append(k)
            rows.append(x.reshape(*x.shape[: x.ndim - len(own)], -1).astype(dtype))
    functions = Inputs(*(x if callable(x) else None for x in given))
    for name, f in zip(NAMES, functions, strict=True):
        if f is not None:
            check_takes("rollout", name, f, "t", "state")
    return Sources(joined(rows) if rows else None, functions, tuple(listed)), int(steps)
