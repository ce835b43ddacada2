"""`rb.contact.solve`: forces against MuJoCo C, its report, and its derivatives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.solver.newton import tolerance_of
from rbjax.model import State
from tests.contact.test_soft import BOX, PILE, compiled, resting
from tests.tolerances import F64_IDENTITY, F64_PARITY, GRADIENT, relative_error

pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model")


def after(m: mujoco.MjModel, steps: int) -> mujoco.MjData:
    """MuJoCo's data after a motion that begins with random velocities."""
    d = mujoco.MjData(m)
    d.qvel[:] = 0.5 * np.random.default_rng(0).standard_normal(m.nv)
    for _ in range(steps):
        mujoco.mj_step(m, d)
    mujoco.mj_forward(m, d)
    return d


def state_of(d: mujoco.MjData) -> State:
    return State(jnp.asarray(d.qpos), jnp.asarray(d.qvel))


def contacts_of(m: mujoco.MjModel, d: mujoco.MjData) -> np.ndarray:
    """Position, distance, frame, force and torque of MuJoCo's contacts, sorted by position."""
    rows = []
    for i, contact in enumerate(d.contact):
        f = np.zeros(6)
        mujoco.mj_contactForce(m, d, i, f)
        rows.append(np.concatenate([contact.pos, [contact.dist], contact.frame, f]))
    return in_order(np.array(rows))


def in_order(rows: np.ndarray) -> np.ndarray:
    return rows[np.lexsort(rows[:, :3].round(8).T)]


def solver(model: rb.Model, **law):
    """The compiled solver of a constant model."""
    contact = rb.contact.SoftContact(**law) if law else "mujoco"
    return jax.jit(rb.threads(lambda q, v: rb.contact.solve(model, State(q, v), contact=contact)))


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_forces_equal_mujoco(cone: str) -> None:
    """Contacts of bodies with each other and with the floor, limits and friction loss."""
    m = compiled(PILE, cone)
    d, run = after(m, 220), solver(rb.load(m, contacts=True))
    found = run(d.qpos, d.qvel)
    assert relative_error(found.acceleration, d.qacc, floor=1.0) < F64_PARITY
    assert relative_error(found.constraint, d.qfrc_constraint, floor=1.0) < F64_PARITY
    own, exists = found.contacts, np.asarray(found.contacts.exists)
    frame = own.frame.reshape(-1, 9)
    rows = jnp.concatenate([own.position, own.distance[:, None], frame, own.force], 1)[exists]
    assert relative_error(in_order(np.asarray(rows)), contacts_of(m, d), floor=1.0) < F64_PARITY
    for forces_of_kind, types in ((found.limit, (3, 4)), (found.friction, (1, 2))):
        rows = np.isin(d.efc_type, types)
        pushed, forces = np.zeros(m.nv), np.where(rows, d.efc_force, 0.0)
        mujoco.mj_mulJacTVec(m, d, pushed, forces)
        assert np.abs(pushed).max() > 0.1
        assert relative_error(forces_of_kind, pushed, floor=1.0) < F64_PARITY
    assert bool(found.success) and float(found.error) <= tolerance_of(jnp.float64)
    assert 1 <= int(found.iterations) <= 10


def test_derivatives_of_the_forces() -> None:
    model, state = resting()

    def f(dx, v, friction):
        changed = model.replace(geoms=model.geoms.replace(friction=model.geoms.friction * friction))
        found = rb.contact.solve(changed, State(rb.integrate(model, state.q, dx), v))
        own = found.contacts
        return found.acceleration, found.contact, own.force, own.position

    at = (jnp.zeros(model.nv), state.v, jnp.ones(3))
    keys = jax.random.split(jax.random.key(1), len(at))
    to = tuple(jax.random.normal(k, x.shape) for k, x in zip(keys, at, strict=True))
    f = jax.jit(f)
    values, rates = jax.jvp(f, at, to)
    h = 1e-6
    ends = [f(*(x + s * h * y for x, y in zip(at, to, strict=True))) for s in (1, -1)]
    for value, plain, rate, above, below in zip(values, f(*at), rates, *ends, strict=True):
        assert relative_error(value, plain, floor=1.0) < F64_PARITY
        assert relative_error(rate, (above - below) / (2 * h), floor=1.0) < 10 * GRADIENT
    w = [jax.random.normal(jax.random.key(k), x.shape) for k, x in enumerate(values)]
    back = jax.vjp(f, *at)[1](tuple(w))
    both = [sum(map(jnp.vdot, *pair)) for pair in ((back, to), (w, rates))]
    assert relative_error(*both) < F64_IDENTITY


