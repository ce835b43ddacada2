"""Coulomb's law with bristles, against closed forms of sliding and sticking."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.model import State
from tests.contact.closed_forms import PLANAR, ROLLING, Body, G, Touch, load, load_text, mover
from tests.tolerances import F64_IDENTITY, GRADIENT, relative_error

CUBE = 'type="box" size="0.05 0.05 0.05" mass="1"'
#: impedance of a floor that a body of 1 kg presses in by 1e-7 m
HARD = "0.9999 0.9999 0.001 0.5 2"


def test_a_cube_at_speed_does_not_lift_and_stops_alike_in_all_directions():
    """s = v^2 / (2 mu g) to 1e-6 with v half a step earlier, as semi-implicit Euler places it."""
    model, mu, dt = load([Body(Touch(0.5, solimp=HARD), "<freejoint/>", CUBE, 0.05)]), 0.5, 1e-3

    @jax.jit
    def run(v):
        state = model.default_state().replace(v=v)
        path = rb.rollout(model, state, None, dt, steps=1400, contact="coulomb")
        return path.q[:, :3], path.v[-1], path.memory[1:, -1].max()

    for angle in np.deg2rad([0.0, 30.0, 45.0]):
        along = np.array([np.cos(angle), np.sin(angle)])
        q, v, error = run(jnp.zeros(6).at[:2].set((6.0 + mu * G * dt / 2) * along))
        assert error < 1e-10
        assert q[:, 2].max() - 0.05 < 1e-4
        np.testing.assert_allclose(q[-1, :2], along * 36 / (2 * mu * G), atol=1e-6)
        np.testing.assert_allclose(v, 0.0, atol=1e-7)


def test_ramps():
    """No creep below the cone; slip above it; a ball that rolls."""
    slope, mu, time = np.deg2rad(20), 0.3, 1.0
    bodies = [
        Body(Touch(0.5), ROLLING, CUBE, 0.05, slope),
        Body(Touch(mu, solimp=HARD), slope=slope),
        Body(Touch(0.5, solimp=HARD), ROLLING, slope=slope),
    ]
    model = load(bodies)
    run = mover(model, contact="coulomb")
    down = [G * (np.sin(slope) - mu * np.cos(slope)), 5 / 7 * G * np.sin(slope)]
    for dt in (2e-3, 1e-3):
        state = run(np.zeros(model.nv), dt, time)
        v = np.asarray(state.v)
        assert np.abs(v[:3]).max() < 1e-9 and abs(state.q[0]) < 2e-3
        np.testing.assert_allclose(v[[3, 5]], np.array(down) * time, rtol=1e-3)
        np.testing.assert_allclose(v[5], 0.1 * v[7], atol=1e-5)


def test_a_block_on_a_plank():
    """Friction between two bodies: the momentum is kept, and the slip ends at a distance."""
    m, M, mu, v0 = 1.0, 2.0, 0.4, 3.0
    off = 'contype="0" conaffinity="0"'
    model = load_text(
        '<body><joint type="slide" axis="1 0 0"/>'
        f'<geom name="plank" type="box" size="9 1 .1" mass="{M}" {off}/></body>'
        f'<body pos="0 0 .2">{PLANAR}<geom name="block" size=".1" mass="{m}" {off}/></body>',
        f'<pair geom1="plank" geom2="block" friction="{mu} {mu}" solimp="{HARD}"/>',
    )
    earlier = mu * G * 1e-3 / 2 * np.array([-m / M, 1.0, 0.0])
    state = mover(model, contact="coulomb")(np.array([0, v0, 0.0]) + earlier, 1e-3, 1.5)
    np.testing.assert_allclose(state.v, [v0 / 3, v0 / 3, 0], atol=1e-6)
    slip = v0**2 / (2 * mu * G * (1 + m / M))
    np.testing.assert_allclose(state.q[1] - state.q[0], slip, atol=2e-6)


def sliding_and_sticking() -> tuple[rb.Model, State]:
    """A ball that slides and turns, and a point that sticks on a slope."""
    model = load([Body(Touch(0.3), ROLLING), Body(Touch(0.8), slope=0.3)])
    start = np.array([2.0, 0.1, 3.0, 0.0, 0.0])
    return model, mover(model, contact="coulomb")(start, 2e-3, 0.05)


@pytest.mark.filterwarnings("ignore:.*biased at any step size")
def test_the_derivative_is_implicit():
    model, state = sliding_and_sticking()

    def f(dq, dv, friction, tau):
        geoms = model.geoms.replace(pair_friction=model.geoms.pair_friction * friction)
        at = state.replace(q=state.q + dq, v=state.v + dv)
        after = rb.step(model.replace(geoms=geoms), at, tau=tau, dt=2e-3, contact="coulomb")
        return jnp.concatenate([after.q, after.v, after.memory[:-1]])

    zero = jnp.zeros(model.nv)
    at = (zero, zero, jnp.ones(()), zero)
    keys = jax.random.split(jax.random.key(1), len(at))
    to = tuple(jax.random.normal(k, x.shape) for k, x in zip(keys, at, strict=True))
    rate = jax.jit(lambda to: jax.jvp(f, at, to)[1])(to)
    h, g = 1e-6, jax.jit(f)
    ends = [g(*(x + s * h * y for x, y in zip(at, to, strict=True))) for s in (1, -1)]
    assert relative_error(rate, (ends[0] - ends[1]) / (2 * h), floor=1.0) < 10 * GRADIENT
    w = jax.random.normal(jax.random.key(2), rate.shape)
    back = jax.jit(lambda w: jax.vjp(f, *at)[1](w))(w)
    both = sum(jnp.vdot(x, y) for x, y in zip(back, to, strict=True))
    assert relative_error(both, jnp.vdot(w, rate)) < F64_IDENTITY


#: a rod at 45 degrees whose tip touches the floor
ROD = """<mujoco><worldbody>
<geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="0"/><body pos="0 0 1">
<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
<inertial pos="0 0 0" mass="1" diaginertia=".1 .6667 .6667"/>
<geom name="tip" size=".01" pos="1 0 -.9901" mass="0" contype="0" conaffinity="0"/></body>
</worldbody>
<contact><pair geom1="floor" geom2="tip" friction="{mu} {mu}"/></contact></mujoco>"""


@pytest.mark.parametrize(("speed", "mu"), [(-3.0, 1.5), (3.0, 1.5), (-3.0, 3.0)])
def test_a_rod_whose_friction_changes_its_normal_force_much(speed, mu):
    """The normal force changes by -0.9, 0.9 and -1.8 of its change from one plain round to the
    next. It and its derivative converge nevertheless."""
    model = rb.load(ROD.format(mu=mu))
    state = model.default_state()

    @jax.jit
    def solved(v, tau):
        return rb.contact.solve(model, state.replace(v=v), tau=tau, contact="coulomb", dt=1e-3)

    v, tau = jnp.array([speed, -0.1, 0.0]), jnp.array([0.1, 0.2, 0.3])
    found = solved(v, tau)
    n, *t = np.asarray(found.contacts.force[0, :3])
    assert bool(found.success) and n > 0.1 and int(found.iterations) <= 5
    np.testing.assert_allclose(np.hypot(*t), mu * n, rtol=1e-9)
    rates = jax.jit(jax.jacrev(lambda *x: solved(*x).acceleration, (0, 1)))(v, tau)
    h = 1e-6 * jnp.eye(3)
    for k, rate in enumerate(rates):
        moved = jax.vmap(lambda d, k=k: solved(*(x + (j == k) * d for j, x in enumerate((v, tau)))))
        change = (moved(h).acceleration - moved(-h).acceleration) / 2e-6
        assert relative_error(rate, change.T, floor=1.0) < 10 * GRADIENT


def test_single_precision_and_batches():
    model, state = sliding_and_sticking()
    path = rb.rollout(model, state, None, 2e-3, steps=20, contact="coulomb")
    low = jax.tree.map(lambda x: jnp.stack([x] * 3).astype(jnp.float32), state)
    few = rb.rollout(model.astype(jnp.float32), low, None, 2e-3, steps=20, contact="coulomb")
    assert few.q.dtype == jnp.float32 and few.q.shape[0] == 3
    np.testing.assert_allclose(few.q[1], path.q, atol=1e-4)


def test_bad_arguments():
    for options in ({"share": 2.0}, {"stiffness": 1.0}, {"rounds": 0}, {"iterations": 0}):
        with pytest.raises(rb.InputError, match=next(iter(options))):
            rb.contact.CoulombContact(**options)
    model = load([Body(Touch())])
    with pytest.raises(rb.InputError, match="contact='coulomb' needs the contact parameters"):
        rb.step(model.replace(solver=None), model.default_state(), contact="coulomb")
    with pytest.raises(rb.InputError, match="no step is fixed"):
        rb.acceleration(model, model.default_state(), contact="coulomb")
