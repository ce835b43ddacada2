"""Derivatives of a jaxpr, equation by equation, by JAX's own rules.

JAX differentiates each kind of equation (primitive, parameters, shapes) once, and the resulting
jaxpr is copied for each equation of that kind. In reverse mode, the equations that depend on a
tangent are transposed from the last to the first.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend import core
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

from rbjax._jax_compat import INLINED, custom_rule, equation, without_names
from rbjax.compiler.jax.garbage import gc_paused

Atom = Var | Literal
Flags = tuple[bool, ...]

NO_EFFECTS: frozenset = frozenset()
#: function of the variables that are given -> the transpose of a linearised jaxpr
Transposed = Callable[..., ClosedJaxpr]


def needed(
    eqns: Sequence[JaxprEqn], outs: Sequence[Atom], given: Sequence[Var], effects: bool = False
) -> list[JaxprEqn]:
    """Return the equations that compute `outs` from `given`, or that have effects if `effects`.
    Of a fusion barrier they keep only the values that are read."""
    wanted, known, kept = {a for a in outs if isinstance(a, Var)}, set(given), []
    for eqn in reversed(eqns):
        read = [v in wanted and v not in known for v in eqn.outvars]
        if any(read) and eqn.primitive.name == "fusion_barrier":
            ins, own = itertools.compress(eqn.invars, read), itertools.compress(eqn.outvars, read)
            eqn = eqn.replace(invars=[*ins], outvars=[*own])
        if (effects and eqn.effects) or any(read):
            kept.append(eqn)
            wanted.update(a for a in eqn.invars if isinstance(a, Var))
    return kept[::-1]


def close(
    eqns: list[JaxprEqn], ins: Sequence[Var], outs: Sequence[Atom], consts: dict[Var, object],
    effects: frozenset = NO_EFFECTS,
) -> ClosedJaxpr:  # fmt: skip
    """Return equations as a jaxpr with inputs `ins`, and with the constants that they read."""
    read = {a for eqn in eqns for a in eqn.invars if isinstance(a, Var)}
    read.update(a for a in outs if isinstance(a, Var))
    constvars = [v for v in consts if v in read]
    info = _anonymous_info()
    jaxpr = Jaxpr(constvars, list(ins), list(outs), eqns, effects, info)
    return ClosedJaxpr(jaxpr, [consts[v] for v in constvars])


@functools.cache
def _anonymous_info():
    return without_names(jax.make_jaxpr(lambda: ())().jaxpr)


def dependents(eqns: Sequence[JaxprEqn], start: Sequence[Atom]) -> set[Var]:
    """Return the variables of `start`, and all variables that depend on them."""
    found = {a for a in start if isinstance(a, Var)}
    for eqn in eqns:
        if any(isinstance(a, Var) and a in found for a in eqn.invars):
            found.update(eqn.outvars)
    return found


def _substitute(env: dict[Var, Atom], atoms: Sequence[Atom]) -> list[Atom]:
    return [a if isinstance(a, Literal) else env[a] for a in atoms]


def _inner_jaxpr(eqn: JaxprEqn) -> ClosedJaxpr:
    inner = eqn.params["jaxpr" if "jaxpr" in eqn.params else "call_jaxpr"]
    return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())


def _has_subjaxpr(eqn: JaxprEqn) -> bool:
    """Return whether an equation contains a jaxpr that may compute values and tangents together."""
    name = eqn.primitive.name
    plain = name == "threads_tangent" or name.startswith("scatter")
    leaves = jax.tree.leaves(list(eqn.params.values()), is_leaf=callable)
    return not plain and any(callable(x) or isinstance(x, Jaxpr | ClosedJaxpr) for x in leaves)


# ------------------------------------------------------------------- rules for one equation


@dataclass(frozen=True)
class EquationKind:
    """The key of an equation's derivative rule. `moving`, `present`: flags of inputs with tangents
    and of results with cotangents."""

    primitive: core.Primitive
    params: tuple
    ins: tuple[ShapedArray, ...]
    outs: tuple[ShapedArray, ...]
    moving: Flags
    present: Flags

    def call(self, args: Sequence[jax.Array]) -> list[jax.Array]:
        """Evaluate an equation of this kind."""
        ins, outs = [Var(a) for a in self.ins], [Var(a) for a in self.outs]
        eqn = core.new_jaxpr_eqn(ins, outs, self.primitive, dict(self.params), NO_EFFECTS)
        return core.jaxpr_as_fun(close([eqn], ins, outs, {}))(*args)

    def merge(self, still: Sequence[jax.Array], moved: Sequence[jax.Array]) -> list[jax.Array]:
        """Merge inputs without tangents (`still`) and with (`moved`) in their original order."""
        rest, along = iter(still), iter(moved)
        return [next(along) if m else next(rest) for m in self.moving]

    def tangent(self) -> tuple[ClosedJaxpr, list[bool]]:
        """Return the jaxpr (inputs, tangents) -> (results, nonzero tangents), and nonzero flags."""
        n, floats = len(self.ins), [jnp.issubdtype(a.dtype, jnp.floating) for a in self.outs]

        def both(*xs: jax.Array) -> list[jax.Array]:
            still, moved = _split(xs[:n], self.moving)
            f = lambda *m: self.call(self.merge(still, m))  # noqa: E731
            out, along = jax.jvp(f, moved, list(xs[n:]))
            return [*out, *itertools.compress(along, floats)]

        tangents = list(itertools.compress(self.ins, self.moving))
        return _trace_dependent(both, [*self.ins, *tangents], n, len(self.outs), floats)

    def transpose(self) -> tuple[ClosedJaxpr, list[bool]]:
        """Return the jaxpr (other inputs, cotangents) -> nonzero cotangents, and nonzero flags."""
        still, moved = _split(self.ins, self.moving)
        cotangents = list(itertools.compress(self.outs, self.present))
        n = len(still)

        def back(*xs: jax.Array) -> list[jax.Array]:
            def linear(*m: jax.Array) -> list[jax.Array]:
                return list(itertools.compress(self.call(self.merge(xs[:n], m)), self.present))

            return list(jax.linear_transpose(linear, *moved)(list(xs[n:])))

        return _trace_dependent(back, [*still, *cotangents], n, 0, [True] * len(moved))


def _split(xs: Sequence, moving: Flags) -> tuple[list, list]:
    """Split xs into the entries whose flag in `moving` is False, and whose flag is True."""
    return [x for x, m in zip(xs, moving, strict=True) if not m], [*itertools.compress(xs, moving)]


def _trace_dependent(
    f, avals: Sequence[ShapedArray], first: int, plain: int, may: Sequence[bool]
) -> tuple[ClosedJaxpr, list[bool]]:
    """Trace f to a jaxpr, without the results that are always zero derivatives.

    The first `plain` results are kept. Each other result is kept if it depends on an input from
    index `first` on. Also return the flags `may`, with False for each dropped result.
    """
    closed = jax.make_jaxpr(f)(
        *(jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in avals)
    )
    jaxpr = closed.jaxpr
    moved = dependents(jaxpr.eqns, jaxpr.invars[first:])
    kept = [isinstance(a, Var) and a in moved for a in jaxpr.outvars[plain:]]
    rest = iter(kept)
    outs = [*jaxpr.outvars[:plain], *itertools.compress(jaxpr.outvars[plain:], kept)]
    eqns = needed(jaxpr.eqns, outs, jaxpr.invars)
    short = close(eqns, jaxpr.invars, outs, dict(zip(jaxpr.constvars, closed.consts, strict=True)))
    return short, [m and next(rest) for m in may]


RULES = {"tangent": EquationKind.tangent, "transpose": EquationKind.transpose}
CACHED = {name: functools.lru_cache(4096)(f) for name, f in RULES.items()}


def _rule_of(
    eqn: JaxprEqn, moving: Flags, which: str, present: Flags
) -> tuple[ClosedJaxpr, list[bool]]:
    """Return the derivative rule of an equation, and flags of its results that are not zero."""
    params = tuple(sorted(eqn.params.items()))
    kind = EquationKind(
        eqn.primitive, params, _avals(eqn.invars), _avals(eqn.outvars), moving, present
    )
    try:
        hash(kind)
    except TypeError:
        return RULES[which](kind)
    return (RULES[which] if _has_subjaxpr(eqn) else CACHED[which])(kind)


def _aval(atom: Atom) -> ShapedArray:
    return cast(ShapedArray, atom.aval)


def _avals(atoms: Sequence[Atom]) -> tuple:
    """Return the avals of atoms, without the mesh axes along which they vary."""
    return tuple(
        ShapedArray(x.shape, x.dtype, weak_type=x.weak_type) if type(x) is ShapedArray else x
        for x in (a.aval for a in atoms)
    )


class JaxprBuilder:
    """A jaxpr under construction: its equations and the constants that they read."""

    def __init__(self) -> None:
        self.eqns: list[JaxprEqn] = []
        self.consts: dict[Var, object] = {}

    def append(self, eqn: JaxprEqn, ins: list[Atom], at: JaxprEqn | None = None) -> list[Var]:
        """Append a copy of `eqn` with inputs `ins` and the source location of `at`."""
        at, outs = at or eqn, [Var(v.aval) for v in eqn.outvars]
        self.eqns.append(equation(eqn, ins, outs, at))
        return outs

    def inline(self, closed: ClosedJaxpr, args: Sequence[Atom], at: JaxprEqn | None) -> list[Atom]:
        """Append the equations of a jaxpr applied to `args`, and return its results."""
        env = self.bind(closed, args)
        for eqn in closed.jaxpr.eqns:
            ins = _substitute(env, eqn.invars)
            if eqn.primitive.name in INLINED:
                outs: Sequence[Atom] = self.inline(_inner_jaxpr(eqn), ins, at)
            else:
                outs = self.append(eqn, ins, at)
            env.update(zip(eqn.outvars, outs, strict=True))
        return _substitute(env, closed.jaxpr.outvars)

    def bind(self, closed: ClosedJaxpr, args: Sequence[Atom]) -> dict[Var, Atom]:
        """Add the constants of a jaxpr, and return the atoms of its constants and inputs."""
        jaxpr = closed.jaxpr
        self.consts.update(zip(jaxpr.constvars, closed.consts, strict=True))
        env: dict[Var, Atom] = {v: v for v in jaxpr.constvars}
        env.update(zip(jaxpr.invars, args, strict=True))
        return env

    def zeros(self, of: Atom) -> Atom:
        return self.inline(_zeros(_aval(of)), [], None)[0]

    def close(self, ins: Sequence[Var], outs: Sequence[Atom]) -> ClosedJaxpr:
        """Return the equations that compute `outs`, as a function of `ins`."""
        return close(needed(self.eqns, outs, ins), ins, outs, self.consts)


@dataclass(frozen=True)
class LinearisedJaxpr:
    """The linearisation of a jaxpr: (args, tangents) -> results and their tangents (None: zero)."""

    eqns: JaxprBuilder
    args: list[Var]
    tangents: list[Var]
    results: list[Atom]
    result_tangents: list[Atom | None]

    @classmethod
    @gc_paused()
    def of(cls, closed: ClosedJaxpr, moving: Sequence[bool]) -> LinearisedJaxpr:
        """Linearise a jaxpr. moving: for each argument, whether it has a tangent."""
        eqns, jaxpr = JaxprBuilder(), closed.jaxpr
        args = [Var(v.aval) for v in jaxpr.invars]
        tangents = [Var(v.aval) for v, m in zip(args, moving, strict=True) if m]
        rest = iter(tangents)
        out, along = _push_forward(eqns, closed, args, [next(rest) if m else None for m in moving])
        return cls(eqns, args, tangents, out, along)

    def divided(self) -> tuple[set[Var], list[JaxprEqn], list[JaxprEqn]] | None:
        """Return the variables that depend on a tangent, the equations of the other variables, and
        their own. Return None if an equation computes both."""
        linear = dependents(self.eqns.eqns, self.tangents)
        if any(map(functools.partial(_is_mixed, linear), self.eqns.eqns)):
            return None
        moving = tuple(any(v in linear for v in e.outvars) for e in self.eqns.eqns)
        return linear, *_split(self.eqns.eqns, moving)

    def values(self, more: Sequence[Var]) -> ClosedJaxpr:
        """Return the function args -> (results, variables `more`)."""
        return self.eqns.close(self.args, [*self.results, *more])

    def tangent(self, residuals: Sequence[ShapedArray]) -> ClosedJaxpr:
        """Return the function (args, residuals, tangents) -> tangents; residuals are not read."""
        outs = [
            self.eqns.zeros(x) if along is None else along
            for x, along in zip(self.results, self.result_tangents, strict=True)
        ]
        ins = [*self.args, *(Var(a) for a in residuals), *self.tangents]
        return self.eqns.close(ins, outs)

    @gc_paused()
    def transposed(self, has_cotangent: Sequence[bool]) -> Transposed | None:
        """Return the transpose (args, given, cotangents of results) -> cotangents of args with
        tangents, as a function of the variables `given`, which it does not compute.
        Returns None if an equation computes values and tangents together."""
        eqns = JaxprBuilder()
        eqns.consts.update(self.eqns.consts)
        parts = self.divided()
        if parts is None:
            return None
        linear, eqns.eqns, of_tangents = parts
        cotangents = [Var(x.aval) for x in itertools.compress(self.results, has_cotangent)]
        sums: dict[Var, Atom] = {}

        def add(to: Atom | None, cotangent: Atom | None) -> None:
            if not isinstance(to, Var) or cotangent is None or to not in linear:
                return
            before = sums.get(to)
            if before is not None:
                (cotangent,) = eqns.inline(_sum(_aval(to)), [before, cotangent], None)
            sums[to] = cotangent

        along = itertools.compress(self.result_tangents, has_cotangent)
        for result_tangent, cotangent in zip(along, cotangents, strict=True):
            add(result_tangent, cotangent)
        for eqn in reversed(of_tangents):
            out = [sums.get(v) for v in eqn.outvars]
            present = [x is not None for x in out]
            if not (some := [x for x in out if x is not None]):
                continue
            moving = tuple(isinstance(a, Var) and a in linear for a in eqn.invars)
            if eqn.primitive.name == "fusion_barrier" and all(moving):
                new: Sequence[Atom] = eqns.append(_barrier(eqn, some), some, eqn)
            else:
                rule, present = _rule_of(eqn, moving, "transpose", tuple(present))
                new = eqns.inline(rule, [*_split(eqn.invars, moving)[0], *some], eqn)
            rest = iter(new)
            found = [next(rest) if p else None for p in present]
            for atom, x in zip(itertools.compress(eqn.invars, moving), found, strict=True):
                add(atom, x)
        outs = [sums[v] if v in sums else eqns.zeros(v) for v in self.tangents]

        def closed(given: Sequence[Var] = ()) -> ClosedJaxpr:
            return eqns.close([*self.args, *given, *cotangents], outs)

        return closed


def _push_forward(
    eqns: JaxprBuilder, closed: ClosedJaxpr, args: Sequence[Atom], tangents: Sequence[Atom | None]
) -> tuple[list[Atom], list[Atom | None]]:
    """Append a jaxpr and its tangent. Return the results and their tangents (None: zero)."""
    jaxpr = closed.jaxpr
    env = eqns.bind(closed, args)
    along = {v: t for v, t in zip(jaxpr.invars, tangents, strict=True) if t is not None}

    def tangent_of(atom: Atom) -> Atom | None:
        return None if isinstance(atom, Literal) else along.get(atom)

    for eqn in jaxpr.eqns:
        ins, own = _substitute(env, eqn.invars), list(map(tangent_of, eqn.invars))
        moving = tuple(t is not None for t in own)
        moved = [t for t in own if t is not None]
        found: list[Atom | None]
        if not moved:
            out: list[Atom] = list(eqns.append(eqn, ins))
            found = [None] * len(out)
        elif eqn.primitive.name in INLINED:
            out, found = _push_forward(eqns, _inner_jaxpr(eqn), ins, own)
        elif eqn.primitive.name == "fusion_barrier":
            out = list(eqns.append(eqn, ins))
            new = iter(eqns.append(_barrier(eqn, moved), moved, eqn))
            found = [next(new) if m else None for m in moving]
        else:
            both = custom_rule(eqn, moving) if eqn.primitive.name == "custom_jvp_call" else None
            rule, present = both or _rule_of(eqn, moving, "tangent", ())
            first = eqn.params["num_consts"] if both else 0
            moved = [t for t in own[first:] if t is not None]
            atoms = eqns.inline(rule, [*ins[first:], *moved], None if both else eqn)
            n = len(eqn.outvars)
            out, rest = atoms[:n], iter(atoms[n:])
            found = [next(rest) if p else None for p in present]
        for v, x, t in zip(eqn.outvars, out, found, strict=True):
            env[v] = x
            if t is not None:
                along[v] = t
    return _substitute(env, jaxpr.outvars), [tangent_of(a) for a in jaxpr.outvars]


def _is_mixed(linear: set[Var], eqn: JaxprEqn) -> bool:
    """Return whether an equation computes values and tangents together."""
    moving = [isinstance(a, Var) and a in linear for a in eqn.invars]
    name = eqn.primitive.name
    if name == "threads":
        return any(moving) and not eqn.params["program"].depends(moving)
    return any(moving) and (not all(moving) if name == "fusion_barrier" else _has_subjaxpr(eqn))


def _barrier(eqn: JaxprEqn, some: Sequence[Atom]) -> JaxprEqn:
    """Return a copy of a fusion barrier for other values."""
    return eqn.replace(outvars=[Var(a.aval) for a in some])


@functools.lru_cache(256)
def _zeros(aval: ShapedArray) -> ClosedJaxpr:
    return jax.make_jaxpr(lambda: jnp.zeros(aval.shape, aval.dtype))()


@functools.lru_cache(256)
def _sum(aval: ShapedArray) -> ClosedJaxpr:
    one = jax.ShapeDtypeStruct(aval.shape, aval.dtype)
    return jax.make_jaxpr(jax.lax.add)(one, one)
