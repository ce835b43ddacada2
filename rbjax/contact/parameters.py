"""Parameters of the contacts of pairs of geoms, by MuJoCo's rules.

The geom of higher priority decides. If both have the same priority, friction and condim are the
larger ones, solimp is the mean with the weights solmix, and solref too, unless one of the two is
direct (-stiffness, -damping): then it is the smaller one, entry by entry. Margins and gaps add.
Explicit pairs have parameters of their own.

Parameters that depend on constant leaves only are NumPy arrays, and literals of the program.

Source: MuJoCo, *Computation*, contact parameters; *Modeling*, contact pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.forces.impedance import IMPEDANCES, LEAST, stiffness_and_damping
from rbjax.lanes import Lane
from rbjax.model.geoms import Geoms

#: MuJoCo's least friction coefficient
LEAST_FRICTION = 1e-5
_SPREAD = [0, 0, 1, 2, 2]  # friction of a geom -> of a contact: two tangents, spin, two rolls

Array = Any  # a NumPy array if it depends on constants only, else a JAX array


class PairParameters(NamedTuple):
    """Parameters of the contacts of n pairs.

    Fields:
        friction: (n, 5) of two tangents, of the spin (m) and of two rolls (m).
        solref: (n, 2) reference.
        solreffriction: (n, 2) reference of the tangents of an elliptic cone; (0, 0) for `solref`.
        solimp: (n, 5) impedance.
        margin: (n,) m, the distance below which a contact acts.
        gap: (n,) m. A contact exists below margin + gap.
        condim: the dimension of the contact of each pair: 1, 3, 4 or 6; not arrays.
    """

    friction: Array
    solref: Array
    solreffriction: Array
    solimp: Array
    margin: Array
    gap: Array
    condim: tuple[int, ...]


def pair_parameters(geoms: Geoms, pairs: Sequence[tuple[int, int]]) -> PairParameters:
    """Compute the parameters of the contacts of pairs of geoms.

    The k-th occurrence of a pair has the parameters of its k-th explicit entry in `geoms.pairs`. A
    pair without one is mixed from both geoms.

    Args:
        geoms: the geoms of a model.
        pairs: (n) pairs of indices of geoms, in any order.
    """
    count = len(geoms.pair_condim)
    entries: dict[frozenset[int], list[int]] = {}
    for k, pair in enumerate(geoms.pairs[:count]):
        entries.setdefault(frozenset(pair), []).append(k)
    found = [entries.get(frozenset(pair), []) for pair in pairs]
    own = [x.pop(0) if x else None for x in found]
    mixed = _mixed(geoms, pairs)
    explicit = _explicit(geoms)
    both = zip(mixed[:-1], explicit[:-1], strict=True)
    columns: list[Any] = [_joined(a, b, own) for a, b in both]
    dtype = geoms.size.dtype
    columns = [x.astype(dtype) if isinstance(x, jax.core.Tracer) else x for x in columns]
    condim = [a if k is None else geoms.pair_condim[k] for a, k in zip(mixed[-1], own, strict=True)]
    return PairParameters._make([*columns, tuple(condim)])


def tangential_solref(solref: Sequence[Lane], solreffriction: Sequence[Lane]) -> tuple[Lane, Lane]:
    """Return the reference of the tangents of an elliptic cone, from lanes (2) of one contact."""
    (a, b), (c, d) = solref, solreffriction
    xp = _module(a, b, c, d)
    given = (c != 0) | (d != 0)
    return xp.where(given, c, a), xp.where(given, d, b)


def _explicit(geoms: Geoms) -> PairParameters:
    """Return the parameters of the explicit pairs of a file."""
    friction = _array(geoms.pair_friction)
    return PairParameters(
        friction=_module(friction).maximum(friction, LEAST_FRICTION),
        solref=_array(geoms.pair_solref),
        solreffriction=_array(geoms.pair_solreffriction),
        solimp=_array(geoms.pair_solimp),
        margin=_array(geoms.pair_margin),
        gap=_array(geoms.pair_gap),
        condim=geoms.pair_condim,
    )


def _mixed(geoms: Geoms, pairs: Sequence[tuple[int, int]]) -> PairParameters:
    """Mix the parameters of both geoms of each pair."""
    one, other = np.array(pairs, int).reshape(-1, 2).T
    priority, condim = (np.array(x, int) for x in (geoms.priority, geoms.condim))
    difference = priority[one] - priority[other]

    def both(x: Any) -> tuple[ModuleType, Array, Array]:
        x = _array(x)
        return _module(x), x[one], x[other]

    def chosen(xp: ModuleType, a: Array, b: Array, equal: Array) -> Array:
        """Return the value of the geom of higher priority, or `equal`."""
        if not difference.any():
            return equal
        rank = difference.reshape(-1, *(1,) * (a.ndim - 1))
        return xp.where(rank > 0, a, xp.where(rank < 0, b, equal))

    mix = _weights(*both(geoms.solmix))[:, None]
    xp, a, b = both(geoms.friction)
    friction = chosen(xp, a, b, xp.maximum(a, b))[:, _SPREAD]
    _, a, b = both(geoms.solref)
    xp = _module(a, mix)
    standard = (a[:, :1] > 0) & (b[:, :1] > 0)
    solref = chosen(xp, a, b, xp.where(standard, _mean(mix, a, b), xp.minimum(a, b)))
    _, a, b = both(geoms.solimp)
    xp = _module(a, mix)
    solimp = chosen(xp, a, b, _mean(mix, a, b))
    margins, gaps = _array(geoms.margin), _array(geoms.gap)
    first, second = condim[one], condim[other]
    dimension = np.where(difference > 0, first, np.where(difference < 0, second,
                         np.maximum(first, second)))  # fmt: skip
    return PairParameters(
        friction=_module(friction).maximum(friction, LEAST_FRICTION),
        solref=solref,
        solreffriction=np.zeros((len(one), 2)),
        solimp=solimp,
        margin=margins[one] + margins[other],
        gap=gaps[one] + gaps[other],
        condim=tuple(dimension.tolist()),
    )


def _weights(xp: ModuleType, a: Array, b: Array) -> Array:
    """Compute the weight of the first geom of each pair from solmix a of the first and b of the
    second."""
    small, none = a < LEAST, b < LEAST
    usual = ~(small | none)
    ratio = xp.where(usual, a, 1.0) / xp.where(usual, a + b, 2.0)
    return xp.where(usual, ratio, xp.where(small & none, 0.5, xp.where(small, 0.0, 1.0)))


def _mean(mix: Array, a: Array, b: Array) -> Array:
    """Compute the mean of a and b, where a has the weight `mix` in [0, 1]."""
    return mix * a + (1 - mix) * b


def _joined(mixed: Array, explicit: Array, own: Sequence[int | None]) -> Array:
    """Return the rows of `explicit` for pairs with an index in `own`, else the rows of `mixed`."""
    at = [i for i, k in enumerate(own) if k is not None]
    if not at:
        return mixed
    if len(at) == len(own):
        return explicit[np.array(own)]
    xp, index = _module(mixed, explicit), np.array([k or 0 for k in own])
    which = np.array([k is not None for k in own]).reshape(-1, *(1,) * (mixed.ndim - 1))
    return xp.where(which, explicit[index], mixed)


def _array(x: Any) -> Array:
    """Return a tracer unchanged, and any other value as a NumPy array in double precision."""
    return x if isinstance(x, jax.core.Tracer) else np.asarray(x, np.float64)


def _module(*arrays: Any) -> ModuleType:
    """Return jax.numpy if an array is traced, else numpy."""
    return jnp if any(isinstance(x, jax.core.Tracer) for x in arrays) else np


def unstable_contacts(geoms: Geoms, dt: float, *, refsafe: bool) -> str:
    """Return a sentence about the pair whose contact gains most energy in steps of dt, or an empty
    text if all are stable.

    A contact with the impedance d moves by r'' = -d b r' - d^2 k r. Steps of semi-implicit Euler
    are stable if h^2 d^2 k + 2 h d b < 4.
    """
    if not geoms.pairs:
        return ""
    given = pair_parameters(geoms, geoms.pairs)
    solimp = np.asarray(given.solimp).T
    k, b = stiffness_and_damping(np.asarray(given.solref).T, solimp, dt if refsafe else None)
    low, high = np.clip(solimp[:2], *IMPEDANCES)
    d = np.where(solimp[2] <= LEAST, 0.5 * (low + high), np.maximum(low, high))
    K, B = np.broadcast_arrays(d * d * k, d * b)
    sums = dt * dt * K + 2.0 * dt * B
    worst = int(np.argmax(sums))
    if not sums[worst] >= 4.0:
        return ""
    one, other = (geoms.names[g] for g in geoms.pairs[worst])
    stiffness, damping = float(K[worst]), float(B[worst])
    step = 4.0 / (damping + np.sqrt(damping * damping + 4.0 * stiffness))
    return (
        f"{one} and {other} have solref with the stiffness {stiffness:.3g} 1/s^2 and the damping "
        f"{damping:.3g} 1/s, and h^2 stiffness + 2 h damping is {sums[worst]:.3g} at the step "
        f"h = {dt:.3g} s, expected less than 4: a contact gains energy in each step. Take a step "
        f'below {step:.2g} s, or solref="{-0.25 / dt**2:.6g} {-1.0 / dt:.6g}" or softer'
    )
