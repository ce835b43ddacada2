"""Lengths and moment arms of the tendons of a model, at an instant and by the configuration."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import InputError
from rbjax.forces.context import Context, FrameState
from rbjax.forces.reach import Arms, Piece, Reach, add_arms, arms_of_pieces, distance
from rbjax.forces.tendons.wrapping import is_inside, wrapped
from rbjax.lanes import Lane, Vec3, add, mul
from rbjax.lanes.arrays import pack
from rbjax.model import WORLD, Frame, Model, State
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.model.tendons import Waypoint


class Segment(NamedTuple):
    """The part of a tendon between two successive sites.

    start, end: indices of the sites.
    geom: the waypoint of the geom between them, or None.
    pulley: index of the divisor among the coefficients, or -1.
    """

    start: int
    end: int
    geom: Waypoint | None
    pulley: int


@functools.cache
def segments(path: Sequence[Waypoint], first: int) -> tuple[Segment, ...]:
    """Split a spatial tendon at its sites. first: index of its first coefficient."""
    found, site, geom, pulley = [], -1, None, -1
    for one in path:
        if one.kind == "pulley":
            site, geom, pulley, first = -1, None, first, first + 1
        elif one.kind == "geom":
            geom = one
        else:
            if site >= 0:
                found.append(Segment(site, one.index, geom, pulley))
            site, geom = one.index, None
    return tuple(found)


@functools.cache
def _key(tendon: int) -> tuple[str, int]:
    """Return the key under which a context stores the reach of a tendon (`Context.once`)."""
    return "tendon", tendon


def tendon_reach(context: Context, tendon: str | int) -> Reach:
    """Compute the length of a tendon and its moment arms, once per context.

    Args:
        context: context.
        tendon: name or index.

    Returns:
        `Reach(length, arms)`: m, or the unit of the joint coordinates of a fixed tendon; and the
        derivative of the length by dof. `speed(context)` is its rate.

    Example:
        >>> import jax.numpy as jnp
        >>> import rbjax as rb
        >>> arm = "<worldbody><body><joint name='a'/><geom size='0.1'/></body></worldbody>"
        >>> tie = "<tendon><fixed name='t'><joint joint='a' coef='2'/></fixed></tendon>"
        >>> model = rb.load(f"<mujoco>{arm}{tie}</mujoco>")
        >>> state = model.default_state().replace(q=jnp.array([0.3]))
        >>> float(rb.forces.tendon_reach(rb.forces.Context.of(model, 0.0, state, None), "t").length)
        0.6
    """
    i = context.model.tendon(tendon)
    return context.once(_key(i), lambda: _reach(context, i))


def _reach(context: Context, i: int) -> Reach:
    tendons: Any = context.model.tendons
    path, first = tendons.paths[i], tendons.first_coefficient(i)
    coefficients = table(tendons.coefficients, context.q.dtype)
    if path and path[0].kind == "joint":
        return _fixed(context, path, [lane(coefficients, first + k) for k in range(len(path))])
    length, pieces = _spatial(context, i)
    return Reach(length, arms_of_pieces(context.links, pieces))


def tendon_pieces(context: Context, tendon: int) -> list[Piece]:
    """Return the straight pieces of a tendon; a fixed tendon has none."""
    own: Any = context.model.tendons
    path = own.paths[tendon]
    return [] if path and path[0].kind == "joint" else _spatial(context, tendon)[1]


def _spatial(context: Context, i: int) -> tuple[Lane, list[Piece]]:
    """Compute the length and the straight pieces of a spatial tendon."""
    tendons: Any = context.model.tendons
    coefficients = table(tendons.coefficients, context.q.dtype)
    length: Lane = 0.0
    pieces: list[Piece] = []
    for one in segments(tendons.paths[i], tendons.first_coefficient(i)):
        share = 1.0 if one.pulley < 0 else 1 / lane(coefficients, one.pulley)
        own, found = _between_sites(context, one)
        length = add(length, mul(share, own))
        pieces += [x._replace(pull=x.pull * share) for x in found]
    return length, pieces


def _fixed(context: Context, path: Sequence[Waypoint], coefficients: Sequence[Lane]) -> Reach:
    """Compute l = sum of c_k q_k."""
    top = context.model.topology
    length: Lane = 0.0
    arms: Arms = {}
    for c, j in zip(coefficients, (x.index for x in path), strict=True):
        if top.joints[j].nq != 1:
            raise InputError(
                f"a fixed tendon has joint {top.joint_names[j]!r}, a {top.joint_kinds[j]}, "
                "expected joints of one coordinate, such as hinges and slides"
            )
        length = add(length, mul(c, context.q[top.joint_q[j]]))
        arms = add_arms(arms, {top.joint_v[j]: c})
    return Reach(length, arms)


def _between_sites(context: Context, one: Segment) -> tuple[Lane, list[Piece]]:
    """Compute the length and the straight pieces between two sites."""
    start, end = context.site(one.start), context.site(one.end)
    a, b = (context.model.topology.site_bodies[i] for i in (one.start, one.end))
    if one.geom is None:
        line = _offset(start, end)
        length, inverse = distance(line, context.q.dtype)
        return length, [Piece(start.link, end.link, start.position, line * inverse, (a, b))]
    g, geoms = one.geom.index, context.model.geoms
    if geoms is None:
        raise InputError("a tendon wraps around a geom, but model.geoms is None; keep the geoms")
    geom = context.frame(Frame(geom=g))
    middle = geoms.bodies[g]
    centre = geom.position
    kind, radius = geoms.types[g], lane(table(geoms.size, context.q.dtype)[:, 0], g)
    side, inside = None, False
    if one.geom.side >= 0:
        other = context.site(one.geom.side)
        side, inside = other.position - centre, is_inside(_offset(geom, other), radius)
    path = wrapped(
        start.position - centre,
        end.position - centre,
        radius,
        axis=geom.rotation.columns[2] if kind == "cylinder" else None,
        side=side,
        inside=inside,
        dtype=context.q.dtype,
    )
    first = Piece(start.link, geom.link, start.position, path.first, (a, middle))
    last = Piece(geom.link, end.link, end.position, path.last, (middle, b))
    return path.length, [first, last]


def _offset(a: FrameState, b: FrameState) -> Vec3:
    """Compute the vector from the origin of frame a to the origin of frame b: in world axes, or in
    the axes of the link that carries both, where it is constant."""
    if a.link == b.link and a.link != WORLD:
        return b.on_link.p - a.on_link.p
    return b.position - a.position


def _reaches(model: Model, q: jax.Array) -> list[Reach]:
    context = Context.of(model, 0.0, State(q, jnp.zeros(model.nv, q.dtype)), None)
    return [tendon_reach(context, i) for i in range(len(model.tendon_names))]


@algorithm("q")
def tendon_lengths(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the lengths l(q) of all tendons.

    A fixed tendon has l = sum of c_k q_k. A spatial tendon has the length of the shortest path
    through its sites and around its spheres and cylinders; branches after a pulley are divided by
    its divisor. Use it for tendon sensors, muscle lengths and springs.

    Args:
        model: the robot; `model.tendons` are its tendons.
        q: (nq,) configuration.

    Returns:
        (nt,) lengths: m, or the unit of the joint coordinates of a fixed tendon. It is empty if the
        model has no tendons. It is differentiable by q; a tendon that begins to touch a geom has a
        continuous first derivative.

    Raises:
        InputError: wrong shape or dtype, values that are not finite, zero quaternions.

    Source: MuJoCo documentation, *XML reference*, tendon; the wrapping is plane geometry
    (`rbjax/forces/tendons/wrapping.py`).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> arm = '<body><joint name="j"/><geom size=".1" contype="0"/></body>'
        >>> belt = '<fixed name="belt"><joint joint="j" coef="2"/></fixed>'
        >>> text = f"<worldbody>{arm}</worldbody><tendon>{belt}</tendon>"
        >>> model = rb.load(f"<mujoco>{text}</mujoco>")
        >>> rb.tendon_lengths(model, jnp.array([0.5])).tolist()
        [1.0]
    """
    return pack([x.length for x in _reaches(model, q)], q)


@algorithm("q")
def tendon_jacobian(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the Jacobian J = dl/dq of all tendon lengths, by velocity coordinates.

    l' = J v, and a tension f in the tendons is the generalized force -J^T f. It is a closed form of
    the directions of the straight pieces of the tendons, not a derivative of the lengths.

    Args:
        model: the robot; `model.tendons` are its tendons.
        q: (nq,) configuration.

    Returns:
        (nt, nv), the moment arms of each tendon in m, or the coefficients of a fixed tendon.

    Raises:
        InputError: wrong shape or dtype, values that are not finite, zero quaternions.

    Source: MuJoCo documentation, *Computation*, transmission.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("cart_pole")
        >>> rb.tendon_jacobian(model, model.default_state().q).shape
        (0, 2)
    """
    rows = [
        pack([reach.arms.get(n, 0.0) for n in range(model.nv)], q) for reach in _reaches(model, q)
    ]
    return jnp.stack(rows) if rows else jnp.zeros((0, model.nv), q.dtype)
