"""Derivatives of a traced function, equation by equation, by JAX's own rules.

JAX differentiates a program by calling the rule of each equation, and binds what the rule writes
several times over: for a robot's step of 5,000 equations that takes seconds. Here JAX
differentiates each kind of equation (primitive, parameters, shapes) once. The result, a jaxpr of a
few equations, is written wherever an equation of that kind occurs.

Reverse mode: of the equations of the tangent those that depend on a rate are linear in the rates;
they are transposed from the last to the first. Programs with loops that compute values and rates
together are left to JAX (`transposed` returns None).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

from rbjax._jax_compat import custom_rule, equation, without_names
from rbjax.compiler.jax.equations import (
    Atom,
    called,
    is_whole,
    needed,
    of,
    reached,
    rule_of,
)
from rbjax.compiler.jax.uncollected import uncollected

#: equations that are linear: the rate of the result is the same of the rate
LINEAR = {
    "neg", "slice", "squeeze", "reshape", "broadcast_in_dim", "expand_dims", "transpose", "rev",
    "reduce_sum", "copy",
}

#: equations that are their jaxpr
INLINED = {"jit", "pjit", "closed_call", "core_call"}


class Equations:
    """A jaxpr that is being written: its equations, and the constants that they read."""

    def __init__(self) -> None:
        self.eqns: list[JaxprEqn] = []
        self.consts: dict[Var, Any] = {}

    def write(self, eqn: JaxprEqn, ins: list[Atom], at: JaxprEqn | None = None) -> list[Var]:
        """`eqn` with other inputs, new results, and the source location of `at`."""
        at, outs = at or eqn, [Var(v.aval) for v in eqn.outvars]
        self.eqns.append(equation(eqn, ins, outs, at))
        return outs

    def inlined(self, closed: ClosedJaxpr, args: Sequence[Atom], at: JaxprEqn | None) -> list[Atom]:
        """The results of a jaxpr."""
        env = self.named(closed, args)
        for eqn in closed.jaxpr.eqns:
            ins = of(env, eqn.invars)
            if eqn.primitive.name in INLINED:
                outs = self.inlined(called(eqn), ins, at)
            else:
                outs = self.write(eqn, ins, at)
            env.update(zip(eqn.outvars, outs, strict=True))
        return of(env, closed.jaxpr.outvars)

    def named(self, closed: ClosedJaxpr, args: Sequence[Atom]) -> dict[Var, Atom]:
        """The atoms of a jaxpr's constants and inputs."""
        jaxpr = closed.jaxpr
        self.consts.update(zip(jaxpr.constvars, closed.consts, strict=True))
        env: dict[Var, Atom] = {v: v for v in jaxpr.constvars}
        env.update(zip(jaxpr.invars, args, strict=True))
        return env

    def zeros(self, aval: Any) -> Atom:
        return self.inlined(_zeros(aval), [], None)[0]

    def closed(self, ins: Sequence[Var], outs: Sequence[Atom], notes: Any) -> ClosedJaxpr:
        """The equations that the results need, as a function of `ins`."""
        eqns = needed(self.eqns, outs, ins)
        read = {a for eqn in eqns for a in eqn.invars if isinstance(a, Var)}
        read.update(a for a in outs if isinstance(a, Var))
        held = [v for v in self.consts if v in read]
        effects = frozenset[Any]()
        jaxpr = Jaxpr(held, list(ins), list(outs), eqns, effects, notes)
        return ClosedJaxpr(jaxpr, [self.consts[v] for v in held])


@dataclass(frozen=True)
class Linearised:
    """The equations of (args, rates of those that move) -> results and their rates (None: zero)."""

    eqns: Equations
    args: list[Var]
    rates: list[Var]
    results: list[Atom]
    result_rates: list[Atom | None]
    notes: Any

    @classmethod
    @uncollected
    def of(cls, closed: ClosedJaxpr, moving: Sequence[bool]) -> Linearised:
        eqns, jaxpr = Equations(), closed.jaxpr
        args = [Var(v.aval) for v in jaxpr.invars]
        rates = [Var(v.aval) for v, m in zip(args, moving, strict=True) if m]
        rest = iter(rates)
        out, rate = _along(eqns, closed, args, [next(rest) if m else None for m in moving])
        notes = without_names(jaxpr)
        return cls(eqns, args, rates, out, rate, notes)

    def tangent(self, kept: Sequence[Any]) -> ClosedJaxpr:
        """(args, kept, rates) -> the rates of all results. `kept` is not read."""
        outs = [
            self.eqns.zeros(x.aval) if rate is None else rate
            for x, rate in zip(self.results, self.result_rates, strict=True)
        ]
        ins = [*self.args, *(Var(a) for a in kept), *self.rates]
        return self.eqns.closed(ins, outs, self.notes)

    @uncollected
    def transposed(self, weighed: Sequence[bool]) -> Transposed | None:
        """(args, cotangents of the weighed results) -> cotangents of the arguments that move; None
        where an equation computes values and rates together."""
        eqns = Equations()
        eqns.consts.update(self.eqns.consts)
        linear = reached(self.eqns.eqns, self.rates)
        if any(map(functools.partial(_is_mixed, linear), self.eqns.eqns)):
            return None
        eqns.eqns = [e for e in self.eqns.eqns if not any(v in linear for v in e.outvars)]
        before = list(eqns.eqns)
        bars = [Var(x.aval) for x, w in zip(self.results, weighed, strict=True) if w]
        sums: dict[Var, Atom] = {}

        def give(to: Atom | None, bar: Atom | None) -> None:
            if to is None or bar is None or isinstance(to, Literal) or to not in linear:
                return
            before = sums.get(to)
            sums[to] = (
                bar if before is None else eqns.inlined(_sum(to.aval), [before, bar], None)[0]
            )

        rates = itertools.compress(self.result_rates, weighed)
        for result_rate, of_result in zip(rates, bars, strict=True):
            give(result_rate, of_result)
        for eqn in reversed(self.eqns.eqns):
            if not any(v in linear for v in eqn.outvars):
                continue
            out = [sums.get(v) for v in eqn.outvars]
            if all(bar is None for bar in out):
                continue
            moving = tuple(isinstance(a, Var) and a in linear for a in eqn.invars)
            if eqn.primitive.name == "fusion_barrier" and all(moving):
                some = [bar for bar in out if bar is not None]
                new = iter(eqns.write(_barrier(eqn, some), some, eqn))
                found = [None if bar is None else next(new) for bar in out]
            else:
                present = tuple(bar is not None for bar in out)
                found = _written(eqns, eqn, moving, "transposed", present, [
                    *(a for a, m in zip(eqn.invars, moving, strict=True) if not m),
                    *(bar for bar in out if bar is not None),
                ])  # fmt: skip
            for to, bar in zip(itertools.compress(eqn.invars, moving), found, strict=True):
                give(to, bar)
        outs = [sums[v] if v in sums else eqns.zeros(v.aval) for v in self.rates]
        return Transposed(eqns, before, self.args, bars, self.results, outs, self.notes)


