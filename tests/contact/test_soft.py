"""MuJoCo's contact law against MuJoCo C, and its derivatives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.soft import detected
from rbjax.contact.solver.newton import solve, tolerance_of
from rbjax.model import State
from tests.tolerances import F64_IDENTITY, F64_PARITY, GRADIENT, relative_error

pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model")

OPTION = '<option timestep=".002" cone="{cone}" impratio="{impratio}" tolerance="0"/>'
FLOOR = '<geom type="plane" size="0 0 1" friction=".8 .01 .002"/>'
BOX = """<body pos="0 0 .21" quat=".95 .1 .2 .1"><freejoint/>
  <geom type="box" size=".1 .15 .2" condim="{condim}"/></body>"""
#: a box on a box, a pendulum with friction loss and limits that touches the floor
PILE = (
    BOX
    + """<body pos="0 .05 .52"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
<body pos="0 .6 .25"><joint axis="1 0 0" frictionloss=".4" range="-10 5" limited="true"/>
  <geom type="sphere" size=".2"/>
  <body pos="0 0 .3"><joint type="ball" range="0 20" limited="true" solreflimit=".03 .8"/>
    <geom type="sphere" pos="0 0 .3" size=".1"/></body></body>"""
)


def compiled(bodies: str, cone: str, impratio: float = 1.0, condim: int = 3) -> mujoco.MjModel:
    text = OPTION.format(cone=cone, impratio=impratio) + "<worldbody>" + FLOOR
    bodies = bodies.replace("{condim}", str(condim))
    m = mujoco.MjModel.from_xml_string(f"<mujoco>{text}{bodies}</worldbody></mujoco>")
    m.opt.ls_tolerance, m.opt.iterations, m.opt.ls_iterations = 1e-10, 300, 100
    return m


def states_of(m: mujoco.MjModel, steps: int, every: int, kick: float = 0.5) -> list[tuple]:
    """States on a trajectory: q, v, the smooth applied forces, v', and the number of contacts."""
    d, out = mujoco.MjData(m), []
    if m.nkey:
        mujoco.mj_resetDataKeyframe(m, d, 0)
    d.qvel[:] = kick * np.random.default_rng(0).standard_normal(m.nv)
    for i in range(steps):
        mujoco.mj_step(m, d)
        if i % every == 0:
            mujoco.mj_forward(m, d)
            tau = d.qfrc_passive + d.qfrc_actuator
            out.append((d.qpos.copy(), d.qvel.copy(), tau, d.qacc.copy(), d.ncon))
    return out


def compare(m: mujoco.MjModel, steps: int = 300, every: int = 30, *, entries: bool = True) -> int:
    """Compare the accelerations along a trajectory. Return the largest number of contacts.

    entries: whether each entry is compared by its own size. Else all are by the largest one, for
        stiff equalities, whose forces leave rounding errors in other entries.
    """
    model = rb.load(m, contacts=True)

    def found(q, v, tau):
        problem = detected(model, q, v, tau, None)
        return solve(problem), sum(slots.found.length for slots in problem.slots)

    run, most = jax.jit(rb.threads(found)), 0
    for q, v, tau, a, contacts in states_of(m, steps, every):
        solution, count = run(q, v, tau)
        assert int(count) == contacts
        assert float(solution.error) <= 10 * tolerance_of(jnp.float64)
        scale = 1 + (np.abs(a) if entries else np.abs(a).max())
        np.testing.assert_allclose(solution.x / scale, a / scale, rtol=0, atol=F64_PARITY)
        most = max(most, contacts)
    return most


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_acceleration_equals_mujoco(cone: str) -> None:
    assert compare(compiled(BOX, cone, 7.5)) >= 2


@pytest.mark.parametrize("condim", [1, 4, 6])
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_rows_of_a_contact(cone: str, condim: int) -> None:
    m = compiled(BOX, cone, condim=condim)
    m.geom_condim[0] = 1
    assert compare(m) >= 2


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_stack_with_limits_and_friction_loss(cone: str) -> None:
    """Contacts between bodies, of several trees, with limits and friction loss in one problem."""
    assert compare(compiled(PILE, cone)) >= 4


def test_rollout_equals_mujoco() -> None:
    m = compiled(BOX, "elliptic")
    model, d = rb.load(m, contacts=True), mujoco.MjData(m)
    d.qvel[:] = 1.0
    state = State(jnp.asarray(d.qpos), jnp.asarray(d.qvel))
    for _ in range(150):
        mujoco.mj_step(m, d)
    path = rb.rollout(model, state, steps=150)
    np.testing.assert_allclose(path.q[-1], d.qpos, atol=1e-11)
    free = rb.rollout(model.replace(contact=None), state, steps=150)
    assert free.q[-1, 2] < path.q[-1, 2] - 0.1
    two = rb.rollout(model, State(jnp.stack([state.q] * 2), jnp.stack([state.v] * 2)), steps=5)
    np.testing.assert_allclose(two.q[1], path.q[:6], atol=1e-12)


