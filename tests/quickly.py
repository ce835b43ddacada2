"""`quick_jit`: what a program computes, without compiling it.

Most tests run a program once, on a few numbers: XLA compiles for a second what then takes a
millisecond. So a run without the slow tests records such a program as `jax.jit` does, and goes
through its equations one by one with numpy (numpy_rules.py, numpy_indexing.py); `begin` does so
with every small program. Equations without a rule are JAX's own, one by one. A run with the slow
tests compiles (conftest.py), and so does every test of what compilation does.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax._src import pjit
from jax._src.interpreters import pxla
from jax.extend import core

from rbjax import compiling
from rbjax.threads.control import over_time
from tests import numpy_indexing  # noqa: F401, for its rules
from tests.numpy_rules import ALIKE, RULES, TRANSCENDENTAL, rule
from tests.robots import QUICK

by_xla = True  # conftest.py says otherwise
# An equation takes XLA 0.3 ms to compile, and numpy 3 us each time, one left to JAX 60 us.
TIMES, LEFT, WHILE = 60, 20, 1000  # a `while` is expected to take so many turns
TINY = 20  # equations: JAX takes as long to call what is compiled
KEPT = 1024  # programs


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
        if by_xla or jax.config.jax_disable_jit or any(map(_is_placed, leaves)):
            return jitted(*args, **kwargs)
        traced = jitted.trace(*args, **kwargs)
        if next(_calls(traced.jaxpr)) > _length(traced.jaxpr).calls:
            return jitted(*args, **kwargs)
        return jax.tree.unflatten(traced.out_tree, _evaluated(traced.jaxpr, leaves))

    return call


def begin() -> None:
    """From now on numpy evaluates: `quick_jit`, what rbjax compiles outside of any `jit`, and what
    JAX is about to compile, if it is small: programs of `jax.jit`, and operations outside of them,
    each of which JAX compiles for each shape. JAX has no option for that, so this replaces the
    function that it calls for programs that are not compiled yet."""
    global by_xla
    by_xla, compiling.outermost = False, quick_jit
    compile_and_run = pjit._pjit_call_impl_python  # of jax 0.10 and 0.11

    def run(*args: Any, **how: Any) -> tuple:
        closed = how["jaxpr"]
        if by_xla or not (_is_plain(args, how) and _is_for_numpy(closed)):
            return compile_and_run(*args, **how)
        length = _length(closed)
        if length.written > TINY and next(_calls(closed)) > length.calls:
            return compile_and_run(*args, **how)
        return _evaluated(closed, args), None, None, []  # nothing compiled that JAX may keep

    pjit._pjit_call_impl_python = run


def let_go() -> None:
    """Keeps none of the programs, which hold their constants."""
    for kept in (_is_for_numpy, _length, _calls, _evaluator):
        kept.cache_clear()


def _is_plain(args: Sequence[Any], how: dict[str, Any]) -> bool:
    """Whether a program says nothing about devices, memory or the compiler."""
    places = itertools.chain(how["in_shardings"], how["out_shardings"])
    if how["compiler_options_kvs"] or any(how["donated_invars"]) or jax.config.jax_default_device:
        return False
    if any(type(s).__name__ != "UnspecifiedValue" for s in places):
        return False
    return not any(map(_is_placed, args))


def _is_placed(x: Any) -> bool:
    """Whether an argument says on which devices it is."""
    return isinstance(x, jax.Array) and x.committed


@functools.lru_cache(maxsize=KEPT)
def _is_for_numpy(closed: core.ClosedJaxpr) -> bool:
    """Whether numpy can evaluate nearly all of it in less time than XLA takes to compile it."""
    if closed.effects or _length(closed).calls < 1:
        return False
    equations = list(_equations(closed.jaxpr))
    return len(equations) >= 10 * sum(_by_numpy(e) is None for e in equations)


def _equations(jaxpr: core.Jaxpr) -> Iterator[Any]:
    for eqn in jaxpr.eqns:
        inside = list(core.jaxprs_in_params(eqn.params)) if eqn.primitive.name in PROGRAMS else []
        yield from itertools.chain.from_iterable(map(_equations, inside)) if inside else [eqn]


class Length(NamedTuple):
    """How many equations are written, and how many are done with all turns of loops."""

    written: int
    done: int

    @property
    def calls(self) -> float:
        """So often numpy takes no longer than XLA does once."""
        return TIMES * self.written / max(self.done, 1)


@functools.lru_cache(maxsize=KEPT)
def _length(closed: core.ClosedJaxpr) -> Length:
    return _length_of(closed.jaxpr)


@functools.lru_cache(maxsize=KEPT)
def _calls(closed: core.ClosedJaxpr) -> Iterator[int]:
    return itertools.count(1)


def _evaluated(closed: core.ClosedJaxpr, args: Sequence[Any]) -> list[jax.Array]:
    """The program's results, which its arguments share no memory with."""
    values = [_own(x, aval.dtype) for x, aval in zip(args, closed.in_avals, strict=True)]
    with np.errstate(all="ignore"):  # XLA is silent, too
        out = _evaluator(closed)(*values)
    return [_array(x, aval) for x, aval in zip(out, closed.out_avals, strict=True)]


