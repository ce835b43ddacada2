"""The step that force elements see, and its end in integrators other than Euler: as in MuJoCo, for
any timestep of the model."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces.acting import applied, within
from rbjax.forces.inputs import Inputs
from tests.forces.actuated import limbs
from tests.robots import QUICK, load_quietly
from tests.tolerances import F64_PARITY, relative_error

ARM = """
<mujoco><compiler angle="radian"/><option timestep="0.002"><flag contact="disable"
  constraint="disable" eulerdamp="disable"/></option>
<worldbody><body><joint name="a" axis="0 1 0" armature="0.1"/><geom size="0.1" pos="0.3 0 0"/>
  <body pos="0.5 0 0"><joint name="b" axis="1 1 0" armature="0.1"/><geom size="0.1" pos="0.2 0 0"/>
  </body></body></worldbody>
<actuator>
  <general joint="a" dyntype="integrator" actrange="-.2 .3" gainprm="3"/>
  <general joint="b" dyntype="filter" dynprm="0.07" actrange="-.2 .3" actearly="true" gainprm="5"/>
  <general joint="a" dyntype="integrator" actrange="-.1 .1" actearly="true" gainprm="4"/>
  {}
</actuator></mujoco>
"""
SLEWED = '<pid joint="a" kp="3" ki="0.7" imax="0.11" slewmax="2" input="pos"/>'
MOTOR = (
    '<dcmotor joint="b" motorconst="0.5 0.6" resistance="2" inductance="0.3 0"'
    ' saturation="0.11 0 10"/>'
)
EXACT = '<position joint="b" kp="3" timeconst="0.1"/>'  # MuJoCo's RK4 adds an error of order 1
STEP, STEPS = 0.01, 40


@pytest.mark.parametrize(
    ("integrator", "theirs", "more"),
    [
        ("semi_implicit_euler", mujoco.mjtIntegrator.mjINT_EULER, EXACT + SLEWED + MOTOR),
        ("rk4", mujoco.mjtIntegrator.mjINT_RK4, ""),
    ],
)
def test_a_step_that_is_not_the_model_s(integrator, theirs, more):
    """Early activation, slewing and currents go by the integrator's step; RK4 ends within the
    ranges of activations, and only ends there."""
    text = ARM.format(more)
    model, m = load_quietly(text), mujoco.MjModel.from_xml_string(text)
    m.opt.timestep, m.opt.integrator = STEP, int(theirs)
    u = 4 * np.random.default_rng(2).normal(size=(STEPS, model.nu))
    data, want = mujoco.MjData(m), []
    for row in u:
        data.ctrl = row
        mujoco.mj_step(m, data)
        want.append(np.concatenate([data.qpos, data.qvel, data.act]))
    run = jax.jit(
        lambda u: rb.rollout(model, model.default_state(), u, STEP, integrator=integrator),
        compiler_options=QUICK,
    )
    path = run(jnp.asarray(u))
    found = jnp.concatenate([path.q, path.v, path.x], -1)[1:]
    assert relative_error(found, np.stack(want)) < F64_PARITY
    assert path.x[:, 0].min() == -0.2  # the range is met


class Clock(rb.forces.Element):
    """A force of the size of the step."""

    def loads(self, context):
        return context.joint(0).push(jnp.asarray(-1.0 if context.dt is None else context.dt))


@pytest.mark.parametrize("integrator", [
    "semi_implicit_euler", pytest.param("rk4", marks=pytest.mark.slow),
    pytest.param("variational_midpoint", marks=pytest.mark.slow),
])  # fmt: skip
def test_elements_see_the_step(integrator):
    model = rb.load("pendulum")
    model = model.replace(
        gravity=0 * model.gravity,
        joints=model.joints.replace(damping=0 * model.joints.damping),
    ).with_forces(Clock())
    state, h = model.default_state(), 0.01
    inertia = rb.mass_matrix(model, state.q)[0, 0]
    for kernel in (False, True):
        path = rb.rollout(model, state, None, h, steps=2, integrator=integrator, kernel=kernel)
        np.testing.assert_allclose(path.v[-1, 0] * inertia, 2 * h * h, rtol=1e-9)
    after = rb.step(model, state, dt=h, integrator=integrator)
    np.testing.assert_allclose(after.v[0] * inertia, h * h, rtol=1e-9)
    path = rb.simulate(model, state, jnp.array([0.0, 0.1]))
    np.testing.assert_allclose(path.v[-1, 0] * inertia, -0.1, rtol=1e-6)


def test_lengths_are_found_once():
    """Forces and the states after a step need the same length and speed of a rope."""
    rope = '<general tendon="rope" dyntype="filter" dynprm="0.07" {}/>'
    law = rope.format('gainprm="3" biastype="affine" biasprm="0 -3 -1"')
    pid = '<pid tendon="rope" kp="3" ki="0.7" imax="0.1" input="pos"/>'
    for text in (law, pid):
        model = load_quietly(limbs(text)).replace(driver="unrolled")
        state = model.default_state()

        def both(state, u, advance, model=model):
            found = applied(model, 0.0, state, Inputs(u), 0.01, advance)
            return found if advance else found[:2]

        u = jnp.ones(model.nu)
        one, two = (
            rb.operation_count(lambda s, u, a=a: both(s, u, a), state, u).total
            for a in (False, True)
        )
        assert two < one + 60


def test_ranges_cost_nothing_where_there_are_none():
    x = jnp.ones(1)
    assert within(rb.load("pendulum"), None) is None
    assert within(rb.load("pendulum").with_forces(Clock()), x) is x
