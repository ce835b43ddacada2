"""Optimal control of robots on the floor, with the contact law of the model."""

import jax.numpy as jnp
import numpy as np

import rbjax as rb

HOPPER = """<mujoco><option timestep="0.01"/><worldbody>
  <geom type="plane" size="0 0 1" priority="1" solref="0.03 1" solimp="0.01 0.95 0.01"/>
  <body name="trunk" pos="0 0 0.5"><joint type="slide" axis="0 0 1"/>
    <geom size="0.05" mass="3" contype="0" conaffinity="0"/>
    <body><joint name="leg" type="slide" axis="0 0 -1" damping="1"/>
      <geom name="foot" type="sphere" pos="0 0 -0.47" size="0.03" mass="0.3"/></body></body>
  </worldbody><actuator><motor joint="leg" ctrlrange="-150 150"/></actuator></mujoco>"""


def test_a_hopper_jumps() -> None:
    """One leg, from rest on the floor to a trunk 0.3 m higher after 0.5 s, at the top of a flight
    with the leg drawn in. The plan is a motion of `rollout` with contacts."""
    model, steps = rb.load(HOPPER, contacts=True), 50
    goal = jnp.array([0.3, 0.0, 0.0])

    def miss(t, state, ctrl):
        return 10 * (jnp.array([*state.q, state.v[0]]) - goal)

    problem = rb.control.Problem(
        model, steps, 0.01, running=[rb.control.Cost(rb.control.Control(), 1e-3)],
        terminal=[rb.control.Cost(miss, 10.0)],
    )  # fmt: skip
    start = rb.State(jnp.array([-0.002, 0.0]), jnp.zeros(2))
    found = rb.control.solve(problem, start, ctrl=jnp.full((steps, 1), 32.0), iterations=100)
    assert found.success, found.summary()
    assert abs(float(found.states.q[-1, 0]) - 0.3) < 0.02
    foot = np.asarray(found.states.q[:, 0] - found.states.q[:, 1])
    assert foot[-1] > 0.25 and foot.min() > -0.03  # the foot has left the floor, and stayed above
    path = rb.rollout(model, start, found.ctrl, 0.01)
    np.testing.assert_allclose(path.q, found.states.q, atol=1e-3)
