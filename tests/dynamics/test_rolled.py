"""The rolled driver on trees whose shape is a special case of its loop."""

import functools

import jax
import numpy as np

import rbjax as rb
from tests.tolerances import F64_IDENTITY, relative_error

BESIDE = """
<mujoco><default><geom contype="0" conaffinity="0" size="0.1" pos="0.1 0 0"/></default><worldbody>
<body><freejoint/><geom/></body>
<body pos="1 0 0"><joint axis="0 1 0"/><geom/>
  <body pos="0.2 0 0"><joint axis="0 1 1"/><geom/></body></body></worldbody></mujoco>
"""


def test_a_free_body_beside_a_chain() -> None:
    """The chain's message to the world does not reach the unrolled links before it."""
    model = rb.load(BESIDE)
    state, tau = model.random_state(jax.random.key(0)), np.ones(model.nv)

    @functools.partial(jax.jit, static_argnums=0)
    def f(driver, q, v):
        here = model.replace(driver=driver)
        forward, M = rb.forward_dynamics(here, q, v, tau), rb.mass_matrix(here, q)
        return [forward, M, rb.inverse_dynamics(here, q, v, tau)]

    pairs = zip(*(f(driver, state.q, state.v) for driver in ("rolled", "unrolled")), strict=True)
    assert all(relative_error(a, b) < F64_IDENTITY for a, b in pairs)
