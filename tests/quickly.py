"""`quick_jit`: what a program computes, without compiling it.

Most tests run a program once, on a few numbers: XLA compiles for a second what then takes a
millisecond. So a run without the slow tests records such a program as `jax.jit` does, and goes
through its equations one by one with numpy. Equations that are not here are JAX's own, one by one;
so are transcendental functions, whose last digits are XLA's then. A run with the slow tests
compiles (conftest.py), and so does every test of what compilation does.
"""

from __future__ import annotations

import functools
import inspect
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from rbjax.threads.control import over_time
from tests.robots import QUICK

by_xla = True  # conftest.py says otherwise
# An equation takes XLA 0.3 ms to compile, and numpy 3 us each time.
LOOPS, WHILE = 60, 1000  # a `while` is expected to take so many turns
CALLS = 30  # of one program, after which it is compiled


def quick_jit(
    f: Callable, static_argnums: int | tuple[int, ...] = (), static_argnames: Iterable[str] = (),
    compiler_options: dict[str, Any] | None = QUICK,
) -> Callable:  # fmt: skip
    """`jax.jit(f)` for a few calls with small arrays."""
    names = set(static_argnames)
    static = {static_argnums} if isinstance(static_argnums, int) else set(static_argnums)
    if names:
        parameters = inspect.signature(f).parameters.values()
        places = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
        static |= {i for i, name in enumerate(places) if name in names}
    jitted = jax.jit(
        f, static_argnums=tuple(static), static_argnames=tuple(names),
        compiler_options=compiler_options,
    )  # fmt: skip

    @functools.wraps(f)
    def call(*args: Any, **kwargs: Any) -> Any:
        named = {name: x for name, x in kwargs.items() if name not in names}
        leaves = jax.tree.leaves(([x for i, x in enumerate(args) if i not in static], named))
        if any(isinstance(x, jax.core.Tracer) for x in leaves):  # within another program
            return f(*args, **kwargs)
        if by_xla or jax.config.jax_disable_jit:
            return jitted(*args, **kwargs)
        traced = jitted.trace(*args, **kwargs)
        if _is_long(traced.jaxpr) or next(_calls(traced.jaxpr)) > CALLS:
            return jitted(*args, **kwargs)
        avals = traced.jaxpr.in_avals
        values = [_number(x, aval.dtype) for x, aval in zip(leaves, avals, strict=True)]
        with np.errstate(all="ignore"):  # XLA is silent, too
            out = _evaluator(traced.jaxpr)(*values)
        return jax.tree.unflatten(traced.out_tree, [jnp.asarray(x) for x in out])

    return call


@functools.lru_cache(maxsize=64)
def _is_long(closed: core.ClosedJaxpr) -> bool:
    written, done = _length(closed.jaxpr)
    return done > LOOPS * written


@functools.lru_cache(maxsize=64)
def _calls(closed: core.ClosedJaxpr) -> Iterator[int]:
    return itertools.count(1)


def _length(jaxpr: core.Jaxpr) -> tuple[int, int]:
    """How many equations are written, and how many there are with all turns of loops."""
    written = done = 0
    for eqn in jaxpr.eqns:
        turns = {"scan": eqn.params.get("length", 1), "while": WHILE}.get(eqn.primitive.name, 1)
        inside = [_length(j) for j in core.jaxprs_in_params(eqn.params)]
        written += sum(w for w, _ in inside) or 1
        done += turns * sum(d for _, d in inside) or 1
    return written, done


def _number(x: Any, dtype: Any) -> Any:
    """An array of numpy; keys of random numbers stay JAX's."""
    return x if jnp.issubdtype(dtype, jax.dtypes.extended) else np.asarray(x, dtype)


@functools.lru_cache(maxsize=64)
def _evaluator(closed: core.ClosedJaxpr) -> Callable[..., list]:
    """A closed jaxpr as a function of numpy's arrays."""
    pairs = zip(closed.consts, closed.jaxpr.constvars, strict=True)
    consts = [_number(x, v.aval.dtype) for x, v in pairs]
    run = _steps(closed.jaxpr)
    return lambda *args: run(*consts, *args)


