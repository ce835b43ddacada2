"""MuJoCo's `discrete` integrator, against MuJoCo C."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.model import State
from tests.motion.test_implicit_velocity import ROBOTS, start, state_of
from tests.tolerances import F64_PARITY, F64_ROUNDING, relative_error

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*left out of the model", "ignore:.*parameters that no passive joint can have"
)

FLOOR = """<mujoco><option timestep=".005" cone="{cone}" impratio="{ratio}" integrator="discrete">
<flag {flags}/></option>
<default><geom condim="{dim}" friction=".6 .02 .01" solref="{solref}"
  solimp=".8 .95 .01"/></default>
<worldbody><geom type="plane" size="0 0 1"/>"""
#: a body on the floor and an arm with a limit, friction loss, a stiff spring and a stiff servo
ARM = """<body pos="0 0 .11"><freejoint/><geom type="box" size=".2 .1 .1" mass="2"/>
<body pos=".2 0 .1"><joint name="a" axis="0 1 0" range="-20 5" stiffness="300" damping=".5"
    frictionloss=".2" springref="20" solreflimit=".001 1"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".05" mass=".5"/></body></body></worldbody>
<actuator><position joint="a" kp="2000" kv="10"/></actuator></mujoco>"""
#: a ball on the floor, and a box that spins in the air
BALL = """<body pos="0 0 .095"><freejoint/><geom type="sphere" size=".1" mass="2"/></body>
<body pos="0 .3 .9"><freejoint/><geom type="box" size=".2 .1 .3" mass="2" pos=".1 0 0"/></body>
</worldbody></mujoco>"""
#: two hinges with a limited, springy tendon, a coupling and a weld
TENDON = """<body pos="0 0 .4"><joint name="a" axis="0 1 0" damping=".1" armature=".01"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".05"/>
<body pos=".3 0 0"><joint name="b" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".05"/></body></body>
<body name="w" pos="1 0 .5"><joint axis="0 1 0" pos="0 0 .3"/><joint type="slide" axis="0 0 1"/>
<geom type="sphere" size=".1" mass="2"/></body></worldbody>
<tendon><fixed name="t" stiffness="5000" damping="1" limited="true" range="-.5 .05"
  frictionloss=".1"><joint joint="a" coef="1"/><joint joint="b" coef="-.7"/></fixed></tendon>
