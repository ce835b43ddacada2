"""Actuators as a file has them: states of keyframes, ranges, reflected inertia, what is off."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.forces.actuated import errors, limbs
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, relative_error

LAGS = (
    '<general name="off" joint="h" dyntype="filter" group="3"/>',
    '<pid name="pid" joint="h" ki="1" slewmax="2"/>',
    '<motor name="motor" joint="s"/>',
    '<general name="lag" joint="s" dyntype="filter"/>',
)
KEY = '<keyframe><key name="warm" act="9 1 2 3"/><key name="cold"/></keyframe>'


def test_a_keyframe_holds_the_states():
    model = load_quietly(limbs(*LAGS, extra=KEY + '<option actuatorgroupdisable="3"/>'))
    assert model.nx == 3
    np.testing.assert_array_equal(model.keyframe("warm").x, [1, 2, 3])
    np.testing.assert_array_equal(model.keyframe("cold").x, [0, 0, 0])

    class Clock(rb.forces.Element):
        @property
        def size(self):
            return 1

        def start(self):
            return jnp.full(1, 7.0)

    np.testing.assert_array_equal(model.with_forces(Clock()).keyframe("warm").x, [1, 2, 3, 7])
    assert model.replace(forces=()).keyframe("warm").x is None


def test_what_is_off_is_no_element_and_not_left_out():
    m = limbs(*LAGS, extra='<option><flag actuation="disable"/></option>')
    model = load_quietly(m)
    assert model.forces == () and model.dropped == ()


def test_controls_are_clipped_unless_the_file_says_no():
    lag = '<general joint="h" dyntype="integrator" ctrlrange="-0.1 0.1"/>'
    free = limbs(lag, extra='<option><flag clampctrl="disable"/></option>')
    assert max(errors(free, 5)) < F64_PARITY
    (element,) = load_quietly(free).forces
    assert np.isinf(element.ctrlrange).all()
    (element,) = load_quietly(limbs(lag)).forces
    np.testing.assert_array_equal(element.ctrlrange, [[-0.1, 0.1]])


def test_armature_and_damping_of_actuators_at_joints():
    m = limbs(
        '<motor joint="h" gear="3" armature="0.5" damping="0.2 0.1 0.3"/>',
        '<position jointinparent="b" gear="2 3 4" armature="0.1" damping="0 0.1 0.2"/>',
        '<motor joint="f" gear="0.5 0 0 0 0 0" armature="0.2" damping="0.1"/>',
        '<motor tendon="band" gear="2" armature="0.2" damping="0.3 0.1 0.2"/>',
    )
    model, data = load_quietly(m), mujoco.MjData(m)
    assert model.dropped == ()
    m.actuator_armature[3] = 0  # rows have it, not the mass matrix
    data.qvel[:] = np.arange(m.nv)
    mujoco.mj_forward(m, data)
    mass = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, data, mass)
    state = rb.State(jnp.asarray(data.qpos), jnp.asarray(data.qvel))
    run = jax.jit(lambda m, s: (rb.mass_matrix(m, s.q), rb.applied_forces(m, s)))
    for a, b in zip(run(model, state), (mass, data.qfrc_passive), strict=True):
        assert relative_error(a, b) < F64_PARITY


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (
            '<mujoco><worldbody><body name="b"><joint name="j"/><geom size="1"/></body></worldbody>'
            '<actuator><general name="m" joint="j" dyntype="user"/></actuator></mujoco>',
            "laws of a plugin or callback (m)",
        ),
    ],
    ids=["user"],
)
def test_what_is_left_out_says_why(text, why):
    model = load_quietly(text)
    assert f"actuators: {why}" in model.dropped and model.forces == ()


@pytest.mark.parametrize("count", [1, 3])
def test_a_tendon_limits_the_sum_of_the_forces_of_its_actuators(count):
    pull = '<general tendon="band" gear="2" dyntype="filter" gainprm="9" forcerange="-2 7"/>'
    m = limbs(*[pull] * count)
    m.tendon_actfrclimited[0], m.tendon_actfrcrange[0] = True, [-3, 1]
    assert max(errors(m, 20)) < F64_PARITY