def test_a_batch_and_a_step_that_does_not_converge() -> None:
    model, state = resting("pyramidal")
    one = solver(model)(state.q, state.v)
    many = jax.jit(jax.vmap(lambda v: rb.contact.solve(model, state.replace(v=v))))
    found = many(jnp.stack([state.v, 0 * state.v, -state.v]))
    assert found.iterations.shape == found.error.shape == found.success.shape == (3,)
    assert relative_error(found.contacts.force[0], one.contacts.force, floor=1.0) < F64_PARITY
    assert bool(found.success.all()) and int(one.iterations) > 1
    early = solver(model, iterations=1)(state.q, state.v)
    assert int(early.iterations) == 1
    assert not bool(early.success) and float(early.error) > 1e-6
    short = jax.tree.map(lambda x: x.astype(jnp.float32), state)
    single = solver(model.astype(jnp.float32))(short.q, short.v)
    assert single.acceleration.dtype == single.error.dtype == jnp.float32
    assert bool(single.success)
    assert relative_error(single.contact, one.contact, floor=1.0) < 2e-3


def test_nothing_touches() -> None:
    m = compiled(BOX, "elliptic")
    model = rb.load(m, contacts=True)
    state = model.default_state()
    state = state.replace(q=state.q.at[2].set(5.0))
    found = solver(model)(state.q, state.v)
    assert int(found.iterations) <= 1 and not bool(found.contacts.exists.any())
    assert np.isinf(found.contacts.distance).all() and not np.any(found.contacts.force)
    np.testing.assert_allclose(found.acceleration, [0, 0, -9.81, 0, 0, 0], atol=1e-12)
    alone = rb.load("pendulum", contacts=True)
    empty = rb.contact.solve(alone, alone.default_state(), tau=jnp.ones(1))
    assert empty.contacts.force.shape == (0, 6) and empty.rows.shape == (len(empty.sources),)
    expected = rb.acceleration(alone, alone.default_state(), tau=jnp.ones(1))
    np.testing.assert_allclose(empty.acceleration, expected)


def test_bad_laws() -> None:
    model, state = resting()
    with pytest.raises(rb.InputError, match=r"contact.solve: dt is -1.0, expected a positive step"):
        rb.contact.solve(model, state, contact="impulse", dt=-1.0)
    with pytest.raises(rb.InputError, match=r"contact.solve: contact is 'rigid', expected one of"):
        rb.contact.solve(model, state, contact="rigid")
    with pytest.raises(rb.InputError, match=r"needs the contact parameters of a file"):
        rb.contact.solve(model.replace(solver=None), state)
    with pytest.raises(rb.InputError, match=r"contact.solve: tau has shape"):
        rb.contact.solve(model, state, tau=jnp.zeros(2))


