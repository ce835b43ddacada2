"""The options are known to this jaxlib, change no result, and stay out of another `jit`."""

import subprocess
import sys

import chex
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.compiler import kernels_available
from rbjax.compiling import xla_accepts
from rbjax.dynamics.drivers.unrolled import Unrolled
from tests.tolerances import F64_ROUNDING


def test_every_option_is_known_and_an_unknown_one_is_told() -> None:
    options = rb.compiler_options()
    assert options and all(xla_accepts(name, value) for name, value in options.items())
    assert not xla_accepts("xla_cpu_no_such_option", True)


def rolled(model, start):
    return rb.rollout(model, start, dt=0.01, steps=8, save_every=8).q[-1]


def simulated(model, start):
    solve = {"dt": 0.01, "adjoint": diffrax.ForwardMode()}
    return rb.simulate(model, start, jnp.array([0.0, 0.08]), **solve).q[-1]


@pytest.mark.slow
@pytest.mark.parametrize("march", [rolled, pytest.param(simulated, marks=pytest.mark.slow)])
def test_motion_is_the_same_alone_within_jit_and_differentiated(march) -> None:
    """Alone it is compiled with options, which JAX refuses inside of another `jit`."""
    model = rb.load("double_pendulum")
    start = rb.State(jnp.array([0.3, -0.2]), jnp.array([1.0, 0.4]))

    def end(state):
        return march(model, state)

    alone = end(start)
    within = jax.jit(lambda: end(start))()  # nothing of it is traced, but the program around it is
    np.testing.assert_allclose(within, alone, atol=F64_ROUNDING)
    np.testing.assert_allclose(jax.jit(end)(start), alone, atol=F64_ROUNDING)
    rate = jax.jvp(end, (start,), (start,))[1]
    _, linear = jax.linearize(end, start)
    np.testing.assert_allclose(jax.jit(linear)(start), rate, atol=F64_ROUNDING)


def test_rbjax_may_be_imported_within_a_program() -> None:
    """An outer trace of a call is found even if the import was inside a trace. It leaves matplotlib
    to the plots."""
    code = """
import sys, jax
def f(x):
    import rbjax as rb
    model = rb.load("pendulum")
    return x * rb.mass_matrix(model, model.default_state().q)
print(jax.jit(f)(0.0), f(0.0))
assert 'matplotlib' not in sys.modules
import rbjax; rbjax.plotting.Camera
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert out.stdout.split() == ["[[0.]]", "[[0.]]"], out.stderr


# ------------------------------------------------- a changed number compiles nothing again

ARM = """<mujoco><option><flag contact="disable"/></option><worldbody>
  <body name="{0} upper"><joint name="a" axis="0 1 0" damping="0.1" armature="0.2"/>
    <geom size="0.1" pos="0.1 0.2 0.3"/>
    <body name="lower" pos="0 0 0.5"><joint name="b" axis="0 1 0" stiffness="3"/>
      <geom size="0.1" pos="0 0 0.4"/></body></body></worldbody>
  <actuator><motor joint="a" gear="2"/></actuator></mujoco>"""


def others(model: rb.Model) -> list[rb.Model]:
    """The model with other numbers; where forces cross zero, too."""
    bodies, joints, actuators = model.bodies, model.joints, model.actuators
    return [
        model.replace(bodies=bodies.replace(mass=2 * bodies.mass, com=1.1 * bodies.com)),
        model.replace(gravity=2 * model.gravity),
        model.replace(joints=joints.replace(damping=0 * joints.damping)),
        model.replace(joints=joints.replace(stiffness=joints.stiffness - 3)),
        model.replace(joints=joints.replace(range=0 * joints.damping[:, None] + jnp.ones(2))),
        model.replace(actuators=actuators.replace(gear=0 * actuators.gear)),
    ]


def of_another_structure(model: rb.Model) -> list[rb.Model]:
    """Where numbers that `simulate` keeps the zeros of cross zero: to it, another robot."""
    bodies, joints = model.bodies, model.joints
    return [
        model.replace(gravity=jnp.zeros(3)),
        model.replace(gravity=jnp.array([1.0, 2.0, -3.0])),
        model.replace(bodies=bodies.replace(com=bodies.com + 0.1)),
        model.replace(joints=joints.replace(armature=0 * joints.armature)),
        model.replace(joints=joints.replace(axis=joints.axis + 0.1)),
    ]


def test_simulate_traces_a_control_for_one_robot_and_not_for_its_other_numbers() -> None:
    model, ts = rb.load(ARM.format("simulated")), jnp.array([0.0, 0.02])
    start = rb.State(jnp.array([0.3, -0.2]), jnp.array([1.0, 0.4]))
    control = chex.assert_max_traces(lambda t, s: -s.v[:1], n=1)
    paths = [
        rb.simulate(m, start, ts + k, control, dt=0.01).q[-1]
        for k, m in enumerate([model, *others(model)])
    ]
    told = np.unique(np.round([q[0] for q in paths], 12))
    assert len(told) == len(paths) - 1  # all but the range
    with pytest.raises(AssertionError, match="traced > 1 times"):
        for m in of_another_structure(model):
            rb.simulate(m, start, ts, control, dt=0.01)


def test_rollout_traces_a_policy_once() -> None:
    model = rb.load(ARM.format("rolled"))
    start = rb.State(jnp.array([0.3, -0.2]), jnp.array([1.0, 0.4]))
    # a thread looks first how large the policy is
    policy = chex.assert_max_traces(lambda t, s: -s.v[:1], n=2 if kernels_available() else 1)
    for m in (model, *others(model), *of_another_structure(model)):
        rb.rollout(m, start, policy, 0.01, steps=2)


def test_forward_dynamics_is_traced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    model, asked = rb.load(ARM.format("pushed")), []
    joints = Unrolled.joints

    def counted(self, q, v):
        asked.append(q)
        return joints(self, q, v)

    monkeypatch.setattr(Unrolled, "joints", chex.assert_max_traces(counted, n=1))
    q, v = jnp.array([0.3, -0.2]), jnp.array([1.0, 0.4])
    for m in (model, *others(model), *of_another_structure(model)):
        rb.forward_dynamics(m, q, v, v)
    assert len(asked) == 1
