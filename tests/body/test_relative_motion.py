"""Moving frames against the path itself, differentiated twice."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.body import relative_motion as rm
from rbjax.rotations import se3
from tests.tolerances import relative_error

RNG = np.random.default_rng(2)
(A, B), P = RNG.normal(size=(2, 2, 6)), RNG.normal(size=(3, 3))
TIME = 0.7
CLOSE = 1e-13


def outer(t):
    return se3.compose(se3.exp(t * A[0] + t * t * A[1]), se3.exp(jnp.sin(t) * B[0]))


def inner(t):
    return se3.exp(t**3 * A[1] + jnp.cos(t) * B[1])


def point(t):
    """Of the inner frame, in its coordinates."""
    return P[0] + jnp.sin(2 * t) * P[1] + t * t * P[2]


def twice(f):
    """f and two time derivatives at TIME."""

    def rate(t):
        return jax.jvp(f, (t,), (1.0,))

    (x, dx), (_, ddx) = jax.jvp(rate, (TIME,), (1.0,))
    return x, dx, ddx


def seen_from(path):
    return lambda t: (path(t) @ jnp.append(point(t), 1.0))[:3]


@jax.jit
def everything():
    r = twice(point)
    frame = rm.moving_frame(outer, TIME)
    both = rm.compose(frame, rm.moving_frame(inner, TIME))
    whole = rm.moving_frame(lambda t: se3.compose(outer(t), inner(t)), TIME)
    back = rm.moving_frame(lambda t: se3.inverse(outer(t)), TIME)
    seen = twice(seen_from(outer))
    return Found(r, seen, frame, both, whole, rm.inverse(frame), back)


class Found(NamedTuple):
    """The point in the inner frame, and as the outer one sees it; frames."""

    r: Any
    seen: Any
    frame: Any
    both: Any
    whole: Any
    inverse: Any
    back: Any


@pytest.fixture(scope="module")
def found() -> Found:
    return jax.tree.map(np.asarray, everything())


def test_velocity_and_acceleration_of_a_point(found: Found) -> None:
    r, seen, frame, *_ = found
    assert relative_error(rm.position(frame, r[0]), seen[0]) < CLOSE
    assert relative_error(rm.velocity(frame, *r[:2]), seen[1]) < CLOSE
    assert relative_error(rm.acceleration(frame, *r), seen[2]) < CLOSE


def test_who_turns_with_the_frame_meets_the_apparent_forces(found: Found) -> None:
    r, seen, frame, *_ = found
    assert relative_error(rm.relative_acceleration(frame, r[0], r[1], seen[2]), r[2]) < CLOSE
    # signs, written out: on a wheel turning left, what goes outward is pushed right
    wheel = rm.MovingFrame(np.eye(3), *np.zeros((5, 3)))
    wheel = wheel._replace(omega=np.array([0, 0, 2.0]), alpha=np.array([0, 0, 3.0]))
    seen = rm.apparent_forces(wheel, np.array([5.0, 0, 0]), np.array([1.0, 0, 0]))
    want = [[0, 0, 0], [0, -15, 0], [20, 0, 0], [0, -4, 0]]
    assert relative_error(np.array(seen), want) < CLOSE


@pytest.mark.parametrize("got, want", [("both", "whole"), ("inverse", "back")])
def test_frames_of_frames(got: str, want: str, found: Found) -> None:
    a, b = getattr(found, got), getattr(found, want)
    for x, y, name in zip(a, b, b._fields, strict=True):
        assert relative_error(x, y) < CLOSE, name


def test_foucault_turns_with_the_sine_of_the_latitude() -> None:
    """Coriolis at a latitude: the horizontal part, with y to the north and z up."""
    Omega, latitude = 0.1, 0.6
    frame = rm.MovingFrame(np.eye(3), *np.zeros((5, 3)))
    frame = frame._replace(omega=Omega * np.array([0, np.cos(latitude), np.sin(latitude)]))
    r, rd = np.array([0.3, 0.2, 0.0]), np.array([0.1, -0.4, 0.2])
    terms = rm.apparent_forces(frame, r, rd)
    # the horizontal part of Coriolis is -2 Omega sin(latitude) z x v and the vertical motion's
    turn = -2 * Omega * np.sin(latitude) * np.array([-rd[1], rd[0]])
    rise = -2 * Omega * np.cos(latitude) * np.array([rd[2], 0])
    assert relative_error(terms.coriolis[:2], turn + rise) < CLOSE


def test_wrong_shapes_are_refused_in_a_sentence(found: Found) -> None:
    with pytest.raises(rb.InputError, match=r"velocity: r has shape \(2,\), expected \(..., 3\)"):
        rm.velocity(found.frame, np.zeros(2), np.zeros(3))
    with pytest.raises(rb.InputError, match=r"expected a pose \(4, 4\)"):
        rm.moving_frame(lambda t: t * jnp.eye(3), 0.0)
