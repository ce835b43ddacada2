"""Contacts of the geoms of a robot."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import real_number, shown
from rbjax.compiler import threads
from rbjax.compiling import jitted
from rbjax.contact.geometry.candidates import PairKind, pair_contacts, pairs_of_candidates
from rbjax.contact.geometry.narrow_phase import PAIRS
from rbjax.contact.geometry.pair_filter import in_order
from rbjax.contact.geometry.shapes import Shape, contact_frame, geom_shape, stack_shapes
from rbjax.contact.parameters import pair_parameters
from rbjax.dynamics.arguments import check_arrays
from rbjax.errors import InputError, UnsupportedFeature
from rbjax.forces.context import Context
from rbjax.lanes import Vec3
from rbjax.model import Model, State
from rbjax.model.geoms import Geoms
from rbjax.model.record import Record

#: pairs of geoms by index
Pairs = tuple[tuple[int, int], ...]
#: distance, position, frame and existence of candidates
_Found = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


class Contacts(Record):
    """Candidate contacts between the geoms of a robot. The number n of candidates is fixed.

    Fields:
        distance: (n,) m, between the surfaces; negative if they overlap.
        position: (n, 3) m, midway between the surfaces, in the world.
        frame: (n, 3, 3) axes of each contact, row by row in world axes: the normal from the first
            geom to the second, and two tangents.
        exists: (n,) whether the candidate is a contact: its distance is at most the reach.
        geoms: the two geoms of each candidate, by index; static.
    """

    distance: jax.Array
    position: jax.Array
    frame: jax.Array
    exists: jax.Array
    geoms: tuple[tuple[int, int], ...] = eqx.field(static=True)


def detect(
    model: Model,
    q: Any,
    *,
    pairs: Sequence[tuple[str | int, str | int]] | None = None,
    reach: Any = None,
) -> Contacts:
    """Return the contacts of a robot's geoms with each other and with those of the world.

    Use it for clearances, with reach=jnp.inf, and to see where a robot touches its surroundings.
    Distances, positions and normals have derivatives by q and by the model. The witness features,
    such as the corner of a box, are constant under differentiation.

    Args:
        model: the robot, with `model.geoms`.
        q: (nq,) configuration.
        pairs: names or indices of the geoms to compare; the pairs that may touch by the rules of
            the file (`model.geoms.pairs`) if None.
        reach: (), m, the greatest distance of a contact; margin + gap of each pair if None.

    Returns:
        `Contacts`, pair by pair; candidates of one pair are in MuJoCo's order.

    Raises:
        InputError: the model has no geoms; shapes and dtypes. UnknownName: no such geom.
        UnsupportedFeature: kinds of geoms that have no narrow phase; the message lists them.

    Source: Ericson, *Real-Time Collision Detection*, ch. 5.

    Example:
        >>> import rbjax as rb
        >>> ball = '''<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.2">
        ...     <freejoint/><geom type="sphere" size="0.1"/></body></worldbody></mujoco>'''
        >>> model = rb.load(ball)
        >>> round(float(rb.contact.detect(model, model.default_state().q).distance[0]), 6)
        0.1
    """
    q = check_arrays("detect", model, {"q": q})["q"]
    chosen = chosen_pairs("detect", model, pairs)
    if reach is not None:
        reach = real_number("detect", "reach", reach, finite=False, traced=True)
        reach = jnp.asarray(reach, q.dtype)
    return _program()(model, q, reach, chosen)


def pairs() -> tuple[tuple[str, str], ...]:
    """Return the kinds of geoms that have a narrow phase, in pairs.

    Example:
        >>> import rbjax as rb
        >>> ("plane", "box") in rb.contact.pairs()
        True
    """
    return tuple(PAIRS)


def _detect(model: Model, q: jax.Array, reach: Any, pairs: Pairs) -> Contacts:
    found: _Found = threads(functools.partial(_candidates, pairs=pairs))(model, q, reach)
    return Contacts(*found, _geoms_of_candidates(model, pairs))


#: `_detect` compiled
_program = jitted(_detect, static_argnames=("pairs",))


def contacts_at(model: Model, q: jax.Array, reach: Any, pairs: Pairs) -> Contacts:
    """Compute the candidate contacts of pairs of geoms in traced code; arguments as in `detect`."""
    found = _candidates(model, q, reach, pairs)
    return Contacts(*found, _geoms_of_candidates(model, pairs))


def _geoms_of_candidates(model: Model, pairs: Pairs) -> Pairs:
    geoms: Any = model.geoms
    return tuple(pairs[i] for i in pairs_of_candidates(geoms, pairs))


def _candidates(model: Model, q: jax.Array, reach: Any, pairs: Pairs) -> _Found:
    """Return distance, position, frame and existence of the candidates of all pairs."""
    geoms: Any = model.geoms
    if not pairs:
        zeros = functools.partial(jnp.zeros, dtype=q.dtype)
        return zeros((0,)), zeros((0, 3)), zeros((0, 3, 3)), jnp.zeros((0,), bool)
    if reach is None:
        parameters = pair_parameters(geoms, pairs)
        reach = jnp.asarray(parameters.margin + parameters.gap, q.dtype)
    reaches = jnp.broadcast_to(reach, (len(pairs),)).astype(q.dtype)
    now = Context.of(model, 0.0, State(q, jnp.zeros(model.nv, q.dtype)), None)
    shapes = {
        g: geom_shape(model, g, now.body(geoms.bodies[g]).pose, q.dtype)
        for g in sorted({g for pair in pairs for g in pair})
    }
    found: dict[int, tuple] = {}
    for kind, members in _by_kind(geoms, pairs).items():
        two = [[shapes[pairs[i][k]] for i in members] for k in (0, 1)]
        of_pair = functools.partial(_columns, kind, geoms.heights)
        if len(members) == 1:
            found[members[0]] = of_pair(two[0][0], two[1][0], reaches[members[0]])
            continue
        a, b = (stack_shapes(x, q.dtype) for x in two)
        columns = jax.vmap(of_pair)(a, b, reaches[jnp.asarray(members)])
        found |= {pair: tuple(x[i] for x in columns) for i, pair in enumerate(members)}
    rows = [found[i] for i in range(len(pairs))]
    distance, position, frame, exists = map(jnp.concatenate, zip(*rows, strict=True))
    return distance, position, frame, exists


def _columns(
    kind: PairKind, heights: Sequence[jax.Array], one: Shape, other: Shape, reach: jax.Array
) -> tuple:
    """Return distance, position, frame and existence of the candidates of one pair."""
    contacts = pair_contacts(kind, one, other, reach, heights)
    distance, exists = (
        jnp.stack([jnp.asarray(x) for x in column])
        for column in ([c.distance for c in contacts], [c.exists for c in contacts])
    )
    stacked = functools.partial(_stacked, dtype=reach.dtype)
    tangents = [Vec3.zero() if c.tangent is None else c.tangent for c in contacts]
    axes = contact_frame(stacked([c.normal for c in contacts]), stacked(tangents))
    frame = jnp.stack([jnp.stack(list(axis), -1) for axis in axes], -2)
    position = jnp.stack(list(stacked([c.position for c in contacts])), -1)
    return distance, position, frame, exists


def _stacked(vectors: Sequence[Vec3], dtype: Any) -> Vec3:
    """Stack n vectors into one vector whose lanes are arrays (n,)."""
    return Vec3(*(jnp.stack([jnp.asarray(v[i], dtype) for v in vectors]) for i in range(3)))


def chosen_pairs(where: str, model: Model, pairs: Any) -> Pairs:
    """Return pairs of geoms by index, the geom of the earlier kind first; those of the file if
    None. Raise if the model has no geoms, or if a pair is wrong or has no narrow phase."""
    geoms = model.geoms
    if geoms is None:
        raise InputError(f"{where}: the model has no geoms; load it from a file with geoms")
    chosen = geoms.pairs if pairs is None else _pair_indices(where, model, geoms, pairs)
    kinds = dict.fromkeys(PairKind.of(geoms, pair) for pair in chosen)
    missing = [f"{kind.one} and {kind.other}" for kind in kinds if not kind.supported]
    if missing:
        known = ", ".join(f"{a} and {b}" for a, b in PAIRS)
        raise UnsupportedFeature(
            f"{where}: no narrow phase for the contacts of {'; '.join(missing)}; known: {known}; "
            "give pairs= without these geoms"
        )
    return chosen


def _pair_indices(where: str, model: Model, geoms: Geoms, pairs: Any) -> Pairs:
    """Return pairs of names or indices as indices, the geom of the earlier kind first."""
    if not isinstance(pairs, list | tuple):
        raise InputError(f"{where}: pairs is {shown(pairs)}, expected a sequence of two geoms each")
    out = []
    for pair in pairs:
        if not isinstance(pair, list | tuple) or len(pair) != 2:
            raise InputError(f"{where}(pairs=...): got {shown(pair)}, expected two geoms")
        a, b = map(model.geom, pair)
        if a == b:
            raise InputError(f"{where}(pairs=...): got {shown(pair)}, expected two different geoms")
        out.append(in_order(geoms.types, a, b))
    return tuple(out)


def _by_kind(geoms: Geoms, pairs: Sequence[tuple[int, int]]) -> dict[PairKind, list[int]]:
    """Return the indices of the pairs of each kind."""
    out: dict[PairKind, list[int]] = {}
    for i, pair in enumerate(pairs):
        out.setdefault(PairKind.of(geoms, pair), []).append(i)
    return out
