"""Lowers the jaxpr of one sample to the program of one thread.

`Lowering.run` visits the equations. The rule of each primitive (`RULES`) maps input arrays to
output arrays and emits statements. Slices, reshapes and transposes need no statements. The stacked
results of a scan are stored directly in the memory of the kernel's result, without a copy.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Primitive, Var

from rbjax._jax_compat import CALLS, JAXPRS, expanded
from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.statements import Unsupported, Value
from rbjax.compiler.lower.arrays import (
    FEW,
    ThreadArray,
    View,
    fold_if_constant,
    materialize,
    to_scalars,
    write_to,
)
from rbjax.compiler.lower.delayed import Delayed


class Aval(Protocol):
    """The shape and the dtype of a variable of a jaxpr."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def dtype(self) -> np.dtype: ...
    @property
    def size(self) -> int: ...
    @property
    def ndim(self) -> int: ...


class Atom(Protocol):
    """A variable or a constant of a jaxpr."""

    @property
    def aval(self) -> Aval: ...


class Equation(Protocol):
    """An equation of a jaxpr (`jax.extend.core.JaxprEqn`, whose types lack shapes)."""

    @property
    def primitive(self) -> Primitive: ...
    @property
    def invars(self) -> Sequence[Atom]: ...
    @property
    def outvars(self) -> Sequence[Atom]: ...
    @property
    def params(self) -> dict[str, Any]: ...


Rule = Callable[["Lowering", Equation, list], list]
RULES: dict[str, Rule] = {}
#: rules that store results at given places: f(lowering, equation, inputs, places)
WRITERS: dict[str, Callable[[Lowering, Equation, list, list], list]] = {}


