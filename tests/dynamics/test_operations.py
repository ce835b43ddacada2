"""Operations are counted by the rule that its docstring states."""

import jax
import jax.numpy as jnp
import pytest

import rbjax as rb
from rbjax.dynamics.operations import OperationCount, leaf_names, operation_count
from rbjax.lanes import fusion_barrier, sincos

COUNTED = {
    "array": (lambda x: x * x + 2.0 * x, OperationCount(3, 6)),
    "dead code": (lambda x: (jnp.exp(x), x + 1)[1], OperationCount(3)),
    "power": (lambda x: x**5, OperationCount(0, 9)),
    "inverse square": (lambda x: x**-2, OperationCount(0, 3, 3)),
    "root": (lambda x: jnp.sqrt(x) / 2, OperationCount(0, 0, 3, 3)),
    "sum": (lambda x: x.sum(), OperationCount(2)),
    "dot": (lambda x: jnp.dot(x, x), OperationCount(2, 3)),
    "moved, compared, chosen": (lambda x: jnp.where(x > 0, x[::-1], -x), OperationCount()),
    "jit": (jax.jit(lambda x: jnp.sin(x) * 2), OperationCount(0, 3, 0, 0, 3)),
    "sine and cosine": (lambda x: sincos(x[0])[0] + sincos(x[0])[1], OperationCount(1, 0, 0, 0, 2)),
    "fusion_barrier": (lambda x: fusion_barrier((x * 2, jnp.exp(x)))[0], OperationCount(0, 3)),
    "loop": (
        lambda x: jax.lax.scan(lambda c, y: (c * y, c + y), 1.0, x)[0],
        OperationCount(0, 3),
    ),
    "branch": (
        lambda x: jax.lax.cond(x[0] > 0, lambda y: y * y * y, lambda y: y, x),
        OperationCount(0, 6),
    ),
    "checkpoint": (jax.checkpoint(lambda x: x + 1), OperationCount(3)),
}


@pytest.mark.parametrize("name", COUNTED)
def test_small_functions(name: str) -> None:
    fn, expected = COUNTED[name]
    assert operation_count(fn, jnp.ones(3)) == expected


def test_a_closed_over_model_costs_only_what_moves() -> None:
    """A pendulum: tau = I a + m g l sin q."""
    model, x = rb.load("pendulum"), jnp.ones(1)
    assert operation_count(rb.gravity_forces, model, x).total <= 5
    traced = operation_count(rb.gravity_forces, model, x, traced=("bodies.mass",))
    assert traced.total > 5


def test_leaves_have_names() -> None:
    model = rb.load("pendulum")
    assert {"bodies.mass", "joints.damping", "gravity"} <= set(leaf_names(model))
    with pytest.raises(rb.UnknownName, match=r"bodies\.mass"):
        operation_count(rb.gravity_forces, model, jnp.ones(1), traced=("bodies.weight",))
