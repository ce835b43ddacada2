"""Derivatives of constrained dynamics when no wrenches are given."""

import jax
import numpy as np

from benchmarks.cases.mechanisms import pendulum
from rbjax import constraints


def test_tangents_are_traced() -> None:
    model = pendulum()
    x = (np.array([0.6, -0.8]), np.array([0.8, 0.6]), np.zeros(2))
    value, rate = jax.eval_shape(
        lambda *x: jax.jvp(lambda *x: constraints.constrained_dynamics(model, *x), x, x), *x
    )
    assert jax.tree.map(np.shape, value) == jax.tree.map(np.shape, rate)
