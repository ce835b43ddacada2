"""Equations of jaxprs, their dependences, and the derivative of one.

JAX differentiates each kind of equation (primitive, parameters, shapes) once. The result is a jaxpr
of a few equations.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun, new_jaxpr_eqn

from rbjax._jax_compat import without_names

Atom = Any  # a variable or a literal of a jaxpr


def of(env: dict[Var, Atom], atoms: Sequence[Atom]) -> list[Atom]:
    """The atoms that stand for others."""
    return [a if isinstance(a, Literal) else env[a] for a in atoms]


def needed(
    eqns: Sequence[JaxprEqn], outs: Sequence[Atom], given: Sequence[Var], effects: Any = ()
) -> list[JaxprEqn]:
    """The equations that results need besides what is given, and those with effects, if any."""
    wanted, known, kept = {a for a in outs if isinstance(a, Var)}, set(given), []
    for eqn in reversed(eqns):
        if (effects and eqn.effects) or any(v in wanted and v not in known for v in eqn.outvars):
            kept.append(eqn)
            wanted.update(a for a in eqn.invars if isinstance(a, Var))
    return kept[::-1]


def reached(eqns: Sequence[JaxprEqn], start: Sequence[Atom]) -> set[Var]:
    """The variables that depend on some of these."""
    found = {a for a in start if isinstance(a, Var)}
    for eqn in eqns:
        if any(isinstance(a, Var) and a in found for a in eqn.invars):
            found.update(eqn.outvars)
    return found


def called(eqn: JaxprEqn) -> ClosedJaxpr:
    """The jaxpr that a call evaluates."""
    inner: Any = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())


def is_whole(eqn: JaxprEqn) -> bool:
    """Whether an equation may compute values and rates together: a loop, a branch, a call."""
    name = eqn.primitive.name
    plain = name == "threads_tangent" or name.startswith("scatter")
    return not plain and any(map(_calls, eqn.params.values()))


def _calls(x: Any) -> bool:
    if isinstance(x, tuple):
        return any(map(_calls, x))
    return callable(x) or isinstance(x, (Jaxpr, ClosedJaxpr))


def rule_of(
    eqn: JaxprEqn, moving: tuple[bool, ...], which: str, present: tuple[bool, ...]
) -> tuple[ClosedJaxpr, list[bool]]:
    """The derivative of one equation, and which of its results are not zero."""
    params = tuple(sorted(eqn.params.items()))
    key = Key(eqn.primitive, params, _avals(eqn.invars), _avals(eqn.outvars), moving, present)
    try:
        hash(key)
    except TypeError:
        return RULES[which](key)
    return (RULES[which] if is_whole(eqn) else CACHED[which])(key)


def _avals(atoms: Sequence[Atom]) -> tuple:
    """The kinds of values, without the axes of devices along which they vary: a rule is that of one
    sample."""
    return tuple(
        ShapedArray(x.shape, x.dtype, weak_type=x.weak_type) if type(x) is ShapedArray else x
        for x in (a.aval for a in atoms)
    )


@dataclass(frozen=True)
class Key:
    """A kind of equation, with the inputs that move and the results that have cotangents."""

    primitive: Any
    params: tuple
    ins: tuple
    outs: tuple
    moving: tuple[bool, ...]
    present: tuple[bool, ...]

    def call(self, args: Sequence[jax.Array]) -> list[jax.Array]:
        """The results of such an equation."""
        ins, outs = [Var(a) for a in self.ins], [Var(a) for a in self.outs]
        eqn = new_jaxpr_eqn(ins, outs, self.primitive, dict(self.params), frozenset[Any]())
        one = Jaxpr([], ins, outs, [eqn], frozenset[Any](), _no_notes())
        return jaxpr_as_fun(ClosedJaxpr(one, []))(*args)

    def parted(self, atoms: Sequence[Any]) -> tuple[list, list]:
        """The inputs that do not move, and those that do."""
        still = [a for a, m in zip(atoms, self.moving, strict=True) if not m]
        return still, list(itertools.compress(atoms, self.moving))

    def merged(self, still: Sequence[jax.Array], moved: Sequence[jax.Array]) -> list[jax.Array]:
        """The inputs, of those that do not move and those that do."""
        rest, along = iter(still), iter(moved)
        return [next(along) if m else next(rest) for m in self.moving]


def _tangent(key: Key) -> tuple[ClosedJaxpr, list[bool]]:
    """(args, rates) -> results and their rates that are not zero."""
    n, floats = len(key.ins), [jnp.issubdtype(a.dtype, jnp.floating) for a in key.outs]
    rates = key.parted(key.ins)[1]

    def both(*xs: jax.Array) -> list[jax.Array]:
        still, moved = key.parted(xs[:n])
        out, along = jax.jvp(lambda *m: key.call(key.merged(still, m)), moved, list(xs[n:]))
        return [*out, *itertools.compress(along, floats)]

    return _reaching(both, [*key.ins, *rates], n, len(key.outs), floats)


def _transposed(key: Key) -> tuple[ClosedJaxpr, list[bool]]:
    """(inputs that do not move, cotangents that are present) -> cotangents that are not zero."""
    still, moved = key.parted(key.ins)
    bars = list(itertools.compress(key.outs, key.present))

    def back(*xs: jax.Array) -> list[jax.Array]:
        def linear(*m: jax.Array) -> list[jax.Array]:
            return list(itertools.compress(key.call(key.merged(xs[: len(still)], m)), key.present))

        return list(jax.linear_transpose(linear, *moved)(list(xs[len(still) :])))

    return _reaching(back, [*still, *bars], len(still), 0, [True] * len(moved))


def _reaching(
    f: Callable, avals: Sequence[Any], first: int, plain: int, may: Sequence[bool]
) -> tuple[ClosedJaxpr, list[bool]]:
    """f traced, without those results after the first `plain` that depend on no input from `first`
    on; and which of `may` are left."""
    closed = jax.make_jaxpr(f)(*(
        jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in avals
    ))  # fmt: skip
    jaxpr = closed.jaxpr
    moved = reached(jaxpr.eqns, jaxpr.invars[first:])
    kept = [isinstance(a, Var) and a in moved for a in jaxpr.outvars[plain:]]
    rest = iter(kept)
    outs = [*jaxpr.outvars[:plain], *itertools.compress(jaxpr.outvars[plain:], kept)]
    eqns = needed(jaxpr.eqns, outs, jaxpr.invars)
    notes = without_names(jaxpr)
    short = Jaxpr(jaxpr.constvars, jaxpr.invars, outs, eqns, jaxpr.effects, notes)
    return ClosedJaxpr(short, closed.consts), [m and next(rest) for m in may]


RULES = {"tangent": _tangent, "transposed": _transposed}
CACHED = {name: functools.lru_cache(4096)(f) for name, f in RULES.items()}


@functools.cache
def _no_notes() -> Any:
    """The debug info of a jaxpr without names."""
    return without_names(jax.make_jaxpr(lambda: ())().jaxpr)