@dataclass(frozen=True)
class Transposed:
    """The equations of (args, bars) -> outs. forward: the equations of the results, which come
    first."""

    eqns: Equations
    forward: list[JaxprEqn]
    args: list[Var]
    bars: list[Var]
    results: list[Atom]
    outs: list[Atom]
    notes: Any

    def closed(self, given: Sequence[Var] = ()) -> ClosedJaxpr:
        """(args, given, bars) -> outs, where values that are given are not computed."""
        return self.eqns.closed([*self.args, *given, *self.bars], self.outs, self.notes)

    def values(self, more: Sequence[Var]) -> ClosedJaxpr:
        """args -> the results, and more values of these equations."""
        return self.eqns.closed(self.args, [*self.results, *more], self.notes)


def _along(
    eqns: Equations, closed: ClosedJaxpr, args: Sequence[Atom], rates: Sequence[Atom | None]
) -> tuple[list[Atom], list[Atom | None]]:
    """The results of a jaxpr and their rates."""
    jaxpr = closed.jaxpr
    env = eqns.named(closed, args)
    along = {v: rate for v, rate in zip(jaxpr.invars, rates, strict=True) if rate is not None}

    def rate_of(atom: Atom) -> Atom | None:
        return None if isinstance(atom, Literal) else along.get(atom)

    for eqn in jaxpr.eqns:
        ins, rate = of(env, eqn.invars), list(map(rate_of, eqn.invars))
        moving = tuple(r is not None for r in rate)
        moved = [r for r in rate if r is not None]
        found: list[Atom | None]
        if not moved:
            out: list[Atom] = list(eqns.write(eqn, ins))
            found = [None] * len(out)
        elif eqn.primitive.name in INLINED:
            out, found = _along(eqns, called(eqn), ins, rate)
        elif eqn.primitive.name == "fusion_barrier":
            out = list(eqns.write(eqn, ins))
            new = iter(eqns.write(_barrier(eqn, moved), moved, eqn))
            found = [next(new) if m else None for m in moving]
        elif eqn.primitive.name in LINEAR and len(ins) == 1:
            out = list(eqns.write(eqn, ins))
            found = list(eqns.write(eqn, moved))
        else:
            both = custom_rule(eqn, moving) if eqn.primitive.name == "custom_jvp_call" else None
            rule, present = both or rule_of(eqn, moving, "tangent", ())
            first = eqn.params["num_consts"] if both else 0
            moved = [r for r in rate[first:] if r is not None]
            new_atoms = eqns.inlined(rule, [*ins[first:], *moved], None if both else eqn)
            n = len(eqn.outvars)
            out, rest = new_atoms[:n], iter(new_atoms[n:])
            found = [next(rest) if p else None for p in present]
        for v, x, r in zip(eqn.outvars, out, found, strict=True):
            env[v] = x
            if r is not None:
                along[v] = r
    return of(env, jaxpr.outvars), [rate_of(a) for a in jaxpr.outvars]


def _is_mixed(linear: set[Var], eqn: JaxprEqn) -> bool:
    """Whether an equation computes values and rates together."""
    moving = [isinstance(a, Var) and a in linear for a in eqn.invars]
    if eqn.primitive.name == "fusion_barrier":
        return any(moving) and not all(moving)
    return any(moving) and is_whole(eqn)


def _written(
    eqns: Equations, eqn: JaxprEqn, moving: tuple, which: str, present: tuple, args: list[Atom]
) -> list[Atom | None]:
    closed, nonzero = rule_of(eqn, moving, which, present)
    rest = iter(eqns.inlined(closed, args, eqn))
    return [next(rest) if p else None for p in nonzero]


def _barrier(eqn: JaxprEqn, some: Sequence[Atom]) -> JaxprEqn:
    """The barrier of some values."""
    return eqn.replace(outvars=[Var(a.aval) for a in some])


@functools.lru_cache(256)
def _zeros(aval: Any) -> ClosedJaxpr:
    return jax.make_jaxpr(lambda: jnp.zeros(aval.shape, aval.dtype))()


@functools.lru_cache(256)
def _sum(aval: Any) -> ClosedJaxpr:
    one = jax.ShapeDtypeStruct(aval.shape, aval.dtype)
    return jax.make_jaxpr(jax.lax.add)(one, one)
