"""Limits, friction loss and equalities together with contacts, against MuJoCo C."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.model import State
from tests.contact.test_soft import compare, states_of
from tests.tolerances import F64_IDENTITY, F64_PARITY, GRADIENT, relative_error

pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model")

OPTION = '<option timestep=".002" cone="{cone}" impratio="2" tolerance="0"/>'
#: the floor, the only geom that others touch
FLOOR = '<geom type="plane" size="0 0 1" friction=".8 .01 .002" contype="0" conaffinity="2"/>'
BODIES = '<default><geom contype="2" conaffinity="0"/></default>'
#: a four-bar linkage on a base that falls, and a box that is welded to the world near the floor
LOOPS = """<body name="base" pos="0 0 .5"><freejoint/><geom type="box" size=".3 .1 .05"/>
  <body name="left" pos="-.25 0 .05"><joint name="l" axis="0 1 0" range="-80 80" limited="true"/>
    <geom type="capsule" fromto="0 0 0 0 0 .3" size=".03"/>
    <body name="top" pos="0 0 .3"><joint type="ball"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03"/></body></body>
  <body name="right" pos=".25 0 .05"><joint name="r" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 .28" size=".03"/></body></body>
<body name="held" pos="0 .6 .12" quat=".9 .1 .3 0"><freejoint/><geom type="box" size=".1 .2 .1"/>
  </body>"""
EQUALITY = """<equality><connect body1="top" body2="right" anchor=".5 0 0" solref=".03 .9"/>
  <weld body1="held" torquescale="1.7" solimp=".5 .9 .1 .4 3" solref=".1 1"/></equality>"""
#: two arms with coupled joints and tendons, whose tips touch the floor
ARMS = """<body name="a" pos="0 0 .45"><joint name="a" axis="0 1 .1" damping=".2"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/><site name="a" pos=".3 0 .05"/>
  <body pos=".3 0 0"><joint name="b" axis="0 1 0" frictionloss=".1"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/><site name="b" pos=".3 0 0"/></body>
  </body>
<body name="c" pos="0 1 .45"><joint name="c" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/><site name="c" pos=".1 0 .06"/>
  <body pos=".3 0 0"><joint name="d" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/><site name="d" pos=".3 0 0"/></body>
  </body>
