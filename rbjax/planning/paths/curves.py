"""Shortest paths of a car whose turning radius is bounded, in the plane without obstacles.

    x' = u cos(theta),  y' = u sin(theta),  theta' = u k,     |k| <= 1 / radius

forwards only (u = 1, Dubins) or in both directions (|u| = 1, Reeds and Shepp). The shortest path is
of at most three, respectively five, segments: arcs of the smallest radius, and straights. Its
length is a distance between poses that no path through obstacles goes below: a heuristic for
planners, and for a Reeds-Shepp car a metric of SE(2).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiled, wide_vectors
from rbjax.errors import InputError
from rbjax.model.record import Record
from rbjax.planning.paths import words
from rbjax.rotations.arguments import takes


class Curve(Record):
    """Arcs and straights, one after the other; leading axes are a batch.

    Fields: length (...) m; lengths (..., 5) m, signed: negative is driven backwards; turns
    (..., 5): 1 left, 0 straight, -1 right; start (..., 3), the pose (x, y, heading) in m and rad;
    radius (...) m, of the arcs. Where there are fewer than five segments, the others have length
    zero.
    """

    length: jax.Array
    lengths: jax.Array
    turns: jax.Array
    start: jax.Array
    radius: jax.Array

    @property
    def word(self) -> str:
        """Kinds and directions of the segments of one curve, as in "L+R-S-L-".

        Segments shorter than rounding are left out.
        """
        if self.length.ndim:
            raise InputError(
                f"Curve.word: got a batch of shape {self.length.shape}, expected one curve; "
                "use jax.tree.map(lambda x: x[i], curves)"
            )
        lengths = np.asarray(self.lengths)
        least = 64 * np.finfo(lengths.dtype).eps * float(self.length + self.radius)
        pairs = zip(np.asarray(self.turns), lengths, strict=True)
        return "".join(
            f"{'SLR'[int(turn)]}{'-+'[int(s > 0)]}" for turn, s in pairs if abs(s) > least
        )

    @property
    def end(self) -> jax.Array:
        """The pose (..., 3) at the end. Its heading is not reduced to one turn."""
        return self.pose(self.length)

    def pose(self, s: Any) -> jax.Array:
        """The pose (..., 3) after a distance s (...) m along the curve, integrated exactly.

        Before the start it is the start, beyond the end the end.
        """
        return _pose(self, jnp.asarray(s, self.length.dtype))

    def poses(self, n: int) -> jax.Array:
        """n poses (..., n, 3) at even distances, from the start to the end."""
        if not isinstance(n, int) or n < 2:
            raise InputError(f"Curve.poses: n is {n!r}, expected an integer of at least 2")
        each = jax.tree.map(lambda x: x[..., None], self.length)
        wide = Curve(
            each, self.lengths[..., None, :], self.turns[..., None, :], self.start[..., None, :],
            self.radius[..., None],
        )  # fmt: skip
        return wide.pose(each * jnp.linspace(0.0, 1.0, n, dtype=self.length.dtype))


def _pose_along(curve: Curve, s: jax.Array) -> jax.Array:
    left = s
    x, y, heading = (curve.start[..., i] for i in range(3))
    for i in range(words.LONGEST):
        length = curve.lengths[..., i]
        driven = jnp.clip(left, 0.0, jnp.abs(length))
        left = left - jnp.abs(length)
        step = jnp.where(length < 0, -driven, driven)
        turn = curve.turns[..., i] * step / curve.radius
        # the chord of an arc is seen from its middle: sinc(turn / 2) of its length
        chord = step * jnp.sinc(turn / (2 * jnp.pi))
        x = x + chord * jnp.cos(heading + turn / 2)
        y = y + chord * jnp.sin(heading + turn / 2)
        heading = heading + turn
    return jnp.stack(jnp.broadcast_arrays(x, y, heading), -1)


_pose = compiled(_pose_along, options=wide_vectors)


@takes(positive=["radius"], start="planar_pose", goal="planar_pose", radius="scalar")
def dubins(start: jax.Array, goal: jax.Array, radius: jax.Array) -> Curve:
    """The shortest path of a car that only drives forwards: the best of six words.

        LSL, LSR, RSL, RSR, RLR, LRL

    Args:
        start, goal: poses (..., 3): x and y in m, the heading in rad.
        radius: the smallest turning radius (...) in m.

    Returns:
        `Curve`. Its length jumps where the best word does, by up to 2 pi radius. Its derivatives
        are those of the best word.

    Raises:
        InputError: wrong shapes, values that are not finite, a radius that is not above zero.

    Source: Dubins, Amer. J. Math. 79 (1957) 497; LaValle, *Planning Algorithms*, 15.3.1.

    Example:
        >>> curve = dubins([0.0, 0.0, 0.0], [4.0, 4.0, jnp.pi / 2], 1.0)
        >>> curve.word, round(float(curve.length), 4)
        ('L+S+L+', 5.8134)
    """
    return shortest(words.DUBINS, words.forwards, start, goal, radius)


@takes(positive=["radius"], start="planar_pose", goal="planar_pose", radius="scalar")
def reeds_shepp(start: jax.Array, goal: jax.Array, radius: jax.Array) -> Curve:
    """The shortest path of a car that drives in both directions: the best of 48 words.

        C|C|C, C|CC, CC|C, CSC, CCu|CuC, C|CuCu|C, C|CSC, CSC|C, C|CSC|C      (| is a cusp)

    Args:
        start, goal: poses (..., 3): x and y in m, the heading in rad.
        radius: the smallest turning radius (...) in m.

    Returns:
        `Curve`. Its length is a continuous distance between poses. Its derivatives are those of
        the best word; among equally short ones (turning about, C|C|C in every order) the first of
        the table, with the fewest segments.

    Raises:
        InputError: wrong shapes, values that are not finite, a radius that is not above zero.

    Source: Reeds & Shepp, Pacific J. Math. 145 (1990) 367; LaValle, *Planning Algorithms*, 15.3.2.

    Example:
        >>> curve = reeds_shepp([0.0, 0.0, 0.0], [0.0, 0.0, jnp.pi], 1.0)  # turn on the spot
        >>> curve.word, round(float(curve.length), 6)
        ('L+R-L+', 3.141593)
    """
    return shortest(words.REEDS_SHEPP, words.either_way, start, goal, radius)


def shortest(table: Any, wrap: Any, start: jax.Array, goal: jax.Array, radius: jax.Array) -> Curve:
    """The best of a table of `words`, for use in traced code."""
    dx, dy = (goal[..., i] - start[..., i] for i in (0, 1))
    heading, phi = start[..., 2], goal[..., 2] - start[..., 2]
    c, s = jnp.cos(heading), jnp.sin(heading)
    x, y = (c * dx + s * dy) / radius, (c * dy - s * dx) / radius
    lengths, turns, exists = words.candidates(table, wrap, x, y, jnp.broadcast_to(phi, x.shape))
    total = jnp.where(exists, jnp.abs(lengths).sum(-1), jnp.inf)
    # several words may be equally short; the first of the table has the fewest segments
    tie = 1 + words.SLACK * jnp.finfo(total.dtype).eps
    best = jnp.argmax(total <= tie * total.min(-1, keepdims=True), -1)[..., None]
    parts = jnp.take_along_axis(lengths, best[..., None], -2)[..., 0, :] * radius[..., None]
    return Curve(
        length=jnp.abs(parts).sum(-1),
        lengths=parts,
        turns=turns[best[..., 0]],
        start=jnp.broadcast_to(start, (*parts.shape[:-1], 3)),
        radius=jnp.broadcast_to(radius, parts.shape[:-1]),
    )