def _array(x: Any, aval: Any) -> jax.Array:
    """JAX's array, as weakly typed as the program says: `jnp.asarray` cannot say so."""
    if _is_key(aval.dtype) or aval.dtype == jax.dtypes.float0:
        return x
    device = jax.local_devices()[0]
    where = jax.sharding.SingleDeviceSharding(device)
    return pxla.batched_device_put(aval, where, [np.asarray(x)], [device], committed=False)


def _length_of(jaxpr: core.Jaxpr) -> Length:
    written = done = 0
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        turns = {"scan": eqn.params.get("length", 1), "while": WHILE}.get(name, 1)
        known = name in ALIKE or (name in RULES and name not in TRANSCENDENTAL)
        inside = [_length_of(j) for j in core.jaxprs_in_params(eqn.params)]
        written += sum(n.written for n in inside) or 1
        done += turns * sum(n.done for n in inside) or (1 if known else LEFT)
    return Length(written, done)


def _number(x: Any, dtype: Any) -> Any:
    """An array of numpy; keys of random numbers stay JAX's."""
    return x if _is_key(dtype) else np.asarray(x, dtype)


def _own(x: Any, dtype: Any) -> Any:
    """One that nobody changes in place."""
    return np.array(x, dtype) if isinstance(x, np.ndarray) else _number(x, dtype)


def _is_key(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jax.dtypes.extended)


@functools.lru_cache(maxsize=KEPT)
def _evaluator(closed: core.ClosedJaxpr) -> Callable[..., list]:
    """A closed jaxpr as a function of numpy's arrays."""
    pairs = zip(closed.consts, closed.jaxpr.constvars, strict=True)
    consts = [_own(x, v.aval.dtype) for x, v in pairs]
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
    return _by_numpy(eqn) or _by_jax(eqn)


def _by_numpy(eqn: Any) -> Callable | None:
    name = eqn.primitive.name
    inside = next(core.jaxprs_in_params(eqn.params), None) is not None
    if not inside and any(_is_key(v.aval.dtype) for v in (*eqn.invars, *eqn.outvars)):
        return None
    if name in ALIKE:
        return ALIKE[name]
    return RULES[name](eqn) if name in RULES else None


def _by_jax(eqn: Any) -> Callable:
    many = eqn.primitive.multiple_results

    def run(*xs: Any) -> Any:
        with _compiled():
            out = eqn.primitive.bind(*xs, **eqn.params)
        out = [_number(x, x.dtype) for x in (out if many else [out])]
        return out if many else out[0]

    return run


@contextlib.contextmanager
def _compiled() -> Iterator[None]:
    """What numpy cannot evaluate does not come back from JAX to be evaluated."""
    global by_xla
    by_xla, before = True, by_xla
    try:
        yield
    finally:
        by_xla = before


# ---------------------------------------------------------------- programs within the program


def _closed(jaxpr: Any) -> Callable[..., list]:
    return _evaluator(jaxpr) if isinstance(jaxpr, core.ClosedJaxpr) else _steps(jaxpr)


CALLED = ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call",
          "remat2", "checkpoint", "custom_vmap_call")  # fmt: skip
PROGRAMS = {*CALLED, "cond", "while", "scan"}


@rule(*CALLED)
def _call(eqn):
    names = ("jaxpr", "call_jaxpr", "call")
    inside = next((eqn.params[name] for name in names if name in eqn.params), None)
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
