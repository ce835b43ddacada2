"""Traced arithmetic of simple scenes, over the minimum derived by hand.

The minima count the textbook closed forms with masses, centres, inertias and lengths as inputs and
every common product used once (the pendulum's is a = (tau - m l g sin q) / (I + armature + m l^2)).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.tolerances import F64_IDENTITY, relative_error

LEAVES = ("bodies.mass", "bodies.com", "bodies.position", "bodies.inertia")
# scene: (least by hand, how many times that is allowed)
MINIMA = {
    "pendulum": (9, 1.5),
    "cart_pole": (24, 1.5),
    "two_link": (47, 1.5),
    "free_body": (18, 1.5),
}


@pytest.mark.parametrize("scene", MINIMA)
def test_operations_of_forward_dynamics(scene):
    model = rb.load(scene).fix_zeros()
    state = model.default_state()
    count = rb.operation_count(rb.forward_dynamics, model, state.q, state.v, state.v, traced=LEAVES)
    least, times = MINIMA[scene]
    assert least <= count.total <= times * least


@pytest.mark.parametrize("driver", ["unrolled", "rolled"])
def test_fixed_zeros_change_no_value(driver, key):
    """Nor the gradient by free entries. The gradient by fixed entries is zero."""
    model = rb.load("spinning_top").replace(driver=driver)
    state = model.random_state(key)

    def loss(model):
        return jnp.sum(rb.forward_dynamics(model, state.q, state.v, jnp.sin(state.v)) ** 2)

    dense, fixed = (jax.jit(jax.grad(loss))(m).bodies for m in (model, model.fix_zeros()))
    values = [jax.jit(loss)(m) for m in (model, model.fix_zeros())]
    assert relative_error(values[1], values[0]) < F64_IDENTITY
    for name in ("mass", "com", "inertia", "position"):
        given, a, b = (np.asarray(getattr(x, name)) for x in (model.bodies, dense, fixed))
        assert relative_error(b[given != 0], a[given != 0]) < F64_IDENTITY
        assert not b[given == 0].any()
