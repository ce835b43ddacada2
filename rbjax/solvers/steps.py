"""Arithmetic on pytrees, explicit stages and polynomial dense output, shared by all solvers.

Increments h f are in the solver's own time, which always runs forwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.solvers.field import SolverField
from rbjax.solvers.groups import AbstractGroup, Vector, group_of
from rbjax.solvers.tableau import Tableau


def scale(h: Any, k: Any) -> Any:
    """Multiply all leaves of a pytree by h."""
    return jax.tree.map(lambda x: h * x, k)


def combine(weights: Sequence[Any], ks: Sequence[Any]) -> Any:
    """Return the sum of weights_i k_i of pytrees k_i, skipping zero weights."""
    used = [(w, k) for w, k in zip(weights, ks, strict=True) if not _zero(w)]
    if not used:
        return jax.tree.map(jnp.zeros_like, ks[0])
    return jax.tree.map(lambda *xs: sum(w * x for (w, _), x in zip(used, xs, strict=True)),
                        *(k for _, k in used))  # fmt: skip


def _zero(weight: Any) -> bool:
    return isinstance(weight, (int, float)) and weight == 0


def weighted_sums(a: Any, k: Any) -> Any:
    """Return sum_j a_ij k_j over the leading axis of each leaf; a is (s,) or (r, s)."""

    def mix(x):
        rows = jnp.asarray(a, x.dtype)
        return jnp.tensordot(rows, x, axes=1, precision=jax.lax.Precision.HIGHEST)

    return jax.tree.map(mix, k)


def stack(ks: Sequence[Any]) -> Any:
    """Stack pytrees along a new leading axis."""
    return jax.tree.map(lambda *xs: jnp.stack(xs), *ks)


def unstack(ks: Any, count: int) -> list[Any]:
    """Split a pytree along its leading axis."""
    return [jax.tree.map(lambda x, i=i: x[i], ks) for i in range(count)]


def explicit_stages(
    rate: Callable[[Any, Any], Any], tableau: Tableau, t0: Any, h: Any, *, written: bool = False
) -> Callable[[Any], list[Any]]:
    """Return the function of a zero increment that computes the stages of an explicit method. The
    stages are k_i = rate(t0 + c_i h, h sum_j a_ij k_j). They are computed in a loop, which traces
    the field once; `written` unrolls it."""
    s, c = tableau.stages, jnp.asarray(tableau.c, jnp.result_type(h))

    def loop(zero: Any) -> list[Any]:
        def stage(ks: Any, i: jax.Array) -> tuple[Any, None]:
            k = rate(t0 + c[i] * h, scale(h, _weighted_sum(tableau, i, ks)))
            return jax.tree.map(lambda all_, one: all_.at[i].set(one), ks, k), None

        ks = jax.tree.map(lambda x: jnp.zeros((s, *x.shape), x.dtype), zero)
        return unstack(jax.lax.scan(stage, ks, jnp.arange(s))[0], s)

    def one_by_one(zero: Any) -> list[Any]:
        ks: list[Any] = []
        for i, row in enumerate(tableau.a):
            ks.append(rate(t0 + c[i] * h, scale(h, combine(row[:i], ks)) if i else zero))
        return ks

    return one_by_one if written else loop


def _weighted_sum(tableau: Tableau, i: jax.Array, ks: Any) -> Any:
    """Compute sum_j a_ij k_j for a traced stage index i. On a CPU, a branch per stage skips zero
    weights."""
    if jax.default_backend() != "cpu":
        row = jnp.array(tableau.a)[i]
        return jax.tree.map(lambda k: (row.astype(k.dtype) * k.T).T.sum(0), ks)
    rows = [lambda ks, row=row: combine(row, unstack(ks, len(row))) for row in tableau.a]
    return jax.lax.switch(i, rows, ks)


def inverse_dexp(group: AbstractGroup, u: Any, w: Any) -> Any:
    """Return the rate u' for which y exp(u) has the velocity w, to order 4. u' = w + [u, w] / 2 +
    [u, [u, w]] / 12."""
    if isinstance(group, Vector):
        return w
    once = group.bracket(u, w)
    return combine((1.0, 1 / 2, 1 / 12), (w, once, group.bracket(u, once)))


def split_pair(y: Any) -> tuple[list[Any], Callable[[list[Any]], Any]]:
    """Split a state (q, v) or its rate. Return the two halves and the function that joins two
    halves."""
    if isinstance(y, dict):
        raise InputError(
            f"the state is a dict with keys {sorted(y)}, which have no order (q, v): expected a "
            "tuple (q, v)"
        )
    halves, tree = jax.tree.flatten(y, is_leaf=lambda x: x is not y and x is not None)
    if len(halves) != 2:
        raise InputError(
            f"the state has {len(halves)} parts, expected a tuple (q, v); for a robot whose force "
            "elements have states, take a solver of kind 'ode' (rb.solvers.all())"
        )
    return halves, lambda new: jax.tree.unflatten(tree, new)


class Polynomial(diffrax.AbstractLocalInterpolation):
    """Interpolation y0 exp(u(theta)) with u = sum_m coefficients_m theta^(m + 1). theta goes from 0
    at t0 to 1 at t1."""

    t0: Any  # type: ignore[misc]
    t1: Any  # type: ignore[misc]
    y0: Any
    coefficients: Any  # structure of u, with a leading axis
    group: AbstractGroup = eqx.field(default_factory=Vector)

    def evaluate(self, t0, t1=None, left=True):
        del left
        if t1 is not None:
            return jax.tree.map(lambda a, b: b - a, self.evaluate(t0), self.evaluate(t1))
        length = self.t1 - self.t0
        some = length != 0
        theta = jnp.where(some, t0 - self.t0, 0.0) / jnp.where(some, length, 1.0)

        def horner(c):
            out = jnp.zeros_like(c[0])
            for row in c[::-1]:
                out = (out + row) * theta.astype(c.dtype)
            return out

        return self.group.retract(self.y0, jax.tree.map(horner, self.coefficients))


def hermite_coefficients(u: Any, k0: Any, k1: Any) -> Any:
    """Return the coefficients of the cubic with u(0) = 0, u(1) = u, u'(0) = k0, u'(1) = k1."""
    return jax.tree.map(lambda u, a, b: jnp.stack([a, 3 * u - 2 * a - b, a + b - 2 * u]), u, k0, k1)


def dense_output(
    terms: Any, args: Any, t0: Any, t1: Any, y0: Any, y1: Any, rate0: Any = None, rate1: Any = None
) -> dict:
    """Return the cubic interpolation of a step, of order 4, from the rates at both ends. Rates that
    are None are computed."""
    group, f = group_of(terms), SolverField(terms, args)
    if rate0 is None:
        both = jax.vmap(f)(jnp.stack([t0, t1]), stack([y0, y1]))
        rate0, rate1 = (jax.tree.map(lambda x, i=i: x[i], both) for i in (0, 1))
    elif rate1 is None:
        rate1 = f(t1, y1)
    k0, k1 = (scale(t1 - t0, rate) for rate in (rate0, rate1))
    u = group.difference(y0, y1)
    return {
        "y0": y0,
        "coefficients": hermite_coefficients(u, k0, inverse_dexp(group, u, k1)),
        "group": group,
    }


class AbstractPolynomialSolver(diffrax.AbstractSolver):
    """Base class of solvers with polynomial dense output. Override `init` for a solver with
    memory."""

    term_structure: ClassVar[Any] = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., Polynomial]] = Polynomial

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


class AbstractGroupSolver(AbstractPolynomialSolver):
    """Base class of solvers of terms `OnGroup`. The group of any other term is `Vector`."""

    def func(self, terms, t0, y0, args):
        """Return the rate of the state's coordinates, e.g. of a quaternion's four components."""
        group, rate = group_of(terms), terms.vf(t0, y0, args)
        if isinstance(group, Vector):
            return rate
        still = jax.tree.map(jnp.zeros_like, rate)
        return jax.jvp(lambda u: group.retract(y0, u), (still,), (rate,))[1]