<body name="drum" pos="0 .5 .5"><geom name="drum" type="cylinder" size=".1 .3" euler="90 0 0"
  contype="0" conaffinity="0"/></body><site name="side" pos="0 .5 .9"/>"""
TENDONS = """<tendon>
  <spatial name="cable" limited="true" range="0 1.02" margin=".03" frictionloss=".6"
    solreflimit=".03 .8" solimpfriction=".8 .9 .1 .5 2"><site site="a"/><geom geom="drum"
    sidesite="side"/><site site="c"/></spatial>
  <spatial name="rope" limited="true" range=".2 1.1" frictionloss=".2"><site site="b"/>
    <site site="d"/></spatial>
  <fixed name="belt" limited="true" range="-.5 .6" frictionloss=".3"><joint joint="a" coef="1"/>
    <joint joint="d" coef="-.7"/></fixed>
  <fixed name="gear"><joint joint="b" coef="1"/><joint joint="d" coef=".5"/></fixed>
  <fixed name="one" limited="true" range="-1 .4"><joint joint="c" coef="2"/></fixed></tendon>
  <equality><joint joint1="b" joint2="a" polycoef=".1 .5 -.2 .1 .05" solref=".05 1"/>
  <tendon tendon1="gear" tendon2="belt" polycoef="0 .8 .1 0 0" solref=".08 1"/></equality>"""
SCENES = {"loops": (LOOPS, EQUALITY), "arms": (ARMS, TENDONS)}


def compiled(scene: str, cone: str = "elliptic") -> mujoco.MjModel:
    bodies, rest = SCENES[scene]
    text = OPTION.format(cone=cone) + BODIES + f"<worldbody>{FLOOR}{bodies}</worldbody>{rest}"
    m = mujoco.MjModel.from_xml_string(f"<mujoco>{text}</mujoco>")
    m.opt.ls_tolerance, m.opt.iterations, m.opt.ls_iterations = 1e-10, 300, 100
    return m


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("scene", list(SCENES))
def test_acceleration_equals_mujoco(scene: str, cone: str) -> None:
    assert compare(compiled(scene, cone), steps=400, every=20) >= 1


def moving(scene: str) -> tuple[rb.Model, State]:
    """A scene in contact, with its rows active."""
    m = compiled(scene)
    q, v, *_ = states_of(m, 150, 1)[-1]
    return rb.load(m, contacts=True), State(jnp.asarray(q), jnp.asarray(v))


@pytest.mark.parametrize("scene", list(SCENES))
def test_gradient_is_implicit(scene: str) -> None:
    """The rows are differentiated too, by the state and by masses and softness."""
    model, state = moving(scene)
    softness = [x.solref for x in model.constraints]

    def f(dx, v, mass, factor, loss):
        constraints = [
            x.replace(solref=y * factor) for x, y in zip(model.constraints, softness, strict=True)
        ]
        bodies = model.bodies.replace(mass=model.bodies.mass * mass)
        changed = model.replace(bodies=bodies, constraints=tuple(constraints))
        if model.tendons is not None:
            own = model.tendons
            changed = changed.replace(
                tendons=own.replace(
                    frictionloss=own.frictionloss * loss, limit_solref=own.limit_solref * factor
                )
            )
        return rb.acceleration(changed, State(rb.integrate(model, state.q, dx), v))

    at = (jnp.zeros(model.nv), state.v, jnp.ones(1), jnp.ones(2), jnp.ones(1))
    keys = jax.random.split(jax.random.key(1), len(at))
    to = tuple(jax.random.normal(k, x.shape) for k, x in zip(keys, at, strict=True))
    rate = jax.jit(lambda to: jax.jvp(f, at, to)[1])(to)
    h, run = 1e-6, jax.jit(f)
    ends = [run(*(x + s * h * y for x, y in zip(at, to, strict=True))) for s in (1, -1)]
    assert relative_error(rate, (ends[0] - ends[1]) / (2 * h), floor=1.0) < 10 * GRADIENT
    w = jax.random.normal(jax.random.key(2), (model.nv,))
    back = jax.jit(lambda w: jax.vjp(f, *at)[1](w))(w)
    both = sum(jnp.vdot(x, y) for x, y in zip(back, to, strict=True))
    assert relative_error(both, jnp.vdot(w, rate)) < F64_IDENTITY


@pytest.mark.parametrize("scene", list(SCENES))
def test_f32(scene: str) -> None:
    model, state = moving(scene)
    exact = jax.jit(lambda state: rb.acceleration(model, state))(state)
    single = State(state.q.astype(jnp.float32), state.v.astype(jnp.float32))
    found = jax.jit(lambda state: rb.acceleration(model.astype(jnp.float32), state))(single)
    assert found.dtype == jnp.float32
    assert relative_error(found, exact, floor=1.0) < 2e-3


@pytest.mark.parametrize("n", [0, 1, 3])
def test_batches(n: int) -> None:
    model, state = moving("arms")
    run = jax.jit(rb.threads(lambda q, v: rb.acceleration(model, State(q, v))))
    exact = run(state.q, state.v)
    many = [
        jnp.stack([x, x + 0.01, x][:n]) if n else jnp.zeros((0, len(x))) for x in (state.q, state.v)
    ]
    found = jax.vmap(run)(*many)
    assert found.shape == (n, model.nv)
    for k in range(n):
        want = exact if k != 1 else run(state.q + 0.01, state.v + 0.01)
        np.testing.assert_allclose(found[k], want, rtol=1e-9)


def test_rollout_equals_mujoco() -> None:
    m = compiled("arms")
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    model, d = rb.load(m), mujoco.MjData(m)
    for _ in range(200):
        mujoco.mj_step(m, d)
    path = jax.jit(lambda state: rb.rollout(model, state, steps=200))(model.default_state())
    np.testing.assert_allclose(path.q[-1], d.qpos, atol=1e-10)


def test_all_rows_are_loaded() -> None:
    m = compiled("arms")
    model = rb.load(m, contacts=True)
    assert not [x for x in model.dropped if "tendon" in x or "equality" in x]
    assert [type(x) for x in model.constraints] == [rb.constraints.Soft] * 2
    assert any("tendon limits" in x for x in rb.load(m, contacts=False).dropped)


def test_rigid_constraints_are_named() -> None:
    model, state = moving("arms")
    rigid = model.with_constraints(model.constraints[0].of)
    with pytest.raises(
        rb.InputError, match=r"1 of 3 constraints .* rigid \(JointPolynomial\); mak"
    ):
        rb.step(rigid, state)


def test_mimics_are_soft() -> None:
    """A mimic of a URDF is MuJoCo's joint equality with default parameters."""
    link = '<inertial><mass value="1"/><origin xyz=".2 0 0"/><inertia ixx=".1" iyy=".1" izz=".1" ' \
           'ixy="0" ixz="0" iyz="0"/></inertial>'  # fmt: skip
    joint = '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>' \
            '<limit lower="-3" upper="3" effort="9" velocity="9"/>' \
            '<origin xyz=".4 0 0"/><axis xyz="0 1 0"/>{3}</joint>'  # fmt: skip
    text = "<robot name='r'>" + "".join(f'<link name="{x}">{link}</link>' for x in "xyz")
    text += joint.format("j", "x", "y", "")
    text += joint.format("k", "y", "z", '<mimic joint="j" multiplier="-.5" offset=".2"/>')
    text += "</robot>"
    m = mujoco.MjModel.from_xml_string(text)
    m.opt.tolerance = 0.0
    d = mujoco.MjData(m)
    assert m.neq == 1
    model = rb.load(text, contacts=True, floating_base=False)
    q, v = jnp.array([0.3, -0.4]), jnp.array([1.0, 2.0])
    d.qpos, d.qvel = q, v
    mujoco.mj_forward(m, d)
    found = jax.jit(lambda q, v: rb.acceleration(model, State(q, v)))(q, v)
    assert relative_error(found, d.qacc) < F64_PARITY


