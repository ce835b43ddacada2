"""Constraints that a user's functions say: their rows, their numbers, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.equations.constrained_motion import constrained_motion
from tests.constraints.rows import T, check, tree

NUMBERS = {"k": jnp.array([0.7, -0.4]), "n": 3}


def shape(t, q, numbers):
    """Of a quaternion, a slide and a hinge."""
    k = numbers["k"]
    return jnp.stack(
        [
            jnp.sin(q[4]) * q[1] + k[0] * q[5] * q[3] + jnp.cos(t * q[4]),
            q[0] * q[2] - q[3] * q[5] + k[1] * t**2 * q[4] ** numbers["n"],
        ]
    )


def speeds(t, q, k):
    ways = jnp.arange(1.0, 3.0)[:, None] * jnp.cos(jnp.arange(5.0) + t * q[5])
    return ways + k * q[1] * q[4]


def asked(t, q, k):
    return jnp.stack([jnp.sin(t) * k, q[3]])


def test_rows():
    """Of both kinds, in one program."""
    k = jnp.asarray(0.3)
    held = rc.Holonomic(shape, 2, NUMBERS), rc.Pfaffian(speeds, asked, 2, k)
    model = tree(floating=False).with_constraints(*held)
    own, state = check(model)["own"], model.random_state(jax.random.key(3))
    np.testing.assert_allclose(own["value"], shape(T, state.q, NUMBERS), rtol=0, atol=1e-15)
    A = speeds(T, state.q, k)
    np.testing.assert_allclose(own["gradient"][2:], A, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        own["rate"][2:], A @ state.v - asked(T, state.q, k), rtol=0, atol=1e-14
    )


def closed(t, q, length):
    """The tip of a double pendulum of unit links on a vertical line."""
    return jnp.stack([jnp.sin(q[0]) + length * jnp.sin(q[0] + q[1])])


def test_numbers_are_differentiated():
    model = rb.load("double_pendulum")
    state = rb.State(jnp.array([0.4, -0.9]), jnp.array([0.3, 0.2]))

    def moved(length):
        held = model.with_constraints(rc.Holonomic(closed, 1, length))
        a, l = constrained_motion(held, 0.0, state, jnp.zeros(2), {})
        return jnp.concatenate([a, l])

    run, slope = jax.jit(moved), jax.jit(jax.jacfwd(moved))
    h, x = 1e-5, jnp.asarray(1.1)
    want = (run(x + h) - run(x - h)) / (2 * h)
    np.testing.assert_allclose(slope(x), want, rtol=1e-8)
    a = run(x)[:2]
    _, (_, ddg) = jax.jvp(
        lambda s: jax.jvp(
            lambda s: closed(0.0, state.q + s * state.v + s * s / 2 * a, x), (s,), (1.0,)
        ),
        (0.0,),
        (1.0,),
    )
    np.testing.assert_allclose(ddg, 0.0, rtol=0, atol=1e-13)


def zeros(n):
    return lambda t, q: jnp.zeros(n)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: rc.Holonomic(3.0), "Holonomic(f=...): got float, expected a function"),
        (lambda: rc.Holonomic(zeros(1), 0), "size is 0, expected an integer of at least 1"),
        (lambda: rc.Holonomic(lambda t, q, x: q[:1], 1, jnp.nan), "expected finite numbers"),
        (lambda: rc.Holonomic(zeros(1), 1, "k"), "got 'k', expected a pytree of numbers"),
        (lambda: rc.Holonomic(zeros(2), 1), "f returned the shape (2,), expected (1,)"),
        (lambda: rc.Holonomic(zeros(()), 1), "f returned the shape (), expected (1,)"),
        (lambda: rc.Holonomic(lambda t, q: None), "f returned NoneType, expected an array"),
        (lambda: rc.Pfaffian(zeros(2)), "A returned the shape (2,), expected (1, 2)"),
        (lambda: rc.Pfaffian(zeros((1, 2)), zeros(2)), "b returned the shape (2,), expected (1,)"),
        (lambda: rc.Pfaffian(zeros((1, 2)), 1.0), "Pfaffian(b=...): got float"),
    ],
)
def test_refused(make, said):
    with pytest.raises(rb.InputError) as refused:
        model = rb.load("double_pendulum").with_constraints(make())
        constrained_motion(model, 0.0, model.default_state(), jnp.zeros(2), {})
    assert said in str(refused.value)