def resting(cone: str = "elliptic") -> tuple[rb.Model, State]:
    """A box that slides on the floor."""
    m = compiled(BOX, cone)
    q, v, *_ = states_of(m, 220, 1)[-1]
    v[0] += 1.0
    return rb.load(m, contacts=True), State(jnp.asarray(q), jnp.asarray(v))


def test_gradient_is_implicit() -> None:
    model, state = resting()

    def f(dx, v, friction, mass, stiffness):
        geoms = model.geoms
        geoms = geoms.replace(friction=geoms.friction * friction, solref=geoms.solref * stiffness)
        bodies = model.bodies.replace(mass=model.bodies.mass * mass)
        changed = model.replace(geoms=geoms, bodies=bodies)
        return rb.acceleration(changed, State(rb.integrate(model, state.q, dx), v))

    at = (jnp.zeros(model.nv), state.v, jnp.ones(3), jnp.ones(1), jnp.array([1.0, 1.0]))
    keys = jax.random.split(jax.random.key(1), len(at))
    to = tuple(jax.random.normal(k, x.shape) for k, x in zip(keys, at, strict=True))
    rate = jax.jvp(f, at, to)[1]
    h = 1e-6
    ends = [f(*(x + s * h * y for x, y in zip(at, to, strict=True))) for s in (1, -1)]
    assert relative_error(rate, (ends[0] - ends[1]) / (2 * h), floor=1.0) < 10 * GRADIENT
    w = jax.random.normal(jax.random.key(2), (model.nv,))
    back = jax.vjp(f, *at)[1](w)
    both = sum(jnp.vdot(x, y) for x, y in zip(back, to, strict=True))
    assert relative_error(both, jnp.vdot(w, rate)) < F64_IDENTITY


def test_derivative_by_forces_is_symmetric() -> None:
    """da/dtau is the inverse of the Hessian."""
    model, state = resting()

    def f(tau):
        return rb.acceleration(model, state, tau=tau)

    J = jax.jacfwd(f)(jnp.zeros(model.nv))
    assert relative_error(J, J.T, floor=1.0) < F64_IDENTITY


def test_f32_converges() -> None:
    m = compiled(PILE, "elliptic")
    model = rb.load(m, contacts=True)
    q, v, *_ = states_of(m, 200, 1)[-1]
    exact = rb.acceleration(model, State(jnp.asarray(q), jnp.asarray(v)))
    single = State(jnp.asarray(q, jnp.float32), jnp.asarray(v, jnp.float32))
    found = rb.acceleration(model.astype(jnp.float32), single)
    assert found.dtype == jnp.float32
    assert relative_error(found, exact, floor=1.0) < 2e-3


def test_bad_laws_are_named() -> None:
    model, state = resting()
    with pytest.raises(rb.InputError, match="contact is 'rigid', expected one of"):
        rb.step(model, state, contact="rigid")
    with pytest.raises(rb.InputError, match="got dynamics and contact"):
        rb.step(model, state, contact="mujoco", dynamics=lambda model, t, state, tau, f_ext: tau)
    with pytest.raises(rb.InputError, match="needs the contact parameters of a file"):
        rb.step(model.replace(solver=None), state, contact="mujoco")


def test_touch_and_force_sensors_read_the_law() -> None:
    """Sensors of a box that slides equal MuJoCo's."""
    text = BOX.replace("{condim}", "3").replace(
        "</body>", '<site name="pad" type="box" size=".3 .3 .3"/></body>'
    )
    world = OPTION.format(cone="elliptic", impratio=1) + f"<worldbody>{FLOOR}{text}</worldbody>"
    sensor = '<sensor><touch site="pad"/><accelerometer site="pad"/></sensor>'
    m = mujoco.MjModel.from_xml_string(f"<mujoco>{world}{sensor}</mujoco>")
    m.opt.ls_tolerance, m.opt.iterations = 1e-10, 300
    d = mujoco.MjData(m)
    for _ in range(250):
        mujoco.mj_step(m, d)
    mujoco.mj_forward(m, d)
    model = rb.load(m, contacts=True)
    state = State(jnp.asarray(d.qpos), jnp.asarray(d.qvel))
    assert d.sensordata[0] > 1.0
    assert relative_error(rb.sense(model, state), d.sensordata) < F64_PARITY


def test_laws_are_chosen_by_name() -> None:
    m = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='plane' size='0 0 1'/><body pos='0 0 .1'><freejoint/>"
        "<geom type='sphere' size='.1'/></body></worldbody></mujoco>"
    )
    model = rb.load(m, contacts=True)
    state = model.default_state().replace(v=jnp.zeros(6).at[2].set(-1.0))
    for law in rb.contact.laws():
        path = rb.rollout(model, state, steps=100, dt=0.002, contact=law)
        assert bool(path.success) and abs(float(path.q[-1, 2]) - 0.1) < 0.01
    assert rb.step(model, state, contact="impulse").q[2] > 0.0999
