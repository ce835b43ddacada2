"""Checks of algorithm arguments: shapes, dtypes, finite values, quaternions, models."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import floating_array, instance
from rbjax.errors import InputError
from rbjax.joints import Flexible
from rbjax.model import Frame, Model, State
from rbjax.model.record import FEW

#: argument name -> its shape in terms of the model
SHAPES: dict[str, Callable[[Model], tuple[int, ...]]] = {
    "q": lambda m: (m.nq,),
    "q0": lambda m: (m.nq,),
    "q1": lambda m: (m.nq,),
    "v": lambda m: (m.nv,),
    "a": lambda m: (m.nv,),
    "dq": lambda m: (m.nv,),
    "tau": lambda m: (m.nv,),
    "x": lambda m: (m.nx,),
    "report": lambda m: (2,),
    "ctrl": lambda m: (m.nu,),
    "wrenches": lambda m: (m.nb, 6),
    "point": lambda m: (3,),
    "t": lambda m: (),
}

#: arguments that may be None
OPTIONAL = ("ctrl", "tau", "wrenches", "point")
#: arguments that set the dtype of the computation; all others are cast to it
LEADING = ("q", "q0", "q1", "v")


def check_arrays(
    where: str,
    model: Model,
    given: dict[str, Any],
    batch: tuple[int, ...] = (),
    required: Sequence[str] = (),
) -> dict[str, Any]:
    """Check the shapes and the untraced values of arrays, and cast them to the dtype of q and v.

    Args:
        given: argument name -> value; a `State` is the argument "state".
        batch: the leading axes of every array.
        required: the names of optional arguments that must not be None.
    """
    check_model(where, model)
    given, stated = dict(given), "state" in given
    step = given.pop("dt", None)
    if stated:
        state = given.pop("state")
        instance(where, "state", state, State, "rbjax.State(q, v)")
        given |= {"q": state.q, "v": state.v}
        if state.x is not None:
            given["x"] = state.x
        if state.report is not None:
            given["report"] = state.report
        memory = state.memory
    out: dict[str, Any] = {}
    for name, value in given.items():
        if value is not None or name not in OPTIONAL or name in required:
            out[name] = check_array(where, name, value, (*batch, *SHAPES[name](model)))
    leading = [x for name, x in out.items() if name in LEADING]
    dtype = jnp.result_type(*leading) if leading else jnp.result_type(float)
    out = {name: value.astype(dtype) for name, value in out.items()}
    for name in ("q", "q0", "q1"):
        if name in out:
            check_quaternions(where, name, model, out[name])
            check_links(where, name, model, out[name])
    if step is not None:
        out["dt"] = check_step(where, "dt", step, dtype)
    if stated:
        x = out.pop("x", None) if model.nx else None  # without force states, x is always None
        start = model.start(dtype) if x is None else None
        if start is not None:
            x = jnp.broadcast_to(start, (*batch, model.nx))
        out["state"] = State(out.pop("q"), out.pop("v"), x, memory, out.pop("report", None))
    return out


def check_model(where: str, model: Any, fix: str = "for a batch of models, use jax.vmap") -> None:
    """Raise `InputError` unless `model` is one model. `fix` is the advice for a batch of models."""
    instance(where, "model", model, Model, "a Model (rbjax.load)")
    several = model.several()
    if several is not None:
        name, shape, axes = several
        raise InputError(
            f"{where}: the model's {name} has shape {shape}, expected {axes} "
            f"{'axis' if axes == 1 else 'axes'}; {fix}"
        )


def check_static(where: str, kind: str, value: Any) -> None:
    """Raise `InputError` unless a static argument has the type that its kind requires.

    The kinds are "body", "site", "integrator", "contact", "dynamics" and "constraints", whose type
    `formulation_of` checks. None and strings always pass.
    """
    index = kind in ("body", "site") and isinstance(value, int) and not isinstance(value, bool)
    frame = kind == "body" and isinstance(value, Frame)
    if value is None or isinstance(value, str) or index or frame:
        return
    if kind in ("body", "site"):
        raise InputError(
            f"{where}: {kind} is {type(value).__name__}, expected one of model.{kind}_names"
        )
    advances = kind in ("dynamics", "contact") and hasattr(value, "advance_velocity")
    if kind == "constraints" and isinstance(value, Hashable):
        return
    if kind == "contact" and not (callable(value) or advances):
        raise InputError(
            f"{where}: contact is {type(value).__name__}, expected a name or a law; "
            "CompliantContact is a force element: model.replace(contact=None).with_forces(...)"
        )
    if not (callable(value) or advances) or not isinstance(value, Hashable):
        raise InputError(
            f"{where}: {kind} is {type(value).__name__}, expected "
            f"{'a name or a function' if kind == 'integrator' else 'a function'} that is hashable"
        )


def check_moves(where: str, model: Model) -> None:
    """Raise `InputError` if the model has no joints."""
    if not model.nv:
        raise InputError(
            f"{where}: the model has no joints, so nothing moves; give a body of the file a "
            "<joint/> or <freejoint/>, or load a URDF with floating_base=True"
        )


def check_array(
    where: str, name: str, value: Any, *shapes: tuple[int, ...], fix: str = ""
) -> jax.Array:
    """Convert a value to a floating-point array of one of the shapes, finite unless traced."""
    expected = " or ".join(map(str, shapes)) + fix
    given = () if isinstance(value, type) else getattr(value, "shape", ())
    if shapes[0] in (given[1:], given[:-1]) and not fix:
        expected += "; for a batch use jax.vmap"
    x = floating_array(where, name, value, shapes.__contains__, expected)
    if not isinstance(x, jax.core.Tracer):
        on_host = isinstance(value, np.ndarray) and value.dtype == x.dtype
        xp, values = module_for_check(value if on_host else x)
        with jax.ensure_compile_time_eval():  # constants in traced code stay concrete
            finite = xp.isfinite(values)
            all_finite = bool(finite.all())
        if not all_finite:
            at = tuple(np.argwhere(~np.asarray(finite))[0])
            place = f"[{', '.join(map(str, at))}]" if at else ""
            wrong = np.asarray(values)[at]
            raise InputError(f"{where}: {name}{place} is {wrong}, expected finite values")
    return x


def module_for_check(x: Any) -> tuple[Any, Any]:
    """Return the module that checks an array, and the array: numpy if it is small, else jax.numpy.
    Large arrays are checked on their device."""
    if isinstance(x, jax.Array) and x.size > FEW:
        return jnp, x
    return np, np.asarray(x)


def shape_of(where: str, name: str, value: Any) -> tuple[int, ...]:
    """Return the shape of an array. Raise `InputError` if its rows have different lengths."""
    try:
        return tuple(map(int, np.shape(value)))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{where}: {name} is {type(value).__name__}, expected an array of numbers with rows "
            "of equal length"
        ) from error


def check_step(where: str, name: str, value: Any, dtype: Any) -> jax.Array:
    """Check that a time step is a positive number, and cast it to the dtype."""
    if isinstance(value, bool | np.bool_):
        raise InputError(f"{where}: {name} is {value}, expected a positive step in seconds")
    step = check_array(where, name, value, (), fix=": a positive step in seconds")
    if not isinstance(step, jax.core.Tracer) and not np.asarray(step) > 0:  # also while tracing
        raise InputError(f"{where}: {name} is {value}, expected a positive step in seconds")
    return step.astype(dtype)


def check_takes(where: str, name: str, f: Any, *arguments: str) -> None:
    """Raise `InputError` unless f accepts these arguments. Functions without a signature pass."""
    due = f"a function ({', '.join(arguments)})"
    if not callable(f) or isinstance(f, type):
        got = f"the class {f.__name__}" if isinstance(f, type) else type(f).__name__
        raise InputError(f"{where}: {name} is {got}, expected {due}")
    try:
        taken = inspect.signature(f)
    except (TypeError, ValueError):  # builtins have no signature
        return
    try:
        taken.bind(*arguments)
    except TypeError as error:
        raise InputError(f"{where}: {name} takes {taken}, expected {due}") from error


def check_quaternions(where: str, name: str, model: Model, q: jax.Array) -> None:
    """Raise `InputError` if an untraced q contains a zero or infinite quaternion."""
    if isinstance(q, jax.core.Tracer):
        return
    xp, values = module_for_check(q)
    least = np.finfo(q.dtype).tiny
    for start in model.topology.quaternion_starts:
        # constants in traced code stay concrete
        with np.errstate(over="ignore", under="ignore"), jax.ensure_compile_time_eval():
            squared = xp.square(values[..., start : start + 4]).sum(-1)
            has_length = bool(((least <= squared) & (squared < np.inf)).all())
        if not has_length:
            finite = np.isfinite(np.asarray(squared)).all()
            kind = "a zero quaternion" if finite else "an infinite quaternion"
            raise InputError(
                f"{where}: {name}[{start}:{start + 4}] is {kind} (its squared length is 0 or "
                f"infinite in {values.dtype}), expected a unit one (w, x, y, z); "
                f"no rotation is (1, 0, 0, 0)"
            )


def check_links(where: str, name: str, model: Model, q: jax.Array) -> None:
    """Raise `InputError` if a flexible link cannot have its coordinates in an untraced q."""
    top, params = model.topology, model.joints.params
    if not top.frames or isinstance(q, jax.core.Tracer) or isinstance(params, jax.core.Tracer):
        return
    values, numbers, at = np.asarray(q), np.asarray(params), 0
    for joint, start, own in zip(top.joints, top.joint_q, top.joint_names, strict=True):
        end = at + len(joint.defaults)
        if isinstance(joint, Flexible):
            reason = joint.invalid(values[..., start : start + joint.nq], numbers[at:end])
            if reason is not None:
                raise InputError(f"{where}: {name} is out of range for the link {own!r}: {reason}")
        at = end
