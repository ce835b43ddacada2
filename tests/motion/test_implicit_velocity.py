"""Integrators that are implicit in the velocity, against MuJoCo C."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.lanes import Mat3, Vec3
from rbjax.model import State
from rbjax.spatial import Transform
from tests.tolerances import F64_PARITY, F64_ROUNDING, relative_error

pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model")

#: integrator of MuJoCo -> integrator of rollout
NAMES = {
    "EULER": "euler_implicit_damping",
    "IMPLICITFAST": "implicitfast",
    "IMPLICIT": "implicit",
    "RK4": "rk4",
}
CART_POLE = """<mujoco><option timestep=".01"/><worldbody><body>
<joint name="cart" type="slide" axis="1 0 0" damping="3"/><geom size=".1" mass="1"/>
  <body><joint axis="0 1 0" damping=".4 .3"/><geom type="capsule" fromto="0 0 0 0 0 .5" size=".04"/>
</body></body></worldbody><actuator><motor joint="cart" gear="20"/></actuator></mujoco>"""
#: two hinges and a ball, with dampers and polynomials, tendons and actuators of all transmissions
ARM = """<mujoco><option timestep=".01" {option}/><worldbody>
<body><joint axis="0 1 0" damping=".05 .03" name="a" {joint}/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".05"/><site name="s" pos=".1 0 -.1"/>
  <body pos="0 0 -.3"><joint axis="1 1 0" damping=".02" name="b"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".04"/>
    <body pos="0 0 -.3"><joint type="ball" damping=".01" name="c"/>
      <geom type="capsule" fromto="0 0 0 .1 0 -.3" size=".04"/><site name="tip" pos=".1 .1 -.1"/>