<equality><joint joint1="a" joint2="b" polycoef="0 .5 0 0 0" solref=".002 1"/>
<weld body1="w" solref=".001 1"/></equality>
<actuator><position tendon="t" kp="400"/></actuator></mujoco>"""
STIFF = {"polynomial": 'stiffness="200 30 900"', "negative": 'stiffness="-3" damping="-1"'}


def floor(body: str, cone: str, ratio: float, dim: int, solref: str, flags: str = "") -> str:
    given = FLOOR.format(cone=cone, ratio=ratio, dim=dim, solref=solref, flags=flags)
    return given + body


def disturbed(text: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    m = mujoco.MjModel.from_xml_string(text)
    m.opt.tolerance, m.opt.iterations = 0, 300
    d, draw = mujoco.MjData(m), np.random.default_rng(1)
    d.qvel[:] = 0.5 * draw.standard_normal(m.nv)
    mujoco.mj_integratePos(m, d.qpos, 0.02 * draw.standard_normal(m.nv), 1.0)
    d.ctrl[:] = 1.0
    return m, d


def compare(m: mujoco.MjModel, d: mujoco.MjData, steps: int = 2) -> None:
    model, state, ctrl = rb.load(m), state_of(d), jnp.asarray(d.ctrl)
    step = jax.jit(lambda s: rb.step(model, s, ctrl, integrator="discrete"))
    for _ in range(steps):
        state = step(state)
        mujoco.mj_step(m, d)
        assert relative_error(state.v, d.qvel, floor=1.0) < F64_PARITY
        assert relative_error(state.q, d.qpos, floor=1.0) < F64_PARITY


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_step_without_contacts_equals_mujoco(robot: str) -> None:
    """Springs, dampers, tendons, actuators, forces at their limits and fluids. The last two robots
    float freely, so their gyroscopic forces are implicit if no joint is on them."""
    compare(*start(ROBOTS[robot], "DISCRETE"), steps=1)


@pytest.mark.parametrize(
    ("body", "cone", "ratio", "dim", "solref"),
    [
        (ARM, "pyramidal", 3, 4, ".001 1"),
        (ARM, "elliptic", 3, 4, ".0005 1.5"),
        (BALL, "pyramidal", 2, 6, ".02 1"),
        (BALL, "elliptic", 1, 3, ".002 .3"),
        (BALL, "elliptic", 1, 1, "-1e4 -10"),
        (TENDON, "elliptic", 1, 3, ".02 1"),
    ],
)
def test_a_step_with_contacts_equals_mujoco(
    body: str, cone: str, ratio: float, dim: int, solref: str
) -> None:
    """The scenes have limits, friction loss, tendon limits, a coupling and a weld, too. Time
    constants below the step are resolved for contacts and limits, and kept for equalities."""
    compare(*disturbed(floor(body, cone, ratio, dim, solref)))


def test_stiff_contact_that_the_step_does_not_resolve() -> None:
    """Without refsafe a time constant below the step removes the penetration in one step."""
    compare(*disturbed(floor(BALL, "elliptic", 1, 3, ".0005 .5", 'refsafe="disable"')))


@pytest.mark.parametrize("spring", STIFF)
@pytest.mark.parametrize("kind", ["slide", "ball"])
def test_polynomial_springs_equal_mujoco(kind: str, spring: str) -> None:
    """The stiffness is the derivative of the polynomial. A negative one is explicit."""
    joint = f'<joint type="{kind}" {STIFF[spring]}/>'
    text = f'<body>{joint}<geom size=".1" pos=".1 0 0"/></body>'
    compare(*start(f"<mujoco><worldbody>{text}</worldbody></mujoco>", "DISCRETE"))


def test_default_of_a_file() -> None:
    """`rollout` takes the integrator of the file for a model with contacts."""
    m, d = disturbed(floor(BALL, "pyramidal", 1, 3, ".02 1"))
    model = rb.load(m)
    assert model.solver.integrator == "discrete"
    found = rb.step(model, state_of(d))
    mujoco.mj_step(m, d)
    assert relative_error(found.v, d.qvel, floor=1.0) < F64_PARITY


def test_stiff_spring_is_stable() -> None:
    """v+ = (v - h k q / m) / (1 + h^2 k / m): a spring of any stiffness does not blow up."""
    joint = '<joint type="slide" axis="1 0 0" stiffness="1e8"/>'
    model = rb.load(
        f'<mujoco><worldbody><body>{joint}<geom size=".1" mass="2"/></body></worldbody></mujoco>'
    )
    state = State(jnp.full(1, 0.2), jnp.ones(1))
    found = rb.step(model, state, dt=0.01, integrator="discrete")
    ratio = 0.01 * 1e8 / 2
    np.testing.assert_allclose(found.v, (1 - ratio * 0.2) / (1 + 0.01 * ratio), rtol=F64_ROUNDING)


@pytest.mark.filterwarnings("ignore:.*biased at any step size")
def test_derivative_of_a_step() -> None:
    """Forward and reverse derivatives by state, control, stiffness and friction, against
    differences, with a contact, a limit and a stiff servo."""
    m, d = disturbed(floor(ARM, "elliptic", 3, 3, ".02 1"))
    model, state = rb.load(m), state_of(d)

    def f(dx: jax.Array, v: jax.Array, ctrl: jax.Array, scale: jax.Array) -> jax.Array:
        joints = model.joints.replace(stiffness=model.joints.stiffness * scale[0])
        geoms = model.geoms.replace(friction=model.geoms.friction * scale[1])
        changed = model.replace(joints=joints, geoms=geoms)
        return rb.step(changed, State(rb.integrate(model, state.q, dx), v), ctrl).v

    at = (jnp.zeros(model.nv), state.v, jnp.asarray(d.ctrl), jnp.ones(2))
    keys = jax.random.split(jax.random.key(1), len(at))
    to = tuple(jax.random.normal(k, x.shape) for k, x in zip(keys, at, strict=True))
    rate = jax.jit(lambda at, to: jax.jvp(f, at, to)[1])(at, to)
    run, h = jax.jit(f), 1e-7
    ends = [run(*(x + s * h * y for x, y in zip(at, to, strict=True))) for s in (1, -1)]
    assert relative_error(rate, (ends[0] - ends[1]) / (2 * h), floor=1.0) < 1e-6
    w = jax.random.normal(jax.random.key(2), (model.nv,))
    back = jax.jit(lambda at: jax.vjp(f, *at)[1](w))(at)
    both = sum(jnp.vdot(x, y) for x, y in zip(back, to, strict=True))
    assert relative_error(both, jnp.vdot(w, rate)) < 1e-10


def test_batch_and_single_precision() -> None:
    m, _ = disturbed(floor(BALL, "elliptic", 1, 3, ".02 1"))
    model = rb.load(m).astype(jnp.float32)
    state = model.default_state()
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (3, *x.shape)), state)
    path = rb.rollout(model, many, steps=2)
    assert path.v.dtype == jnp.float32
    assert path.v.shape == (3, 3, model.nv)
    single = rb.rollout(model, state, steps=2)
    np.testing.assert_allclose(path.v[1], single.v, atol=1e-5)


@pytest.mark.parametrize("given", [{"contact": "coulomb"}, {"contact": "impulse"}])
def test_not_with_other_laws(given: dict) -> None:
    model = rb.load(disturbed(floor(BALL, "elliptic", 1, 3, ".02 1"))[0])
    with pytest.raises(rb.InputError, match="discrete"):
        rb.step(model, model.default_state(), integrator="discrete", **given)


def test_not_with_rigid_constraints() -> None:
    model = rb.load("four_bar")
    with pytest.raises(rb.InputError, match="discrete"):
        rb.step(model, model.default_state(), integrator="discrete")


def test_couplings_of_a_stiffness_matrix() -> None:
    """(M + h D + h^2 K) a = tau - b - h K v, with a full K of a beam of a coupled section."""
    C = np.diag([3.0, 2.0, 1.0, 40.0, 0.0, 0.0])
    C[0, 1] = C[1, 0] = 1.4
    C[1, 3] = C[3, 1] = 5.0
    rod = rb.flexible.beam(
        0.6, C, {"k_x": 0, "k_y": 1, "e_x": 1}, mass=0.4, inertia=(4e-3, 2e-3, 2e-3), damping=0.05
    )
    model, h = rb.load("<mujoco/>").with_beam("rod", rod), 0.01
    q, v = 0.3 * jnp.arange(5.0), jnp.linspace(-1.0, 2.0, 5)

    def force(q, v):
        return rb.applied_forces(model, State(q, v))

    K, D = (-np.asarray(jax.jacfwd(force, i)(q, v)) for i in (0, 1))
    tau = force(q, v) - rb.inverse_dynamics(model, q, v, 0 * v)
    a = np.linalg.solve(rb.mass_matrix(model, q) + h * D + h * h * K, tau - h * K @ v)
    found = rb.step(model, State(q, v), dt=h, integrator="discrete")
    np.testing.assert_allclose(found.v, v + h * a, rtol=1e-12)
