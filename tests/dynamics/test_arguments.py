"""Checks of the algorithms' arguments: an error is one sentence."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.arguments import check_array, check_quaternions

MODEL, TOP = rb.load("cart_pole"), rb.load("spinning_top")
TWO = jax.tree.map(lambda x: jnp.stack([x, x]), MODEL)
HEAVY = eqx.tree_at(lambda m: m.bodies.mass, MODEL, jnp.ones((3, 2)))
Z = np.zeros(2)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((MODEL, None, Z, Z), r"q is NoneType, expected an array of shape \(2,\)"),
        ((MODEL, Z, Z, None), r"tau is NoneType, expected an array of shape \(2,\)"),
        ((MODEL, Z + 0j, Z, Z), "q has dtype complex128, expected float32 or float64"),
        ((MODEL, Z, [0.0, np.inf], Z), r"v\[1\] is inf, expected finite values"),
        ((TWO, Z, Z, Z), r"the model's bodies.mass has shape \(2, 2\), expected 1 axis; .*vmap"),
        ((HEAVY, Z, Z, Z), r"the model's bodies.mass has shape \(3, 2\), expected 1 axis"),
        (("cart_pole", Z, Z, Z), r"model is .cart_pole., expected a Model \(rbjax.load\)"),
    ],
)
def test_what_is_wrong_is_said(arguments, words: str) -> None:
    with pytest.raises(rb.InputError, match=f"forward_dynamics: {words}"):
        rb.forward_dynamics(*arguments)


@pytest.mark.parametrize(
    ("length", "words"),
    [
        (0.0, "a zero quaternion"),
        (1e-200, "a zero quaternion .* in float64"),
        (1e200, "an infinite quaternion"),
    ],
)
def test_a_quaternion_needs_a_length(length: float, words: str) -> None:
    with pytest.raises(rb.InputError, match=rf"q\[0:4\] is {words}.*\(1, 0, 0, 0\)"):
        rb.forward_kinematics(TOP, length * np.array([0.6, 0.0, 0.8, 0.0]))


def test_an_empty_batch_is_an_empty_result() -> None:
    assert jax.vmap(lambda q: rb.mass_matrix(MODEL, q))(jnp.zeros((0, 2))).shape == (0, 2, 2)


@pytest.mark.parametrize("many", [10, 20_000])
def test_what_is_not_finite_is_found_among_few_and_many(many: int) -> None:
    """Of numpy's and of jax's arrays, those of many numbers where they are."""
    x = np.zeros((many, 2))
    x[3, 1] = np.nan
    for given in (x, jnp.asarray(x), x.astype(np.float32)):
        with pytest.raises(rb.InputError, match=r"f: q\[3, 1\] is nan, expected finite values"):
            check_array("f", "q", given, x.shape)
    q = jnp.zeros((many, 4)).at[:, 0].set(1.0)
    check_quaternions("f", "q", TOP, q)
    with pytest.raises(rb.InputError, match=r"q\[0:4\] is a zero quaternion"):
        check_quaternions("f", "q", TOP, q.at[-1].set(0.0))


@pytest.mark.parametrize("many", [10, 20_000])
def test_constants_in_traced_code_are_checked(many: int) -> None:
    """A start that a traced function closes over is a constant, in a small and in a large batch."""
    q, v = jnp.zeros((many, 4)).at[:, 0].set(1.0), jnp.zeros((many, 3))

    def end(q: jax.Array, dt: float) -> jax.Array:
        return rb.rollout(TOP, rb.State(q, v), None, dt, steps=1).q.sum()

    assert jnp.isfinite(jax.jit(lambda dt: end(q, dt))(1e-3))
    zero = q.at[-1].set(0.0)
    with pytest.raises(rb.InputError, match="is a zero quaternion"):
        jax.jit(lambda dt: end(zero, dt))(1e-3)
