"""Wrong arguments of every public function of estimation: an error that names the argument."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import estimation

WALK = estimation.StateSpace.of(lambda x, u, w: x + w, lambda x: x)
BELIEF = estimation.Estimate(jnp.zeros(1), jnp.ones((1, 1)))
MODEL = rb.load("pendulum")
SEEN = jnp.array([[1.0], [jnp.nan], [2.0]])
FILTERED = estimation.kalman_filter(
    WALK, jnp.zeros(1), [1.0], jnp.zeros(2), SEEN, [1.0], [1.0]
)  # fmt: skip
COVARIANCE = ["x", None, [[1.0, 2.0]]]
# function: (its good arguments, {argument: wrong values})
CASES = {
    "kalman_filter": (
        {
            "space": WALK, "start": jnp.zeros(1), "covariance": [1.0], "inputs": jnp.zeros(2),
            "readings": jnp.ones((3, 1)), "process": [1.0], "noise": [1.0],
        },
        {
            "space": [5, "x", None], "covariance": COVARIANCE, "inputs": [np.zeros(5)],
            "readings": [np.zeros((5, 1)), "x", None], "process": COVARIANCE,
            "noise": ["x", None, np.ones(2)], "arrived": [np.ones((5, 1), bool)],
        },
    ),
    "kalman_smoother": (
        {"space": WALK, "filtered": FILTERED}, {"space": [5, None], "filtered": [5, "x", None]},
    ),
    "kalman_predict": (
        {"space": WALK, "estimate": BELIEF, "given": 0.0, "process": [1.0]},
        {"space": [3, "x"], "estimate": [3, "x"], "process": COVARIANCE},
    ),
    "kalman_update": (
        {"space": WALK, "estimate": BELIEF, "reading": np.zeros(1), "noise": [1.0]},
        {
            "space": [3, "x"], "estimate": [3, "x"], "reading": ["x", np.zeros(2)],
            "noise": COVARIANCE,
        },
    ),
    "model_state_space": (
        {"model": MODEL, "read": lambda state: state.q},
        {
            "model": [5, "x", None], "read": [5, "x", None], "dt": ["x", -1.0, 0.0, np.nan],
            "integrator": ["x", 5],
        },
    ),
}  # fmt: skip


def calls():
    for name, (_, wrong) in CASES.items():
        for argument, values in wrong.items():
            for k, value in enumerate(values):
                yield pytest.param(name, argument, value, id=f"{name}-{argument}-{k}")


@pytest.mark.parametrize(("name", "argument", "value"), [*calls()])
def test_a_wrong_argument_is_named(name, argument, value):
    with pytest.raises(rb.RbjaxError) as caught:
        getattr(estimation, name)(**(CASES[name][0] | {argument: value}))
    assert 25 < len(str(caught.value)) < 1500


def test_every_public_function_has_a_table():
    public = (getattr(estimation, name) for name in estimation.__all__)
    assert {f.__name__ for f in public if not inspect.isclass(f)} == {*CASES}