#: the dtype of a threefry key; the low half is the first of its two 32-bit numbers
KEY = np.dtype(np.uint64)
#: the dtypes that a thread supports
DTYPES = {np.dtype(x) for x in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?")}
#: primitives whose rules accept `Delayed` arrays
TAKES_DELAYED: set[str] = set()
#: delayed entries of at most this many operations are computed again at each use
CHEAP = 4
#: for each primitive, the positions of arguments that its rule does not read; passed as None
UNREAD: dict[str, tuple[int, ...]] = {}


def accepts_delayed(*names: str) -> None:
    TAKES_DELAYED.update(names)


def rule(*names: str, unread: tuple[int, ...] = ()) -> Callable[[Rule], Rule]:
    """Register the decorated function as the lowering rule of these primitives.
    unread: positions of arguments that the rule does not read."""

    def register(f: Rule) -> Rule:
        RULES.update(dict.fromkeys(names, f))
        UNREAD.update(dict.fromkeys(names, unread) if unread else {})
        return f

    return register


def placing_rule(*names: str) -> Callable:
    """Register the decorated rule, which also receives the memory in which to store its results."""

    def register(f: Callable) -> Callable:
        WRITERS.update(dict.fromkeys(names, f))
        return f

    return register


@dataclass(frozen=True, slots=True)
class Needs:
    """The part of a jaxpr that its results depend on.

    last: for each variable, the number of the last equation that reads it.
    uses: for each variable, how often it is read.
    equations: (number, equation, inputs that it reads) of each needed equation.
    """

    jaxpr: Jaxpr
    last: dict[Any, int]
    uses: Counter
    equations: list[tuple[int, Any, list]]


class Lowering:
    """A translator of jaxprs to statements, which it emits with a `Builder`."""

    def __init__(self, builder: Builder):
        self.b = builder
        self.needs: dict[int, Needs] = {}

    def closed(
        self, closed: ClosedJaxpr, args: Sequence[ThreadArray], places: Sequence[View | None] = ()
    ) -> list[ThreadArray]:
        return self.run(closed.jaxpr, closed.consts, args, places)

    def run(
        self,
        jaxpr: Jaxpr,
        consts: Sequence[Any],
        args: Sequence[ThreadArray],
        places: Sequence[View | None] = (),
    ) -> list[ThreadArray]:
        """Emit the statements of a jaxpr, and return its results.
        places: for each result, the view of memory in which to store it, or None."""
        needs = self.analyze(jaxpr)
        last = needs.last
        env: dict[Any, ThreadArray] = {}

        def bind(var: Any, value: ThreadArray) -> None:
            if var in last:
                if isinstance(value, Delayed) and needs.uses[var] > 1 and value.cost > CHEAP:
                    value = materialize(self.b, value)
                env[var] = value
                _count_reference(value, 1)

        def read(atom: Any) -> ThreadArray:
            return known(atom.val, atom.aval) if isinstance(atom, Literal) else env[atom]

        for var, const in zip(jaxpr.constvars, consts, strict=True):
            entries = isinstance(const, np.ndarray) and const.dtype == object
            held = entries or isinstance(const, View | Delayed)
            bind(var, const if held else known(const, var.aval))
        for var, arg in zip(jaxpr.invars, args, strict=True):
            bind(var, arg)
        if self.b.in_team:
            wanted = _places(jaxpr, places, lambda v: v in last and self._joined(v))
        else:
            wanted = _places(jaxpr, places)
        for n, eqn, atoms in needs.equations:
            ins = [None if atom is None else read(atom) for atom in atoms]
            for atom in atoms:
                if not isinstance(atom, Literal) and last.get(atom) == n and atom in env:
                    _count_reference(env.pop(atom), -1)
            outs = self._equation(eqn, ins, [wanted.get(v) for v in eqn.outvars])
            for var, out in zip(eqn.outvars, outs, strict=True):
                place = wanted.get(var)
                if isinstance(out, Delayed) and place is not None and place.array.shared:
                    write_to(self.b, place, out)  # a piece of a concatenation
                    out = place
                bind(var, out)
        outs = [read(atom) for atom in jaxpr.outvars]
        for value in env.values():
            _count_reference(value, -1)
        for i, place in enumerate(places):
            if place is not None:
                write_to(self.b, place, outs[i])
                outs[i] = place
        return outs

    def _equation(self, eqn: Any, ins: list, places: list[View | None]) -> list[ThreadArray]:
        name = eqn.primitive.name
        if name == "custom_lin":  # JAX's form of a custom_vjp function under jvp
            raise TypeError("forward-mode autodiff of a function that has only a reverse rule")
        for var in eqn.outvars:
            dtype = dtype_of(var.aval)
            fits = dtype is None or dtype in DTYPES
            call = inner_jaxpr(eqn) or expanded(eqn)  # then the inner jaxpr raises the error
            if not fits and (name in RULES or call is None):
                raise Unsupported(f"{name} of type {dtype}")
        if name not in TAKES_DELAYED and (name in WRITERS or name in RULES):
            ins = [materialize(self.b, x) for x in ins]
        if name in WRITERS:
            return WRITERS[name](self, eqn, ins, places)
        if name in RULES:
            return [
                fold_if_constant(out, dtype_of(var.aval)) if isinstance(out, np.ndarray) else out
                for out, var in zip(RULES[name](self, eqn, ins), eqn.outvars, strict=True)
            ]
        inner, high = inner_jaxpr(eqn), expanded(eqn)
        if high is not None:
            inner = jax.make_jaxpr(high)(*(v.aval for v in eqn.invars))
        if inner is None:
            raise Unsupported(name)
        return self.closed(inner, ins, places)

    def _joined(self, var: Any) -> View | None:
        """Reserve memory for the result of a concatenation, in which a team stores the pieces."""
        aval = var.aval
        if aval.size <= FEW or dtype_of(aval) not in DTYPES:
            return None
        array = self.b.local(dtype_of(aval), aval.size)
        array.write_once = True
        return View.of(array, aval.shape)

    def analyze(self, jaxpr: Jaxpr) -> Needs:
        """Return the part of a jaxpr that its results depend on. The result is cached."""
        known = self.needs.get(id(jaxpr))
        if known is None or known.jaxpr is not jaxpr:
            known = self.needs[id(jaxpr)] = self._analyze(jaxpr)
        return known

    def _analyze(self, jaxpr: Jaxpr) -> Needs:
        end = len(jaxpr.eqns)
        last: dict[Any, int] = {v: end for v in jaxpr.outvars if not isinstance(v, Literal)}
        equations = []
        uses = Counter(v for v in jaxpr.outvars if not isinstance(v, Literal))
        for n, eqn in reversed(list(enumerate(jaxpr.eqns))):
            if not eqn.effects and not any(v in last for v in eqn.outvars):
                continue
            atoms: list[Any] = list(eqn.invars)
            for k in self._unread(eqn):
                atoms[k] = None
            for atom in atoms:
                if atom is not None and not isinstance(atom, Literal):
                    last.setdefault(atom, n)
                    uses[atom] += 1
            equations.append((n, eqn, atoms))
        return Needs(jaxpr, last, uses, equations[::-1])

    def _unread(self, eqn: Any) -> Sequence[int]:
        inner = inner_jaxpr(eqn)
        if inner is None or eqn.primitive.name in RULES:
            return UNREAD.get(eqn.primitive.name, ())
        last = self.analyze(inner.jaxpr).last
        return [k for k, v in enumerate(inner.jaxpr.invars) if v not in last]

    @contextmanager
    def pinned(self, values: Sequence[ThreadArray]) -> Iterator[None]:
        """Prevent in-place updates of these values, which are read again, inside a `with` block."""
        for value in values:
            _count_reference(value, 1)
        try:
            yield
        finally:
            for value in values:
                _count_reference(value, -1)

    def to_scalars(self, x: ThreadArray) -> np.ndarray:
        return to_scalars(self.b, x)

    def to_scalar(self, x: ThreadArray) -> Value:
        """Return the `Value` of an array that has one entry and no axes."""
        return self.to_scalars(x).item()

    def evaluate(self, f: Callable, *args: ThreadArray, avals: Sequence[Aval]) -> list[ThreadArray]:
        """Trace a JAX function, emit its statements, and return its results."""
        return self.closed(jax.make_jaxpr(f)(*avals), args)


def dtype_of(aval: Aval) -> Any:
    """Return the dtype of an array's entries. A random key is one 64-bit integer."""
    dtype: Any = getattr(aval, "dtype", None)
    return KEY if is_key(dtype) and dtype.itemsize == KEY.itemsize else dtype


@functools.lru_cache(256)
def is_key(dtype: Any) -> bool:
    """Return whether a dtype is the dtype of JAX's random keys."""
    return jnp.issubdtype(dtype, jax.dtypes.prng_key)


def known(x: Any, aval: Any) -> np.ndarray:
    """Return a constant of a jaxpr as a numpy array of its dtype."""
    if is_key(getattr(x, "dtype", None)):
        return np.asarray(jax.random.key_data(x)).view(KEY)[..., 0]
    return np.asarray(x, aval.dtype)


def inner_jaxpr(eqn: Equation) -> ClosedJaxpr | None:
    """Return the jaxpr that an equation calls (`jit`, custom derivative, `checkpoint`), or None."""
    if eqn.primitive.name not in CALLS:
        return None
    for name in JAXPRS:
        inner = eqn.params.get(name)
        if isinstance(inner, ClosedJaxpr):
            return inner
        if isinstance(inner, Jaxpr):
            return ClosedJaxpr(inner, ())
    return None


def _count_reference(value: ThreadArray, change: int) -> None:
    if isinstance(value, View):
        value.array.reference_count += change
    elif isinstance(value, Delayed):
        for array in value.sources:
            array.reference_count += change


#: primitives that only move entries
MOVES = {
    "slice", "transpose", "reshape", "squeeze", "expand_dims", "broadcast_in_dim", "rev", "iota",
}  # fmt: skip


def _places(
    jaxpr: Jaxpr, places: Sequence[View | None], joined: Callable | None = None
) -> dict[Any, View]:
    """Return the variables of a jaxpr that should be stored at given places in memory.

    Places of results propagate back through equations that only move entries.
    joined: reserves memory for a concatenation of computed pieces.
    """
    wanted: dict[Any, View] = {}
    inputs = {*jaxpr.invars, *jaxpr.constvars}

    def want(var: Any, place: View | None) -> None:
        if place is not None and not isinstance(var, Literal) and var not in inputs:
            wanted.setdefault(var, place)

    def same_entries(var: Any, place: View) -> None:
        want(var, place.reshape_view(var.aval.shape))

    for var, place in zip(jaxpr.outvars, places, strict=False):
        want(var, place)
    if not wanted and joined is None:
        return wanted
    moved = {v for eqn in jaxpr.eqns if eqn.primitive.name in MOVES for v in eqn.outvars}
    uses = Counter(v for eqn in jaxpr.eqns for v in eqn.invars if not isinstance(v, Literal))
    uses.update(v for v in jaxpr.outvars if not isinstance(v, Literal))
    eqns: Sequence[Any] = jaxpr.eqns
    for eqn in reversed(eqns):
        if eqn.primitive.name == "fusion_barrier":
            for var, made in zip(eqn.invars, eqn.outvars, strict=True):
                shape = getattr(made.aval, "shape", ())
                want(var, wanted.get(made) if shape else None)
            continue
        place = wanted.get(eqn.outvars[0]) if eqn.outvars else None
        if place is None and joined is not None and eqn.primitive.name == "concatenate":
            pieces: list[Any] = eqn.invars
            if any(v not in moved and v not in inputs for v in pieces if isinstance(v, Var)):
                place = joined(eqn.outvars[0])
                want(eqn.outvars[0], place)
        if place is None:
            continue
        match eqn.primitive.name:
            case "reshape" | "squeeze" | "expand_dims" | "name" | "reduce_precision":
                same_entries(eqn.invars[0], place)
            case "broadcast_in_dim" if eqn.invars[0].aval.size == eqn.outvars[0].aval.size:
                same_entries(eqn.invars[0], place)
            case "stack" if uses[eqn.outvars[0]] > 1:  # it is read again, so it stays in registers
                del wanted[eqn.outvars[0]]
            case "stack":
                axis = eqn.params.get("axis", eqn.params.get("dimension", 0))
                for k, var in enumerate(eqn.invars):
                    box = [slice(0, n, 1) for n in place.shape]
                    box[axis] = slice(k, k + 1, 1)
                    same_entries(var, place.slice_box(box))
            case "concatenate":
                start, axis = 0, eqn.params["dimension"]
                atoms: list[Any] = eqn.invars
                for var in atoms:
                    stop = start + var.aval.shape[axis]
                    box = [slice(0, n, 1) for n in place.shape]
                    box[axis] = slice(start, stop, 1)
                    want(var, place.slice_box(box))
                    start = stop
    return wanted
