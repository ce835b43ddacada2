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
from rbjax.contact.geometry.candidates import PairKind, candidates, pair_contacts
from rbjax.contact.geometry.narrow_phase import KINDS, PAIRS
from rbjax.contact.geometry.shapes import Shape, contact_frame
from rbjax.contact.parameters import pair_parameters
from rbjax.dynamics.algorithms.kinematics import forward_kinematics
from rbjax.dynamics.arguments import check_array, check_model
from rbjax.errors import InputError, UnsupportedFeature
from rbjax.lanes import Mat3, Vec3, quaternion_matrix
from rbjax.model import Model
from rbjax.model.geoms import Geoms
from rbjax.model.record import Record
from rbjax.spatial import Transform


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
        UnsupportedFeature: kinds of geoms that have no closed form; the message lists them.

    Source: Ericson, *Real-Time Collision Detection*, ch. 5.

    Example:
        >>> import warnings
        >>> import rbjax as rb
        >>> warnings.simplefilter("ignore")  # contacts are left out of the model's motion
        >>> ball = '''<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.2">
        ...     <freejoint/><geom type="sphere" size="0.1"/></body></worldbody></mujoco>'''
        >>> model = rb.load(ball)
        >>> round(float(rb.contact.detect(model, model.default_state().q).distance[0]), 6)
        0.1
    """
    check_model("detect", model)
    geoms = _geoms(model)
    q = check_array("detect", "q", q, (model.nq,))
    chosen = geoms.pairs if pairs is None else _pairs_of(model, pairs)
    _check_kinds(geoms, chosen)
    if reach is not None:
        reach = real_number("detect", "reach", reach, finite=False, traced=True)
        reach = jnp.asarray(reach, q.dtype)
    distance, position, frame, exists = _program()(model, q, reach, chosen)
    of_candidates = tuple(chosen[candidate.pair] for candidate in candidates(geoms, chosen))
    return Contacts(distance, position, frame, exists, of_candidates)


def _geoms(model: Model) -> Geoms:
    """Return the geoms of a model, or raise InputError if it has none."""
    if model.geoms is None:
        raise InputError("detect: the model has no geoms; load it from a file with geoms")
    return model.geoms


def pairs() -> tuple[tuple[str, str], ...]:
    """Return the kinds of geoms whose contacts have a closed form, in pairs.

    Example:
        >>> import rbjax as rb
        >>> ("plane", "box") in rb.contact.pairs()
        True
    """
    return tuple(PAIRS)


def _detect(model: Model, q: jax.Array, reach: Any, pairs: tuple[tuple[int, int], ...]) -> tuple:
    """Return distance, position, frame and existence of the candidates of all pairs."""
    return threads(functools.partial(_candidates, pairs=pairs))(model, q, reach)


#: `_detect` compiled
_program = jitted(_detect, static_argnames=("pairs",))


def _candidates(
    model: Model, q: jax.Array, reach: Any, pairs: tuple[tuple[int, int], ...]
) -> tuple:
    """Return the results of `_detect`, as a function of one sample."""
    geoms, shapes = _geoms(model), _shapes(model, q)
    found: dict[int, tuple] = {}
    if reach is None:
        parameters = pair_parameters(geoms, pairs)
        reach = jnp.asarray(parameters.margin + parameters.gap, q.dtype)
    reaches = jnp.broadcast_to(reach, (len(pairs),))
    for kind, members in _by_kind(geoms, pairs).items():
        one, other = (jnp.asarray([pairs[i][k] for i in members]) for k in (0, 1))
        a, b = (jax.tree.map(lambda x, i=i: x[i], shapes) for i in (one, other))
        columns = jax.vmap(functools.partial(_columns, kind, geoms.heights))(
            a, b, reaches[jnp.asarray(members)]
        )
        found |= {pair: tuple(x[i] for x in columns) for i, pair in enumerate(members)}
    rows = [found[i] for i in range(len(pairs))]
    if not rows:
        zeros = functools.partial(jnp.zeros, dtype=q.dtype)
        return zeros((0,)), zeros((0, 3)), zeros((0, 3, 3)), jnp.zeros((0,), bool)
    return tuple(jnp.concatenate(x) for x in zip(*rows, strict=True))


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
    """Return n vectors as one vector of lanes (n,)."""
    return Vec3(*(jnp.stack([jnp.asarray(v[i], dtype) for v in vectors]) for i in range(3)))


def _pairs_of(model: Model, pairs: Any) -> tuple[tuple[int, int], ...]:
    """Return pairs of indices of geoms, the geom of the earlier kind first."""
    if not isinstance(pairs, list | tuple):
        raise InputError(f"detect: pairs is {shown(pairs)}, expected a sequence of two geoms each")
    out = []
    for pair in pairs:
        if not isinstance(pair, list | tuple) or len(pair) != 2:
            raise InputError(f"detect(pairs=...): got {shown(pair)}, expected two geoms")
        kinds = {model.geom(x): _geoms(model).types[model.geom(x)] for x in pair}
        rank = {i: KINDS.index(k) if k in KINDS else len(KINDS) for i, k in kinds.items()}
        if len(rank) != 2:
            raise InputError(f"detect(pairs=...): got {shown(pair)}, expected two different geoms")
        first, second = sorted(rank, key=lambda i: (rank[i], i))
        out.append((first, second))
    return tuple(out)


def _check_kinds(geoms: Geoms, pairs: Sequence[tuple[int, int]]) -> None:
    """Raise UnsupportedFeature if a pair has no closed form."""
    kinds = dict.fromkeys(PairKind.of(geoms, pair) for pair in pairs)
    missing = [f"{kind.one} and {kind.other}" for kind in kinds if not kind.supported]
    if missing:
        known = ", ".join(f"{a} and {b}" for a, b in PAIRS)
        raise UnsupportedFeature(
            f"detect: no closed form for the contacts of {'; '.join(missing)}; known: {known}; "
            "give pairs= without these geoms"
        )


def _by_kind(geoms: Geoms, pairs: Sequence[tuple[int, int]]) -> dict[PairKind, list[int]]:
    """Return the indices of the pairs of each kind."""
    out: dict[PairKind, list[int]] = {}
    for i, pair in enumerate(pairs):
        out.setdefault(PairKind.of(geoms, pair), []).append(i)
    return out


def _shapes(model: Model, q: jax.Array) -> Shape:
    """Return all geoms in the world, as lanes (ng,)."""
    geoms = _geoms(model)
    poses = forward_kinematics(model, q)
    R = jnp.concatenate([poses.R, jnp.eye(3, dtype=q.dtype)[None]])
    p = jnp.concatenate([poses.p, jnp.zeros((1, 3), q.dtype)])
    body = jnp.asarray(geoms.bodies)  # -1, the world, is the last row
    R, p = R[body], p[body]
    carrier = Transform(
        Mat3(*(R[:, i, j] for i in range(3) for j in range(3))), Vec3(*(p[:, i] for i in range(3)))
    )
    quat, position, size = (
        jnp.asarray(x, q.dtype).T for x in (geoms.orientation, geoms.position, geoms.size)
    )
    placed = carrier.then(Transform(quaternion_matrix(*quat), Vec3(*position)))
    return Shape(placed.p, placed.R, Vec3(*size))