BLOCK = """<mujoco><option timestep=".002"/><worldbody><geom type="plane" size="0 0 1"/>
<body pos="0 0 .0999"><joint name="x" type="slide" axis="1 0 0" frictionloss="1"/>
<joint type="slide" axis="0 1 0" range="-1 0"/><joint type="slide" axis="0 0 1"/>
<geom type="box" size=".1 .1 .1" mass="2" friction=".5"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("law", ["mujoco", "coulomb", "impulse"])
def test_all_laws_balance_a_block(law: str) -> None:
    """A block that is pushed along x, held by friction and friction loss, and along y against a
    limit: all forces balance the acceleration, and friction takes its share."""
    model = rb.load(BLOCK)
    tau = jnp.array([4.0, 3.0, 0.0])
    state = rb.rollout(model, model.default_state(), None, steps=400, tau=tau, contact=law).state(
        -1
    )

    def solved(tau: jax.Array) -> rb.contact.ContactSolution:
        return rb.contact.solve(model, state, tau=tau, contact=law)

    found = jax.jit(solved)(tau)
    weight = jnp.array([0.0, 0.0, 2 * 9.81])
    np.testing.assert_allclose(2 * found.acceleration, tau - weight + found.constraint, atol=1e-9)
    np.testing.assert_allclose(found.acceleration, 0.0, atol=1e-2)
    assert bool(found.success)
    assert float(found.error) < 1e-5
    forces = found.contacts.world_force.sum(0)
    np.testing.assert_allclose(forces, found.contact, atol=1e-9)
    np.testing.assert_allclose(forces[2], 2 * 9.81, rtol=1e-3)
    np.testing.assert_allclose(found.limit[1] + forces[1], -3.0, rtol=1e-3)
    np.testing.assert_allclose(found.friction[0] + forces[0], -4.0, rtol=2e-2)
    assert -1.0 - 1e-9 <= float(found.friction[0]) <= 0
    assert float(found.force_of("friction loss", "dof", 0)) == float(found.friction[0])
    after = rb.step(model, state, tau=tau, contact=law, integrator="semi_implicit_euler")
    np.testing.assert_allclose(after.v - state.v, 0.002 * found.acceleration, atol=1e-12)
    rate = jax.jit(jax.jacfwd(lambda tau: solved(tau).contacts.force.sum(0)))(tau)
    back = jax.jit(jax.jacrev(lambda tau: solved(tau).contacts.force.sum(0)))(tau)
    np.testing.assert_allclose(rate, back, atol=1e-9)
    np.testing.assert_allclose(solved(tau).iterations, found.iterations)


@pytest.mark.parametrize("law", ["coulomb", "impulse"])
def test_damping_without_contact(law: str) -> None:
    """A damped slide in the air: `law` has explicit damping, as semi-implicit Euler, and MuJoCo's
    law has the implicit damping of the file's Euler, (m + h d) a = tau - d v."""
    model = rb.load("""<mujoco><worldbody><geom type="plane" size="0 0 1" pos="0 0 -3"/><body>
    <joint type="slide" axis="1 0 0" damping="2"/><geom size=".1" mass="3"/></body></worldbody>
    </mujoco>""")
    state, h = model.default_state().replace(v=jnp.array([1.0])), 0.01

    def speed(contact: str, integrator: str | None = None) -> float:
        after = rb.step(model, state, dt=h, contact=contact, integrator=integrator)
        return float(after.v[0])

    np.testing.assert_allclose(speed(law), 1 - h * 2 / 3, rtol=1e-14)
    np.testing.assert_allclose(speed("mujoco", "semi_implicit_euler"), speed(law), rtol=1e-14)
    np.testing.assert_allclose(speed("mujoco"), 1 - h * 2 / (3 + h * 2), rtol=1e-14)


def test_a_law_with_numbers_and_a_step() -> None:
    """A ball that bounces: the impulse over a step is m (1 + e) w, in the force p / h."""
    ball = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 .1">
    <joint type="slide" axis="0 0 1"/><geom size=".1" mass="2"/></body></worldbody></mujoco>"""
    model = rb.load(ball)
    law = rb.contact.MoreauContact.of(model, restitution=0.5)
    state = model.default_state().replace(v=jnp.array([-3.0]))
    found = rb.contact.solve(model, state, contact=law, dt=1e-3)
    force = 2 * (1.5 * 3.0 + 0.0) / 1e-3
    np.testing.assert_allclose(found.contact, [force], rtol=1e-12)
    np.testing.assert_allclose(found.contacts.force[0, :3], [force, 0, 0], rtol=1e-12)
    assert bool(found.contacts.exists[0])