</body></body></body></worldbody>
<tendon><fixed name="t" {tendon}><joint joint="a" coef="1"/><joint joint="b" coef="-.5"/></fixed>
<spatial damping=".2 .04"><site site="s"/><site site="tip"/></spatial></tendon>
<actuator>{actuators}</actuator></mujoco>"""
DRIVES = """<position joint="a" kp="1" kv=".3"/><velocity joint="b" kv=".07" gear="2"/>
<position tendon="t" kp=".5" kv=".3"/>
<muscle joint="b" lengthrange="-1 1" range=".7 1.4" force="4"/>
<general site="tip" gear=".1 .2 0 0 .01 .03" biastype="affine" biasprm="0 0 -.2"/>
<general jointinparent="c" gear=".01 .02 0" biastype="affine" biasprm="0 -.1 -.2"/>
<general joint="a" gaintype="affine" gainprm="1 .2 .3" dyntype="integrator" actearly="true"/>"""
LIMITED = """<position joint="a" kp="10" kv="3"/><position tendon="t" kp=".5" kv=".3"/>
<position joint="b" kp="5" kv="3" forcerange="-.1 .1"/>"""
RANGE = 'actuatorfrcrange="-.01 .01"'
ROBOTS = {
    "cart-pole": CART_POLE,
    "passive": ARM.format(option="", joint="", tendon="", actuators=""),
    "driven": ARM.format(option="", joint="", tendon="", actuators=DRIVES),
    "limited": ARM.format(option="", joint=RANGE, tendon=RANGE, actuators=LIMITED),
}
FREE = """<mujoco><option timestep=".01"/><worldbody><body><joint type="free" damping=".3"/>
<geom pos=".1 .2 0" type="box" size=".1 .2 .3"/><body pos=".1 0 0">{}<geom size=".2"/></body></body>
</worldbody></mujoco>"""
WATER = """<mujoco><option timestep=".01" density="100" viscosity=".3" wind="1 .5 0"/><worldbody>
<body><joint axis="0 1 0"/><geom {0} pos=".1 .2 0" type="box" size=".1 .2 .3"/>
<body pos=".4 0 0"><joint axis="1 0 0"/><geom {0} pos=".1 .2 0" type="box" size=".1 .2 .3"/></body>
</body></worldbody></mujoco>"""
ROBOTS |= {"in water": WATER.format(""), "ellipsoids": WATER.format('fluidshape="ellipsoid"')}
ROBOTS |= {"free": FREE.format(""), "free with a joint": FREE.format("<joint/>")}


def start(text: str, integrator: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    m = mujoco.MjModel.from_xml_string(text)
    m.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    m.opt.tolerance, m.opt.iterations = 0, 300
    d, draw = mujoco.MjData(m), np.random.default_rng(0)
    d.qvel[:] = draw.standard_normal(m.nv)
    mujoco.mj_integratePos(m, d.qpos, d.qvel, 0.3)
    d.ctrl[:] = draw.standard_normal(m.nu)
    d.act[:] = 0.3
    return m, d


def state_of(d: mujoco.MjData) -> State:
    x = jnp.asarray(d.act) if d.act.size else None
    return State(jnp.asarray(d.qpos), jnp.asarray(d.qvel), x)


def compare(text: str, integrator: str, steps: int = 1, **options: bool) -> None:
    m, d = start(text, integrator)
    model, state, ctrl = rb.load(m), state_of(d), jnp.asarray(d.ctrl)
    ctrl = {"ctrl": ctrl} if m.nu else {}
    name = NAMES[integrator]
    path = rb.rollout(model, state, **ctrl, steps=steps, integrator=name, **options)
    for _ in range(steps):
        mujoco.mj_step(m, d)
    assert relative_error(path.v[-1], d.qvel, floor=1.0) < F64_PARITY
    assert relative_error(path.q[-1], d.qpos, floor=1.0) < F64_PARITY


@pytest.mark.parametrize("integrator", NAMES)
def test_a_step_of_a_cart_pole_equals_mujoco(integrator: str) -> None:
    compare(ROBOTS["cart-pole"], integrator)


@pytest.mark.parametrize("integrator", NAMES)
@pytest.mark.parametrize("robot", ["passive", "driven", "free"])
def test_a_step_equals_mujoco(robot: str, integrator: str) -> None:
    compare(ROBOTS[robot], integrator)


@pytest.mark.parametrize("integrator", list(NAMES)[:3])
@pytest.mark.parametrize("robot", ["limited", "free with a joint", "in water", "ellipsoids"])
def test_implicit_steps_equal_mujoco(robot: str, integrator: str) -> None:
    """Actuators at a limit of their own, of their joint and of their tendon have no derivative, as
    in MuJoCo. The bias forces of a free body that carries a joint are explicit in implicitfast.
    Drag of boxes and ellipsoids is implicit."""
    compare(ROBOTS[robot], integrator, kernel=False)


@pytest.mark.parametrize("integrator", list(NAMES)[:3])
def test_a_hundred_steps_equal_mujoco(integrator: str) -> None:
    compare(ROBOTS["driven"], integrator, 100, kernel=False)


def test_default_without_damping_is_semi_implicit_euler() -> None:
    """Without dampers the step has no second solution, and equals semi-implicit Euler."""
    model = rb.load("double_pendulum")
    state = State(jnp.array([0.3, 1.0]), jnp.array([-1.0, 2.0]))
    plain = rb.step(model, state)
    for name in list(NAMES.values())[:2]:
        np.testing.assert_allclose(rb.step(model, state, integrator=name).v, plain.v, rtol=1e-13)


def test_stiff_damper_is_stable() -> None:
    """v+ = v / (1 + h d / m): a damper of any size stops a body and does not overshoot."""
    text = '<body><joint type="slide" axis="1 0 0" damping="1e6"/><geom size=".1" mass="2"/></body>'
    model = rb.load(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    state = State(jnp.zeros(1), jnp.ones(1))
    for name in list(NAMES.values())[:3]:
        found = rb.step(model, state, dt=0.01, integrator=name)
        np.testing.assert_allclose(found.v, 1 / (1 + 0.01 * 1e6 / 2), rtol=1e-10)


@pytest.mark.filterwarnings("ignore:.*biased at any step size")
@pytest.mark.parametrize("integrator", list(NAMES.values())[:3])
def test_derivative_of_a_step(integrator: str) -> None:
    """Forward and reverse derivatives by state, controls, damping and the step, against
    differences."""
    m, d = start(ROBOTS["driven"], "IMPLICIT")
    model, state = rb.load(m), state_of(d)

    def f(dx: jax.Array, v: jax.Array, ctrl: jax.Array, damping: jax.Array, dt: jax.Array):
        joints = model.joints.replace(damping=model.joints.damping * damping)
        at = State(rb.integrate(model, state.q, dx), v, state.x)
        changed = model.replace(joints=joints)
        return rb.step(changed, at, ctrl, dt, integrator=integrator).v

    n = model.nv
    at = (jnp.zeros(n), state.v, jnp.asarray(d.ctrl), jnp.ones(n), jnp.array(0.01))
    keys = jax.random.split(jax.random.key(1), len(at))
    to = tuple(jax.random.normal(k, x.shape) for k, x in zip(keys, at, strict=True))
    to = (*to[:-1], 0.01 * to[-1])
    rate = jax.jit(lambda at, to: jax.jvp(f, at, to)[1])(at, to)
    run, h = jax.jit(f), 1e-6
    ends = [run(*(x + s * h * y for x, y in zip(at, to, strict=True))) for s in (1, -1)]
    assert relative_error(rate, (ends[0] - ends[1]) / (2 * h), floor=1.0) < 1e-7
    w = jax.random.normal(jax.random.key(2), (n,))
    back = jax.jit(lambda at: jax.vjp(f, *at)[1](w))(at)
    both = sum(jnp.vdot(x, y) for x, y in zip(back, to, strict=True))
    assert relative_error(both, jnp.vdot(w, rate)) < 1e-10


class Parabola(rb.joints.Node):
    name, coordinates = "implicit_parabola", 1

    def pose(self, q, params):
        return Transform(Mat3.identity(), Vec3(q[0], 0.0, q[0] * q[0]))


def test_bias_of_a_joint_whose_axis_moves() -> None:
    """A bead on z = x^2: M = m (1 + 4 q^2), b = 4 m q v^2 + 2 m g q, db/dv = 8 m q v."""
    rb.joints.register(Parabola())
    text = '<body><joint name="j" type="slide"/><geom size=".1" mass="2"/></body>'
    given = f'<mujoco><option gravity="0 0 -9"/><worldbody>{text}</worldbody></mujoco>'
    model = rb.load(given).with_joint("j", "implicit_parabola")
    q, v, h, m = 0.4, 1.5, 0.01, 2.0
    state = State(jnp.array([q]), jnp.array([v]))
    found = rb.step(model, state, dt=h, integrator="implicit")
    inertia = m * (1 + 4 * q * q) + h * 8 * m * q * v
    expected = v - h * (4 * m * q * v * v + 2 * m * 9 * q) / inertia
    np.testing.assert_allclose(found.v, [expected], rtol=F64_ROUNDING)


def test_not_with_rigid_constraints() -> None:
    model = rb.load("four_bar")
    with pytest.raises(rb.InputError, match="implicitfast"):
        rb.step(model, model.default_state(), integrator="implicitfast")
