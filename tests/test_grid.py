"""Every public function in f32 and f64, of one sample and of batches of 0, 1 and 3.

The dtype of results is that of q and v (of the arguments, where there is no model); other arguments
of other dtypes are cast. Shapes are those of one sample behind the batch. Nothing is nan.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.body.test_composes import ROOMS
from tests.body.test_composes import samples as points
from tests.robots import robot
from tests.rotations import test_public as rotations
from tests.test_registry import MODEL, REGISTRY, samples

DTYPES = [jnp.float32, jnp.float64]
BATCHES = [None, 0, 1, 3]
POINTS = {f"{room.__name__[6:]}.{n}": f for room, cases in ROOMS.items() for n, f in cases.items()}


def tree_of(x: Any) -> list:
    return [(x.shape, x.dtype) for x in jax.tree.leaves(x)]


def check(function: Any, arrays: list[np.ndarray], dtype: Any, batch: int | None) -> None:
    """Dtypes and shapes, by tracing alone."""
    given = [jnp.asarray(x[0] if batch is None else x[:batch], dtype) for x in arrays]
    one = jax.eval_shape(function, *(jnp.asarray(x[0], dtype) for x in arrays))
    got = one if batch is None else jax.eval_shape(jax.vmap(function), *given)
    want = [(s if batch is None else (batch, *s), d) for s, d in tree_of(one)]
    assert tree_of(got) == want
    assert {d for _, d in want if jnp.issubdtype(d, jnp.floating)} == {jnp.dtype(dtype)}


@pytest.mark.slow
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", REGISTRY)
def test_functions_of_a_model(name: str, dtype: Any) -> None:
    entry = REGISTRY[name]
    for model in (MODEL, MODEL.astype(jnp.float32)):
        if entry.function.__name__ == "_parameters":
            model = model.astype(dtype)
        function = functools.partial(entry.function, model, **entry.rest)
        for batch in BATCHES:
            check(function, samples(entry.arrays), dtype, batch)


@pytest.mark.parametrize("name", REGISTRY)
def test_only_the_dtype_of_q_and_v_counts(name: str) -> None:
    """A control of NumPy's zeros does not turn a motion in f32 into one in f64."""
    entry = REGISTRY[name]
    if entry.function.__name__ == "_parameters":
        return
    function = functools.partial(entry.function, MODEL.astype(jnp.float32), **entry.rest)
    leading = {"q", "q1", "v"} if name != "integrate" else {"q"}
    arrays = [x[0].astype(np.float32 if n in leading else np.float64)
              for n, x in zip(entry.arrays, samples(entry.arrays), strict=True)]  # fmt: skip
    found = {d for _, d in tree_of(jax.eval_shape(function, *arrays))}
    assert found == {jnp.dtype(jnp.float32)}


def test_a_scan_over_steps_of_f32_with_controls_of_f64() -> None:
    model = rb.load("cart_pole").astype(jnp.float32)
    state = jax.tree.map(lambda x: x.astype(jnp.float32), model.default_state())

    def once(state, _):
        return rb.step(model, state, np.zeros(model.nu)), None

    after = jax.eval_shape(lambda s: jax.lax.scan(once, s, None, length=2)[0], state)
    assert tree_of(after) == tree_of(state)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", rotations.CASES)
def test_rotations(name: str, dtype: Any) -> None:
    """By `vmap`, and with their own leading axes; values of a known batch are checked as well."""
    function, arrays = rotations.public()[name], rotations.CASES[name]
    for batch in BATCHES:
        check(function, arrays, dtype, batch)
        if batch is not None:
            given = [jnp.asarray(x[:batch], dtype) for x in arrays]
            got = function(*given)
            assert tree_of(got) == tree_of(jax.eval_shape(jax.vmap(function), *given))
            assert all(np.isfinite(x).all() for x in jax.tree.leaves(got))


@pytest.mark.parametrize("name", POINTS)
def test_spatial_and_body(name: str) -> None:
    """In f64 only: the functions of these cases have constants of their own."""
    for batch in BATCHES:
        check(POINTS[name], list(points()), jnp.float64, batch)


# --------------------------------------------------------------------------------- values


@pytest.mark.slow
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", REGISTRY)
def test_values_of_a_batch(name: str, dtype: Any) -> None:
    """f32 is f64 to its digits, in batches of 0, 1 and 3 compiled each."""
    entry = REGISTRY[name]
    model = robot(entry.robot, "unrolled").model
    if entry.function.__name__ == "_parameters":
        model = MODEL.astype(dtype)
    function = jax.jit(jax.vmap(functools.partial(entry.function, model, **entry.rest)))
    arrays = samples(entry.arrays, entry.robot)
    want = jax.tree.leaves(function(*arrays))
    for batch in (0, 1, 3):
        got = jax.tree.leaves(function(*(jnp.asarray(x[:batch], dtype) for x in arrays)))
        for a, b in zip(got, want, strict=True):
            scale = max(1.0, float(np.abs(b).max(initial=0.0)))
            assert np.isfinite(a).all() and a.dtype == dtype
            np.testing.assert_allclose(a, b[:batch], rtol=0, atol=1e-4 * scale)
