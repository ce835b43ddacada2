"""Shortest paths of a car with a smallest turning radius, in the plane without obstacles.

    x' = u cos(theta),  y' = u sin(theta),  theta' = u k,     |k| <= 1 / radius

The car drives only forwards (u = 1, Dubins) or in both directions (|u| = 1, Reeds and Shepp). The
shortest path has at most three or five segments: arcs of the smallest radius, and straight
segments. Its length is a lower bound for all paths among obstacles, so it is an admissible
heuristic for planners. For a Reeds-Shepp car it is a metric of SE(2).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.planning.paths import words
from rbjax.planning.paths.path import Path
from rbjax.rotations.arguments import takes


@takes(positive=["radius"], start="planar_pose", goal="planar_pose", radius="scalar")
def dubins(start: ArrayLike, goal: ArrayLike, radius: ArrayLike) -> Path:
    """Compute the shortest path of a car that only drives forwards: the best of six words.

        LSL, LSR, RSL, RSR, RLR, LRL

    Args:
        start, goal: poses (..., 3): x and y in m, the heading in rad.
        radius: the smallest turning radius (...), m.

    Returns:
        `Path` of five steps, some of which may be zero. Its length is discontinuous where the best
        word changes, by up to 2 pi radius. Its derivatives are the derivatives of the best word.

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
def reeds_shepp(start: ArrayLike, goal: ArrayLike, radius: ArrayLike) -> Path:
    """Compute the shortest path of a car that drives in both directions: the best of 48 words.

        C|C|C, C|CC, CC|C, CSC, CCu|CuC, C|CuCu|C, C|CSC, CSC|C, C|CSC|C      (| is a cusp)

    Args:
        start, goal: poses (..., 3): x and y in m, the heading in rad.
        radius: the smallest turning radius (...), m.

    Returns:
        `Path` of five steps, some of which may be zero. Its length is a continuous distance between
        poses. Its derivatives are the derivatives of the best word. Of equally short words (for a
        half turn, C|C|C in every order) it is the first of the table, with the fewest segments.

    Raises:
        InputError: wrong shapes, values that are not finite, a radius that is not above zero.

    Source: Reeds & Shepp, Pacific J. Math. 145 (1990) 367; LaValle, *Planning Algorithms*, 15.3.2.

    Example:
        >>> curve = reeds_shepp([0.0, 0.0, 0.0], [0.0, 0.0, jnp.pi], 1.0)  # turn on the spot
        >>> curve.word, round(float(curve.length), 6)
        ('L+R-L+', 3.141593)
    """
    return shortest(words.REEDS_SHEPP, words.either_way, start, goal, radius)


def shortest(table: Any, wrap: Any, start: jax.Array, goal: jax.Array, radius: jax.Array) -> Path:
    """Compute the shortest path among all candidates of a table of words, in traced code.

    table: `DUBINS` or `REEDS_SHEPP`. wrap: `forwards` or `either_way`.
    """
    dx, dy = (goal[..., i] - start[..., i] for i in (0, 1))
    heading, phi = start[..., 2], goal[..., 2] - start[..., 2]
    c, s = jnp.cos(heading), jnp.sin(heading)
    x, y = (c * dx + s * dy) / radius, (c * dy - s * dx) / radius
    lengths, turns, exists = words.candidates(table, wrap, x, y, jnp.broadcast_to(phi, x.shape))
    total = jnp.where(exists, jnp.abs(lengths).sum(-1), jnp.inf)
    # of several equally short words, the first one of the table has the fewest segments
    tie = 1 + words.SLACK * jnp.finfo(total.dtype).eps
    best = jnp.argmax(total <= tie * total.min(-1, keepdims=True), -1)[..., None]
    parts = jnp.take_along_axis(lengths, best[..., None], -2)[..., 0, :]
    ahead = parts * radius[..., None]
    steps = jnp.stack([ahead, jnp.zeros_like(ahead), turns[best[..., 0]] * parts], -1)
    return Path(jnp.broadcast_to(start, (*parts.shape[:-1], 3)), steps)
