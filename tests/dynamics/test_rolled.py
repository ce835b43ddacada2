"""The rolled driver where its head, a free joint, is followed by links that do not hang on it."""

import jax
import jax.numpy as jnp
import pytest

import rbjax as rb
from tests.robots import load_quietly
from tests.tolerances import F64_IDENTITY, relative_error

LINK = '<body pos="0 0 0.3"><joint axis="{}"/><geom size="0.1" pos="0.1 0 0.2"/>{}</body>'
CHAIN = LINK.format("0 1 0", LINK.format("1 0 0", ""))
FREE = '<body><freejoint/><geom size="0.1"/>{}</body>'


@pytest.mark.parametrize(
    "bodies",
    [FREE.format("") + CHAIN, FREE.format(CHAIN) + CHAIN, FREE.format(CHAIN + CHAIN)],
    ids=["apart", "both", "on it"],
)
def test_a_free_body_beside_a_chain(bodies):
    model = load_quietly(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    state = model.random_state(jax.random.key(0))

    @jax.jit
    def found(state):
        q, v = state.q, state.v
        one, other = (model.replace(driver=name) for name in ("rolled", "unrolled"))
        rest = jnp.zeros(model.nv)
        return [
            (rb.inverse_dynamics(m, q, v, v), rb.forward_dynamics(m, q, v, rest))
            for m in (one, other)
        ]

    for rolled, unrolled in zip(*found(state), strict=True):
        assert relative_error(rolled, unrolled) < F64_IDENTITY