def _steps(jaxpr: core.Jaxpr) -> Callable[..., list]:
    """A jaxpr as a function of its constants and arguments: its equations, one after the other."""
    slots: dict[Any, int] = {}
    blank: list[Any] = []

    def slot(atom: Any) -> int:
        if isinstance(atom, core.Literal):
            blank.append(np.asarray(atom.val, atom.aval.dtype)[()])
            return len(blank) - 1
        if atom not in slots:
            slots[atom] = len(blank)
            blank.append(None)
        return slots[atom]

    start = [slot(v) for v in (*jaxpr.constvars, *jaxpr.invars)]
    steps = []
    for eqn in jaxpr.eqns:
        many = eqn.primitive.multiple_results
        into = [slot(v) for v in eqn.outvars]
        steps.append((_rule(eqn), [slot(v) for v in eqn.invars], into if many else into[0]))
    ends = [slot(v) for v in jaxpr.outvars]

    def run(*args: Any) -> list:
        values = blank.copy()
        for i, x in zip(start, args, strict=True):
            values[i] = x
        for f, where, into in steps:
            out = f(*[values[i] for i in where])
            if type(into) is int:
                values[into] = out
            else:
                for i, x in zip(into, out, strict=True):
                    values[i] = x
        return [values[i] for i in ends]

    return run


def _rule(eqn: Any) -> Callable:
    """What an equation does to numpy's arrays."""
    name = eqn.primitive.name
    if name in ALIKE:
        return ALIKE[name]
    found = RULES[name](eqn) if name in RULES else None
    return _by_jax(eqn) if found is None else found


def _by_jax(eqn: Any) -> Callable:
    bind = functools.partial(eqn.primitive.bind, **eqn.params)
    if eqn.primitive.multiple_results:
        return lambda *xs: [_number(x, x.dtype) for x in bind(*xs)]

    def one(*xs: Any) -> Any:
        x = bind(*xs)
        return _number(x, x.dtype)

    return one


ALIKE: dict[str, Callable] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative,
    "max": np.maximum, "min": np.minimum, "abs": np.abs, "sqrt": np.sqrt, "floor": np.floor,
    "ceil": np.ceil, "square": np.square, "is_finite": np.isfinite,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor,
    "not": np.invert, "stop_gradient": lambda x: x, "name": lambda x: x, "copy": lambda x: x,
    "copy_p": lambda x: x, "batch_first": lambda x: x, "batch_last": lambda x: x,
    "fusion_barrier": lambda *xs: xs, "optimization_barrier": lambda *xs: xs,
}  # fmt: skip
RULES: dict[str, Callable[[Any], Callable | None]] = {}


def rule(*names: str) -> Callable:
    return lambda f: RULES.update(dict.fromkeys(names, f)) or f


def _shape(eqn: Any) -> tuple[int, ...]:
    return eqn.outvars[0].aval.shape


def _floats(eqn: Any) -> bool:
    return all(np.issubdtype(v.aval.dtype, np.floating) for v in eqn.invars)


@rule("div")
def _div(eqn):
    return np.divide if _floats(eqn) else None


@rule("integer_pow")
def _integer_pow(eqn):
    return {2: lambda x: x * x, 3: lambda x: x * x * x}.get(eqn.params["y"])


@rule("convert_element_type")
def _convert(eqn):
    dtype = eqn.params["new_dtype"]
    if jnp.issubdtype(dtype, jax.dtypes.extended):
        return None
    return lambda x: x.astype(dtype)


@rule("select_n")
def _select(eqn):
    if eqn.invars[0].aval.dtype != bool or len(eqn.invars) != 3:
        return None
    return lambda which, no, yes: np.where(which, yes, no)


@rule("broadcast_in_dim")
def _broadcast(eqn):
    if len(eqn.invars) > 1:
        return None
    shape, dims = _shape(eqn), eqn.params["broadcast_dimensions"]
    given = eqn.invars[0].aval
    between = [1] * len(shape)
    for size, d in zip(given.shape, dims, strict=True):
        between[d] = size
    if tuple(between) == shape:
        return lambda x: np.reshape(x, shape)

    def full(x: Any) -> Any:
        out = np.empty(shape, given.dtype)
        out[...] = np.reshape(x, between)
        return out

    return full


@rule("reshape", "squeeze", "expand_dims")
def _reshape(eqn):
    if eqn.params.get("dimensions") and eqn.primitive.name == "reshape":
        return None
    shape = _shape(eqn)
    return lambda x: np.reshape(x, shape)


@rule("transpose")
def _transpose(eqn):
    order = eqn.params["permutation"]
    return lambda x: np.transpose(x, order)


@rule("slice")
def _slice(eqn):
    p = eqn.params
    strides = p["strides"] or (1,) * len(p["start_indices"])
    part = tuple(map(slice, p["start_indices"], p["limit_indices"], strides))
    return lambda x: x[part]


