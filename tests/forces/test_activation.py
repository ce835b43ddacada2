"""Activations: the exact step of a filter, ranges, and windings of a controlled angle."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces.actuators.activation import ControlIntegral, Filter
from tests.forces.actuated import actuation, errors, limbs
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, F64_ROUNDING

FREE = jnp.array([-np.inf, np.inf])


def test_the_exact_filter_is_the_solution():
    lag = Filter(FREE, jnp.array(0.05), True)
    one, two = lag.advanced(2.0, jnp.array(-1.0), 0.02), jnp.array(-1.0)
    for _ in range(4):
        two = lag.advanced(2.0, two, 0.005)
    np.testing.assert_allclose(one, 2 - 3 * np.exp(-0.4), atol=F64_ROUNDING)
    np.testing.assert_allclose(one, two, atol=F64_ROUNDING)


@pytest.mark.parametrize("kind", ["filter", "filterexact"])
def test_a_filter_in_rk4(kind):
    """Both filters follow u + (a_0 - u) exp(-t / T) to order 4. MuJoCo equals it for `filter`; for
    `filterexact` it lags twice: a step covers (1 - exp(-z)) (1 - exp(-z)) / z of u - a, z = h / T,
    but for the error of order 4."""
    body = '<body><joint name="a" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body>'
    drive = f'<general joint="a" dyntype="{kind}" dynprm=".05"/>'
    option = '<option timestep=".01" integrator="RK4"/>'
    m = mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}<worldbody>{body}</worldbody><actuator>{drive}</actuator></mujoco>"
    )
    d, steps, z = mujoco.MjData(m), 3, 0.01 / 0.05
    d.ctrl[:], d.act[:] = 0.9, 0.3
    model = rb.load(m)
    start = model.default_state().replace(x=jnp.asarray(d.act))
    path = rb.rollout(model, start, jnp.asarray(d.ctrl), steps=steps, integrator="rk4")
    for _ in range(steps):
        mujoco.mj_step(m, d)
    ours, theirs = (
        0.9 - 0.6 * (1 - f) ** steps for f in (1 - np.exp(-z), (1 - np.exp(-z)) ** 2 / z)
    )
    np.testing.assert_allclose(path.x[-1], ours, atol=1e-5)
    np.testing.assert_allclose(d.act, ours if kind == "filter" else theirs, atol=1e-5)
    if kind == "filter":
        np.testing.assert_allclose(path.x[-1], d.act, atol=F64_ROUNDING)


def test_a_step_ends_within_the_range():
    winding = ControlIntegral(jnp.array([-0.1, 0.2]))
    assert winding.advanced(9.0, jnp.array(0.0), 0.1) == 0.2
    assert winding.advanced(-9.0, jnp.array(0.0), 0.1) == -0.1


LAWS = [
    '<general joint="h" dyntype="integrator" actrange="-.2 .3" ctrlrange="-.5 .5" gainprm="3"/>',
    '<general joint="s" dyntype="filter" dynprm="0.07" actrange="-.2 .3" actearly="true"/>',
    '<general joint="k" dyntype="filterexact" dynprm="0.001" forcerange="-.2 .4"/>',
    '<position joint="k" kp="3" timeconst="0.1"/>',
    '<intvelocity joint="b" gear="1 2 3" kp="3" kv="0.1"/>',
    '<position joint="b" gear="1 -2 0.3" kp="3" kv="0.1"/>',
    '<position joint="b" gear="0.1 0.2 0" kp="3" timeconst="0.1"/>',
    '<general joint="b" gear="0.2 0.1 0.3" dyntype="filter" dynprm="0.1" gainprm="3"'
    ' biastype="affine" biasprm="0 -3" actearly="true"/>',
    '<intvelocity site="s4" refsite="s1" gear="0 0 0 0.3 0.2 1" kp="2" actrange="-6 8"/>',
    '<muscle tendon="rope" lengthrange="0.5 2.5" force="20" tausmooth="0.2"/>',
    '<cylinder joint="s" timeconst="0.2" area="2" bias="1 2 3"/>',
    '<general joint="h" dyntype="muscle" dynprm="0.01 0.04" gaintype="affine" gainprm="1 2 3"/>',
]


def test_against_mujoco():
    assert max(errors(limbs(*LAWS))) < F64_PARITY


def test_without_controls_nothing_moves_the_states():
    model = load_quietly(limbs(*LAWS[:2]))
    state = model.default_state().replace(x=jnp.array([0.1, 0.2]))
    run = jax.jit(actuation)
    tau, rate, after = run(model, state, None)
    np.testing.assert_array_equal(after, [0.1, 0.2])
    assert not np.any(tau) and not np.any(rate)


TURNED = """
<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="Euler">
<flag contact="disable" constraint="disable" eulerdamp="disable"/></option>
<worldbody><site name="w"/><body><joint name="j"/><geom size="0.1" pos="0.2 0 0"/><site name="s"/>
</body></worldbody><actuator>
<general site="s" refsite="w" gear="0 0 0 0 0 1" dyntype="filterexact" dynprm="0.1"
  actrange="-.3 .4" {} gainprm="2" biastype="affine" biasprm="0 -2 -0.1"/>
<intvelocity site="s" refsite="w" gear="0 0 0 0 0 2" kp="2" actrange="-.3 .4"/>
</actuator></mujoco>
"""


@pytest.mark.skipif(mujoco.__version__ < "4", reason="MuJoCo 3 clips such an angle otherwise")
@pytest.mark.parametrize("early", ["", 'actearly="true"'])
def test_an_angle_a_full_turn_from_its_range_is_left_as_mujoco_leaves_it(early):
    """MuJoCo clips a setpoint to its range, and then adds full turns until it is nearest to the
    angle: the state may end a turn beyond the range."""
    m = mujoco.MjModel.from_xml_string(TURNED.format(early))
    model, u, farthest = load_quietly(m), jnp.zeros((12, 2)), 0.0
    run = jax.jit(lambda state: rb.rollout(model, state, u).x[1:])
    for q in (3.1, -3.1, 3.0):
        data = mujoco.MjData(m)
        data.qpos, data.qvel, data.act = q, 9.0, [-0.2, 0.3]
        found = run(rb.State(*(jnp.asarray(x) for x in (data.qpos, data.qvel, data.act))))
        want = []
        for _ in range(12):
            mujoco.mj_step(m, data)
            want.append(data.act.copy())
        np.testing.assert_allclose(found, want, atol=1e-11)
        farthest = max(farthest, np.abs(want).max())
    assert farthest > 5.0  # some steps did end beyond the range


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_range_holds_up_to_full_periods_of_an_angle(dtype):
    winding, period = ControlIntegral(jnp.array([-0.3, 0.4], dtype)), jnp.asarray(2 * np.pi, dtype)
    kept = jnp.array([-0.3, 0.1, 0.4], dtype)
    for turns in (-2, -1, 0, 1, 2):
        a = kept + turns * period
        np.testing.assert_array_equal(winding.within(a, period), a)
    beyond = jnp.array([0.5, 3.0, -0.4, 0.5 + 2 * np.pi], dtype)
    want = np.array([0.4, 0.4, -0.3, 0.4], dtype)
    np.testing.assert_array_equal(winding.within(beyond, period), want)
    np.testing.assert_array_equal(winding.within(beyond), want)
    assert ControlIntegral(FREE).within(period, period) is period