def test_time_dependent_constraint() -> None:
    """Without contacts the problem has the solution of the formulation "compliant"."""
    bodies = """<body pos="0 0 1"><joint name="j" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/></body>"""
    m = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    model = rb.load(m, contacts=True)
    swing = rb.constraints.Prescribed("j", lambda t: 0.3 * jnp.sin(2 * t))
    model = model.with_constraints(rb.constraints.Soft.on(model, swing, solref=(0.05, 1.0)))
    state = State(jnp.array([0.2]), jnp.array([0.5]))
    run = jax.jit(lambda t: rb.acceleration(model, state, t=t))
    free = model.replace(contact=None)
    for t in (0.0, 0.7):
        want = rb.acceleration(free, state, t=t, constraints="compliant")
        assert relative_error(run(t), want) < F64_IDENTITY
    slope = jax.jvp(run, (0.7,), (1.0,))[1]
    assert relative_error(slope, (run(0.7 + 1e-6) - run(0.7 - 1e-6)) / 2e-6) < 10 * GRADIENT


CASSIE = Path(__file__).parents[4] / "shared" / "data" / "cassie"  # beside the repository
FOOT = """<geom type="capsule" size="0.02" fromto="-.0528 .0926 0 .0697 -.0102 0" contype="2"
  conaffinity="0"/>"""


@pytest.mark.skipif(not CASSIE.exists(), reason=f"{CASSIE} is not there")
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_cassie_on_the_ground(cone: str) -> None:
    """Four loops, limits, springs and feet on the floor."""
    text = (CASSIE / "cassie.xml").read_text()
    text = text.replace("<option", f'<option cone="{cone}" tolerance="0"')
    text = text.replace("<worldbody>", f"<worldbody>{FLOOR}", 1)
    for side in ("left", "right"):
        at = text.index("<joint", text.index(f'<body name="{side}-foot"'))
        text = text[:at] + FOOT + text[at:]
    m = mujoco.MjModel.from_xml_string(text)
    m.opt.ls_tolerance, m.opt.iterations, m.opt.ls_iterations = 1e-10, 300, 100
    m.opt.timestep = 0.002
    assert compare(m, steps=400, every=20, entries=False) >= 2


SENSORS = {
    "loops": """<sensor><force site="pad"/><torque site="pad"/><accelerometer site="pad"/>
      <force site="hand"/></sensor>""",
    "arms": """<sensor><tendonlimitfrc tendon="cable"/><tendonlimitfrc tendon="belt"/>
      <tendonlimitfrc tendon="one"/></sensor>""",
}


@pytest.mark.parametrize("scene", list(SCENES))
def test_sensors_read_the_forces_of_rows(scene: str) -> None:
    """Force sensors see connects and welds, and limit sensors the limits of tendons."""
    bodies, rest = SCENES[scene]
    for name, at in (("top", "pad"), ("held", "hand")):
        start = bodies.find(f'<body name="{name}"')
        if start >= 0:
            end = bodies.index("<geom", start)
            bodies = f'{bodies[:end]}<site name="{at}"/>{bodies[end:]}'
    text = OPTION.format(cone="elliptic") + BODIES + f"<worldbody>{FLOOR}{bodies}</worldbody>"
    m = mujoco.MjModel.from_xml_string(f"<mujoco>{text}{rest}{SENSORS[scene]}</mujoco>")
    m.opt.ls_tolerance, m.opt.iterations, m.opt.ls_iterations = 1e-10, 300, 100
    model, d = rb.load(m, contacts=True), mujoco.MjData(m)
    sense = jax.jit(lambda q, v: rb.sense(model, State(q, v)))
    d.qvel[:] = 0.5
    largest = np.zeros(m.nsensordata)
    for _ in range(6):
        for _ in range(40):
            mujoco.mj_step(m, d)
        mujoco.mj_forward(m, d)
        found = sense(jnp.asarray(d.qpos), jnp.asarray(d.qvel))
        assert relative_error(found, d.sensordata, floor=1.0) < F64_PARITY
        largest = np.maximum(largest, abs(d.sensordata))
    assert (largest > 1e-3).sum() >= 3
