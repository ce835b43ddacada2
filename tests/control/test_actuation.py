"""From forces to controls, and laws under JAX's transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
import rbjax.control as control
from rbjax.errors import InputError
from tests.composing import check_composes
from tests.control.arms import ARM
from tests.robots import load_quietly

REDUNDANT = """
<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/>
<body pos="0.3 0 0"><joint name="b" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/></body></body>
</worldbody><tendon><fixed name="belt"><joint joint="a" coef="1"/><joint joint="b" coef="-1"/>
</fixed></tendon>
<actuator><motor joint="a" gear="2"/><motor joint="b"/><motor tendon="belt" gear="3"/></actuator>
</mujoco>
"""
FILTERED = REDUNDANT.replace(
    '<motor joint="b"/>', '<general name="slow" joint="b" dyntype="filter" dynprm="0.1"/>'
)


@pytest.fixture(scope="module")
def arm():
    return load_quietly(ARM, contacts=False)


def test_redundant_actuators_share_by_the_pseudoinverse():
    """Two motors and a belt on two joints: numpy's pseudoinverse of the moment arms."""
    model = load_quietly(REDUNDANT)
    state = model.random_state(jax.random.key(0))
    tau = jnp.array([0.7, -1.3])
    found = control.allocate(model, state, tau)
    B = np.array([[2.0, 0.0, 3.0], [0.0, 1.0, -3.0]])
    np.testing.assert_allclose(found.ctrl, np.linalg.pinv(B) @ tau, rtol=1e-10)
    assert np.abs(found.residual).max() < 1e-12


def test_limits_leave_a_residual():
    """A motor that may give 1 N m of the 3 that are asked for leaves 2."""
    model = load_quietly(
        '<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1"/></body>'
        '</worldbody><actuator><motor joint="a" ctrlrange="-1 1" ctrllimited="true"/></actuator>'
        "</mujoco>"
    )
    found = control.allocate(model, model.default_state(), jnp.array([3.0]))
    assert found.ctrl.tolist() == [1.0] and found.residual.tolist() == [2.0]


def test_state_of_an_actuator_is_refused():
    with pytest.raises(InputError, match="'slow'"):
        control.gravity_compensation(load_quietly(FILTERED))


def reference(t):
    return jnp.array([0.5 + 0.1 * jnp.cos(t), 0.1 * jnp.sin(t), 0.3])


LAWS = {
    "computed_torque": lambda m: control.computed_torque(
        m, lambda t: jnp.sin(t + jnp.arange(4.0)), stiffness=20.0
    ),
    "operational_space": lambda m: control.operational_space(
        m, reference, site="tip", task="position", stiffness=30.0, posture=jnp.zeros(4)
    ),
    "cartesian_impedance": lambda m: control.cartesian_impedance(
        m, reference, site="tip", task="position", stiffness=90.0, damping=9.0,
        posture=jnp.zeros(4), posture_stiffness=1.0,
    ),
    "joint_impedance": lambda m: control.joint_impedance(
        m, jnp.zeros(4), stiffness=9.0, damping=1.0
    ),
    "gravity_compensation": lambda m: control.gravity_compensation(m),
}  # fmt: skip


SLOW = set(LAWS) - {"gravity_compensation"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n in LAWS]
)
def test_laws_compose(name, arm):
    """jit, vmap, jvp and vjp by time, state and the model's masses, against differences."""
    law = LAWS[name](arm)

    def f(t, q, v, mass):
        other = arm.replace(bodies=arm.bodies.replace(mass=mass))
        return law.replace(model=other)(t, rb.State(q, v))

    rng = np.random.default_rng(3)
    q, v = (0.6 * rng.normal(size=(3, 4)) for _ in range(2))
    q[:, 2] += 1.0
    mass = np.asarray(arm.bodies.mass) * rng.uniform(0.8, 1.2, (3, arm.nb))
    check_composes(f, [rng.uniform(0, 1, 3), q, v, mass])


def test_rollout_through_actuators_is_that_by_forces(arm):
    """A law as a policy and its forces as tau are one motion, also in a batch."""
    law = LAWS["joint_impedance"](arm)
    states = jax.vmap(arm.random_state)(jax.random.split(jax.random.key(0), 3))
    one = rb.rollout(arm, states, law, 1e-3, steps=20)
    two = rb.rollout(arm, states, None, 1e-3, steps=20, tau=law.tau)
    np.testing.assert_allclose(one.q, two.q, atol=1e-10)


@pytest.mark.slow
def test_gains_are_leaves_of_the_policy(arm):
    """The derivative of a rollout by the stiffness of its policy against differences."""
    law = LAWS["operational_space"](arm)
    start = rb.State(jnp.array([0.2, -0.6, 1.2, 0.4]), jnp.zeros(4))

    def end(k):
        stiffer = law.replace(stiffness=k * jnp.ones(3))
        return rb.rollout(arm, start, stiffer, 1e-3, steps=20).q[-1, 1]

    slope, h = jax.jit(jax.grad(end))(30.0), 1e-3
    assert abs(slope - (end(30.0 + h) - end(30.0 - h)) / (2 * h)) < 1e-6 * abs(slope)