@rule("concatenate")
def _concatenate(eqn):
    axis = eqn.params["dimension"]
    return lambda *xs: np.concatenate(xs, axis)


@rule("stack")
def _stack(eqn):
    axis = eqn.params["axis"]
    return lambda *xs: np.stack(xs, axis)


@rule("unstack")
def _unstack(eqn):
    axis = eqn.params["axis"]
    return lambda x: list(np.moveaxis(x, axis, 0))


@rule("split")
def _split(eqn):
    at, axis = np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"]
    return lambda x: np.split(x, at, axis)


@rule("pad")
def _pad(eqn):
    config, shape = eqn.params["padding_config"], _shape(eqn)
    if any(low < 0 or high < 0 for low, high, _ in config):
        return None
    sizes = eqn.invars[0].aval.shape
    inside = tuple(
        slice(low, low + max(0, (size - 1) * (between + 1) + 1), between + 1)
        for (low, _, between), size in zip(config, sizes, strict=True)
    )

    def pad(x: Any, value: Any) -> Any:
        out = np.full(shape, value)
        out[inside] = x
        return out

    return pad


@rule("iota")
def _iota(eqn):
    if eqn.invars:
        return None
    p = eqn.params
    row = np.arange(p["shape"][p["dimension"]], dtype=p["dtype"])
    sizes = [-1 if d == p["dimension"] else 1 for d in range(len(p["shape"]))]
    full = np.broadcast_to(row.reshape(sizes), p["shape"])
    return lambda: full


REDUCTIONS = {"sum": np.sum, "max": np.max, "min": np.min, "or": np.any, "and": np.all}


@rule(*(f"reduce_{name}" for name in REDUCTIONS))
def _reduce(eqn):
    f, axes = REDUCTIONS[eqn.primitive.name.removeprefix("reduce_")], eqn.params["axes"]
    given = eqn.invars[0].aval
    if (f in (np.any, np.all) and given.dtype != bool) or given.size == 0:
        return None
    if f is np.sum:
        return lambda x: np.sum(x, axes, dtype=given.dtype)
    return lambda x: f(x, axes)


@rule("dot_general")
def _dot(eqn):
    (left, right), batch = eqn.params["dimension_numbers"]
    if batch != ((), ()) or not _floats(eqn):
        return None
    return lambda a, b: np.tensordot(a, b, (left, right))


# ---------------------------------------------------------------- programs within the program


def _closed(jaxpr: Any) -> Callable[..., list]:
    return _evaluator(jaxpr) if isinstance(jaxpr, core.ClosedJaxpr) else _steps(jaxpr)


@rule("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat2",
      "checkpoint")  # fmt: skip
def _call(eqn):
    inside = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
    return None if inside is None else _closed(inside)


@rule("cond")
def _cond(eqn):
    branches = [_closed(b) for b in eqn.params["branches"]]
    return lambda k, *xs: branches[min(max(int(k), 0), len(branches) - 1)](*xs)


@rule("while")
def _while(eqn):
    p = eqn.params
    cond, body = _closed(p["cond_jaxpr"]), _closed(p["body_jaxpr"])
    m, n = p["cond_nconsts"], p["body_nconsts"]

    def run(*xs: Any) -> Sequence[Any]:
        outside, inside, carry = xs[:m], xs[m : m + n], xs[m + n :]
        while cond(*outside, *carry)[0]:
            carry = body(*inside, *carry)
        return carry

    one = p["cond_jaxpr"].out_avals[0].shape == ()  # condition for the whole batch
    return run if one else None


@rule("scan")
def _scan(eqn):
    p, inside = eqn.params, eqn.params["jaxpr"].jaxpr
    carried = len(eqn.outvars) - over_time(eqn.outvars, inside.outvars)
    m = len(eqn.invars) - over_time(eqn.invars, inside.invars)
    body, n = _closed(p["jaxpr"]), m - carried
    outs = [v.aval for v in eqn.outvars[carried:]]
    order: Iterable[int] = range(p["length"])
    order = reversed(order) if p["reverse"] else order
    order = list(order)

    def run(*xs: Any) -> list:
        fixed, carry, rows = xs[:n], list(xs[n:m]), xs[m:]
        ys = [np.empty(a.shape, a.dtype) for a in outs]
        for k in order:
            out = body(*fixed, *carry, *(x[k] for x in rows))
            carry = out[: m - n]
            for y, row in zip(ys, out[m - n :], strict=True):
                y[k] = row
        return [*carry, *ys]

    return run
