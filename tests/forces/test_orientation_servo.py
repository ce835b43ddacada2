"""Orientation servos against MuJoCo C: on balls and between sites, vectors and quaternions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces.acting import states
from rbjax.forces.actuators.activation import ControlIntegral
from rbjax.forces.actuators.orientation_servo import OrientationServo
from rbjax.forces.context import Context
from tests.forces.actuated import errors, limbs
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY

SO3 = 'gaintype="so3" biastype="so3" gainprm="3" biasprm="0.2 -3 -.1" dyntype="integrator"'
SERVOS = [
    '<orientation joint="b" kp="3" kv="0.1" forcerange="0 2" ctrlrange="-1 1"/>',
    '<orientation joint="b" kp="3" kv="0.1" input="quat"/>',
    '<orientation site="s4" refsite="s1" kp="3" kv="0.1"/>',
    '<orientation site="s1" refsite="w" kp="3" kv="0.1" input="quat"/>',
    f'<general joint="b" {SO3} actrange="-1 1"/>',
    f'<general site="s4" refsite="s2" {SO3} actearly="true"/>',
]


def test_against_mujoco():
    assert max(errors(limbs(*SERVOS))) < F64_PARITY


def test_a_target_of_more_than_half_a_turn_becomes_the_shorter_one():
    model = load_quietly(limbs(SERVOS[4].replace(' actrange="-1 1"', "")))
    state = model.default_state().replace(x=jnp.array([0.0, 3.1, 0.0]))
    context = Context.of(model, 0.0, state, jnp.array([0.0, 1, 0]))
    np.testing.assert_allclose(states(model, context, 0.1), [0, 3.2 - 2 * np.pi, 0], atol=1e-15)


def test_derivatives_are_finite_at_the_target():
    model = load_quietly(limbs(*SERVOS[:2]))
    state = model.default_state()
    u = jnp.array([0.0, 0, 0, 1, 0, 0, 0])

    def torque(q, u, model):
        return rb.applied_forces(model, state.replace(q=q), u)

    slopes = jax.jit(jax.jacfwd(torque, (0, 1)))(state.q, u, model)
    assert all(np.isfinite(x).all() for x in slopes)


@pytest.mark.parametrize("batch", [0, 1])
def test_its_early_target_is_that_of_the_step_and_not_of_the_models_timestep(batch):
    text = (
        '<mujoco><option gravity="0 0 0" timestep="{}"/><worldbody><body>'
        '<joint type="ball"/><geom type="box" size=".1 .2 .3"/></body></worldbody><actuator>'
        + '<general joint="joint0"/>' * 3
        + "</actuator></mujoco>"
    ).replace('<joint type="ball"/>', '<joint name="joint0" type="ball"/>')
    ends = []
    for timestep in (0.002, 0.02):
        model = rb.load(text.format(timestep))
        servo = OrientationServo(
            jnp.array([5.0, 0.0, 1.0]), jnp.tile(jnp.array([-9.0, 9.0]), (3, 1)),
            jnp.array(jnp.inf), ControlIntegral(jnp.array([-jnp.inf, jnp.inf])), (0, 1, 2), joint=0,
            early=True,
        )  # fmt: skip
        with pytest.warns(UserWarning, match="OrientationServo reads the controls of"):
            model = model.with_forces(servo)
        state = model.default_state()
        state = jax.tree.map(lambda x: x[None], state) if batch else state
        ends.append(rb.rollout(model, state, jnp.ones((5, 3)), 0.02).q[..., -1, :])
    np.testing.assert_array_equal(*ends)
