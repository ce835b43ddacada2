"""The shortest path around a circle: closed forms, and derivatives at singular points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.forces.tendons.wrapping import wrapped
from rbjax.lanes import Vec3
from tests.tolerances import F64_ROUNDING

Z = Vec3(0.0, 0.0, 1.0)


@jax.jit
def sphere(start, end, r):
    found = wrapped(Vec3(*start), Vec3(*end), r, dtype=start.dtype)
    return found.length, found.first.array, found.last.array


@jax.jit
def cylinder(start, end, r):
    found = wrapped(Vec3(*start), Vec3(*end), r, axis=Z, dtype=start.dtype)
    return found.length, found.first.array, found.last.array


@jax.jit
def inside(start, end, r):
    side = Vec3(0.0, 0.0, 0.0)
    found = wrapped(Vec3(*start), Vec3(*end), r, axis=Z, side=side, inside=True, dtype=start.dtype)
    return found.length, found.first.array, found.last.array


def point(*x: float) -> jax.Array:
    return jnp.array(x)


@jax.jit
def over_the_top(start, end, r):
    """Around a cylinder whose side site is above it."""
    side = Vec3(0.0, 3.0, 0.0)
    found = wrapped(Vec3(*start), Vec3(*end), r, axis=Z, side=side, dtype=start.dtype)
    return found.length, found.first.array, found.last.array


def test_half_a_turn() -> None:
    """Two points below the centre, one on each side: two straight pieces and half a circle."""
    length, first, last = over_the_top(point(-1.0, -2.0, 0.0), point(1.0, -2.0, 0.0), 1.0)
    np.testing.assert_allclose(length, 4.0 + np.pi, rtol=F64_ROUNDING)
    np.testing.assert_allclose(first, [0, 1, 0], atol=F64_ROUNDING)
    np.testing.assert_allclose(last, [0, -1, 0], atol=F64_ROUNDING)


def test_a_helix() -> None:
    length, first, _ = over_the_top(point(-1.0, -2.0, 0.0), point(1.0, -2.0, 3.0), 1.0)
    np.testing.assert_allclose(length, np.hypot(4 + np.pi, 3.0), rtol=F64_ROUNDING)
    want = np.array([0, 4 + np.pi, 3.0]) / np.hypot(4 + np.pi, 3.0)
    np.testing.assert_allclose(first, want, atol=F64_ROUNDING)


@pytest.mark.parametrize("around", [sphere, cylinder])
@pytest.mark.parametrize("height", [1.0 - 1e-9, 1.0, 1.0 + 1e-9, 0.3, -0.3, 2.0])
def test_a_line_that_just_touches(around, height: float) -> None:
    """The path has the length of the line where it begins to touch, and 2 (s + r a) inside."""
    length, first, last = around(point(-3.0, height, 0.0), point(2.0, height, 0.0), 1.0)
    want = 5.0
    if abs(height) < 1:
        s = np.sqrt(np.array([9.0, 4.0]) + height**2 - 1)
        angle = np.pi - np.arctan2(abs(height), 3) - np.arctan2(abs(height), 2)
        want = s.sum() + angle - np.arctan(s).sum()
    np.testing.assert_allclose(length, want, rtol=1e-13)
    assert np.isfinite([*first, *last]).all()
    np.testing.assert_allclose(np.linalg.norm([first, last], axis=-1), 1.0, rtol=1e-7)


@pytest.mark.parametrize("distances", [(1.5, 1.5), (1.1, 3.0), (1.0001, 1.0001), (20.0, 1.01)])
def test_reflection_from_inside(distances: tuple[float, float]) -> None:
    """The path has the least length of all that touch the circle: angles of incidence are equal."""
    angle = 0.9 * sum(np.arccos(1 / np.array(distances)))
    a = np.array([distances[0], 0.0, 0.0])
    b = distances[1] * np.array([np.cos(angle), np.sin(angle), 0.0])
    length, first, last = inside(jnp.asarray(a), jnp.asarray(b), 1.0)
    at = np.linspace(0, angle, 200_001)
    points = np.stack([np.cos(at), np.sin(at), 0 * at], -1)
    lengths = np.linalg.norm(points - a, axis=-1) + np.linalg.norm(points - b, axis=-1)
    assert -1e-13 < lengths.min() - length < 1e-9
    best = points[lengths.argmin()]
    np.testing.assert_allclose(first, (best - a) / np.linalg.norm(best - a), atol=1e-3)
    np.testing.assert_allclose(last, (b - best) / np.linalg.norm(b - best), atol=1e-3)
    line = np.cross(a, first)[2], np.cross(b, last)[2]  # both at the distance r sin(t)
    np.testing.assert_allclose(*line, atol=1e-12)


SINGULAR = {
    "a site on the surface": ([1.0, 0.0, 0.0], [-1.0, 1.5, 0.1]),
    "both on the surface": ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
    "a site in the centre": ([0.0, 0.0, 0.0], [0.0, 2.0, 0.0]),
    "a line through the centre": ([-2.0, 0.0, 0.0], [2.0, 0.0, 0.0]),
    "one point": ([1.0, 1.0, 0.0], [1.0, 1.0, 0.0]),
    "both in one direction": ([1.5, 0.0, 0.0], [2.5, 0.0, 0.0]),
    "a line that touches": ([-1.0, 1.0, 0.0], [1.0, 1.0, 0.0]),
}


@pytest.mark.parametrize("around", [sphere, cylinder, inside])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_derivatives_are_finite(around, dtype) -> None:
    """Values, gradients and second derivatives, of all singular points in one batch."""
    pairs = jnp.asarray(list(SINGULAR.values()), dtype)

    @jax.jit
    @jax.vmap
    def all_of(pair):
        f = lambda x: around(x[0], x[1], jnp.asarray(1.0, dtype))  # noqa: E731
        return f(pair), jax.jacfwd(f)(pair), jax.grad(lambda x: f(x)[0])(pair)

    for leaf in jax.tree.leaves(all_of(pairs)):
        assert leaf.dtype == dtype and jnp.isfinite(leaf).all()


def test_gradients_are_the_directions() -> None:
    """dL/d start = -e_0 and dL/d end = e_1, and dL/dr is the angle of the arc."""
    rng = np.random.default_rng(0)
    a, b = jnp.asarray(rng.normal(size=(2, 200, 3)) * 1.5)

    for around in (sphere, cylinder, inside):

        @jax.jit
        @jax.vmap
        def both(a, b, around=around):
            f = lambda a, b: around(a, b, 0.7)  # noqa: E731
            return f(a, b), jax.grad(lambda a, b: f(a, b)[0], (0, 1))(a, b)

        (_, first, last), (at_start, at_end) = both(a, b)
        np.testing.assert_allclose(at_start, -first, atol=1e-9)
        np.testing.assert_allclose(at_end, last, atol=1e-9)
