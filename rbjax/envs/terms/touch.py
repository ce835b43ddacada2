"""Whether two geoms touch, by their distance: no contact problem is solved again.

The distance of a convex shape from a plane with normal n through p_0 is

    n . (p - p_0) - s(n),   s = r (sphere), r + h |n . a| (capsule), sum of s_i |n . e_i| (box)
Two boxes overlap if none of 15 axes separates them: their six edge directions e_i and the nine
cross products of two of them (Gottschalk, Lin & Manocha, *OBBTree*, 1996). Other pairs touch if
their narrow phase has a contact.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import real_number, shown
from rbjax.contact.geometry.candidates import PairKind, pair_contacts
from rbjax.contact.geometry.detection import chosen_pairs
from rbjax.contact.geometry.shapes import Shape, geom_shape
from rbjax.envs.terms.frames import Term, scalar
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.lanes import Lane, total

#: a cross product of edges of a smaller squared length separates nothing
PARALLEL = 1e-8
#: kinds of geoms whose support function is known
ROUND = ("sphere", "capsule", "box")


def touching(pairs: Sequence[tuple[str, str]], reach: float = 0.0) -> Term:
    """Return the term that observes whether the two geoms of each pair touch.

    Args:
        pairs: names of the geoms of n pairs.
        reach: the greatest distance that counts as touching, m.

    Returns:
        Function of a `Transition` that returns (n,) of bool.

    Raises:
        InputError: at the evaluation, if pairs is empty.

    Example:
        >>> import rbjax as rb
        >>> feet = rb.envs.terms.touching([("left_foot", "floor")])
        >>> rb.envs.Observation("contact", feet).name
        'contact'
    """
    fixed = _checked_pairs(pairs)
    real_number("touching", "reach", reach)

    def read(transition: Any) -> jax.Array:
        return touching_at(transition.after, fixed, reach)

    return read


def _checked_pairs(pairs: Any) -> tuple[tuple[str, str], ...]:
    if isinstance(pairs, str | Mapping) or not isinstance(pairs, Iterable):
        raise InputError(f"touching: pairs is {shown(pairs)}, expected pairs of names of geoms")
    found = tuple(pairs)
    if not all(isinstance(pair, tuple | list) and len(pair) == 2 for pair in found):
        raise InputError(f"touching: pairs is {shown(found)}, expected pairs of names of geoms")
    return tuple((a, b) for a, b in found)


def any_touching(pairs: Sequence[tuple[str, str]], reach: float = 0.0) -> Term:
    """Return the termination: whether the two geoms of at least one pair touch.

    Args:
        pairs: names of the geoms of each pair.
        reach: the greatest distance that counts as touching, m.

    Returns:
        Function of a `Transition` that returns () of bool, a value of `Task.terminations`.

    Raises:
        InputError: at the evaluation, if pairs is empty.

    Example:
        >>> import rbjax as rb
        >>> terminations = {"fallen": rb.envs.terms.any_touching([("trunk", "floor")])}
        >>> callable(terminations["fallen"])
        True
    """
    each = touching(pairs, reach)

    def read(t: Any) -> jax.Array:
        return each(t).any()

    return read


def touching_at(
    context: Context, pairs: Sequence[tuple[str, str]], reach: float = 0.0
) -> jax.Array:
    """Return whether the two geoms of each pair (n,) touch at an instant."""
    if not pairs:
        raise InputError(
            "touching: pairs is empty, expected one or more pairs of names of geoms, such as "
            '[("left_foot", "floor")]'
        )
    known: dict[Any, Any] = context.once(touching_at, dict)
    model: Any = context.model
    for names in pairs:
        if (names, reach) not in known:
            (pair,) = chosen_pairs("touching", model, [names])
            one, other = (_shape(context, g, known) for g in pair)
            kind = PairKind.of(model.geoms, pair)
            touch = _touch(kind, one, other, reach, model.geoms.heights, context)
            known[names, reach] = jnp.asarray(touch)
    return jnp.stack([known[names, reach] for names in pairs])


def _shape(context: Context, geom: int, known: dict[Any, Any]) -> Shape:
    geoms: Any = context.model.geoms
    if geom not in known:
        pose = context.body(geoms.bodies[geom]).pose
        known[geom] = geom_shape(context.model, geom, pose, context.q.dtype)
    return known[geom]


def _touch(
    kind: PairKind, one: Shape, other: Shape, reach: float, heights: Any, context: Context
) -> Any:
    if kind.one == "plane" and kind.other in ROUND:
        return plane_distance(one, kind.other, other) <= reach
    if kind.kinds == ("box", "box"):
        return box_separation(one, other) <= reach
    contacts = pair_contacts(kind, one, other, scalar(context, reach), heights)
    return jnp.stack([jnp.asarray(c.exists) for c in contacts]).any()


def plane_distance(plane: Shape, name: str, shape: Shape) -> Lane:
    """Return the distance of a sphere, capsule or box from a plane, m, negative below it."""
    n, (a, b, _) = plane.axis, shape.size
    match name:
        case "sphere":
            support: Lane = a
        case "capsule":
            support = a + b * jnp.abs(n.dot(shape.axis))
        case _:
            sides = zip(shape.size, shape.R.columns, strict=True)
            support = total(s * jnp.abs(n.dot(e)) for s, e in sides)
    return n.dot(shape.p - plane.p) - support


def box_separation(one: Shape, other: Shape) -> jax.Array:
    """Compute the greatest separation of two boxes along the 15 axes, negative if they overlap.

    It is a lower bound of their distance.

    Args:
        one, other: `Shape` of each box in the world; `size` (3,) has half edge lengths, m.

    Returns:
        (), m.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.contact.geometry.shapes import Shape
        >>> from rbjax.lanes import Mat3, Vec3
        >>> size = Vec3(0.25, 0.25, 0.25)
        >>> one, other = (Shape(Vec3(x, 0.0, 0.0), Mat3.identity(), size) for x in (0.0, 1.0))
        >>> float(rb.envs.terms.box_separation(one, other))
        0.5
    """
    d = other.p - one.p
    edges = [*one.R.columns, *other.R.columns]
    halves = [*one.size, *other.size]
    axes = [(e, 1.0) for e in edges]
    axes += [(u.cross(v), PARALLEL) for u, v in product(one.R.columns, other.R.columns)]
    gaps = []
    for n, least in axes:
        square = jnp.asarray(n.dot(n))
        valid = square >= least if least < 1.0 else jnp.asarray(True)
        scale = 1.0 / jnp.sqrt(jnp.where(valid, square, 1.0))
        reach = total(s * jnp.abs(n.dot(e)) for s, e in zip(halves, edges, strict=True))
        gap = (jnp.abs(n.dot(d)) - reach) * scale
        gaps.append(jnp.where(valid, gap, -jnp.inf))
    return jnp.stack(gaps).max()
