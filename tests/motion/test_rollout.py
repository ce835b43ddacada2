"""Rollouts: against MuJoCo C's own steps, order, batches, memory and derivatives."""

import warnings

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.algorithms.manifold import rate_lanes
from rbjax.loading import compile_model
from rbjax.rotations import so3
from tests.compilations import compilations
from tests.tolerances import F64_IDENTITY, F64_PARITY, F64_TRANSFORM, GRADIENT, relative_error

STEPS, DT = 60, 0.002


def spread(model, count, key):
    """A batch of random states."""
    return jax.jit(jax.vmap(model.random_state))(jax.random.split(key, count))


SLOW_DOPRI8 = pytest.param("dopri8", marks=pytest.mark.slow)


@pytest.mark.parametrize("scene", ["cart_pole", "arm7", "quadrotor"])
def test_semi_implicit_euler_is_mujoco_s(scene, key):
    model, m = rb.load(scene), compile_model(scene)
    m.opt.timestep, m.opt.integrator = DT, int(mujoco.mjtIntegrator.mjINT_EULER)
    m.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    )
    state = model.random_state(key)
    ctrls = 0.3 * np.asarray(jax.random.normal(key, (STEPS, model.nu)))
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = state.q, state.v
    for ctrl in ctrls:
        d.ctrl[:] = ctrl
        mujoco.mj_step(m, d)
    out = rb.rollout(model, state, ctrls, DT)
    assert bool(out.success)
    assert relative_error(out.q[-1], d.qpos) < F64_PARITY
    assert relative_error(out.v[-1], d.qvel) < F64_PARITY


@pytest.mark.parametrize(
    ("integrator", "order", "steps"),
    [
        ("semi_implicit_euler", 1, 256),
        ("variational_midpoint", 2, 256),
        ("rk4", 4, 128),
        ("tsit5", 5, 128),
        ("dopri8", 8, 32),
        ("dop853", 8, 32),
    ],
)
def test_order_with_free_attitudes(integrator, order, steps):
    """Halving the step divides the error by 2^order, on the manifold too."""
    model = rb.load("spinning_top").replace(driver="rolled")
    start = model.random_state(jax.random.key(0))

    def ends(integrator, *counts):
        @jax.jit
        def some(state, dt):
            path = rb.rollout(model, state, None, dt, integrator=integrator, steps=8, save_every=8)
            return path.state(-1)

        for n in counts:
            state = start
            for _ in range(n // 8):
                state = some(state, 2.0 / n)
            yield np.concatenate([state.q, state.v])

    (exact,) = ends("dopri8", 512)
    coarse, fine = (np.abs(x - exact).max() for x in ends(integrator, steps, 2 * steps))
    assert abs(np.log2(coarse / fine) - order) < 0.45


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "solver"),
    [("tsit5", "Tsit5"), pytest.param("dopri8", "Dopri8", marks=pytest.mark.slow)],
)
def test_tableaus_are_diffrax_s_without_attitudes(integrator, solver, key):
    """On hinges the manifold is flat, and a step is that of the same tableau in `simulate`."""
    model = rb.load("double_pendulum")
    state, steps, dt = model.random_state(key), 5, 0.02
    here = rb.rollout(model, state, None, dt, integrator=integrator, steps=steps)
    ts = jnp.array([0.0, steps * dt])
    there = rb.simulate(model, state, ts, solver=getattr(diffrax, solver)(), dt=dt * (1 + 1e-13))
    assert relative_error(here.q[-1], there.q[-1]) < F64_IDENTITY
    assert relative_error(here.v[-1], there.v[-1]) < F64_IDENTITY


def test_batch_is_a_loop_and_padding_is_unseen(key):
    model = rb.load("cart_pole")
    states = spread(model, 200, key)  # more than one chunk, and no multiple of it
    ctrls = jax.random.normal(key, (200, 12, 1))
    batch = rb.rollout(model, states, ctrls, 0.01)
    assert batch.q.shape == (200, 13, 2)
    assert batch.success.shape == (200,)
    for i in (0, 127, 128, 199):
        one = rb.rollout(model, jax.tree.map(lambda x, i=i: x[i], states), ctrls[i], 0.01)
        np.testing.assert_allclose(batch.q[i], one.q, rtol=0, atol=1e-13)
    shared = rb.rollout(model, states, ctrls[3], 0.01)
    np.testing.assert_allclose(shared.q[3], batch.q[3], rtol=0, atol=1e-13)


def test_a_policy_sees_each_state(key):
    model = rb.load("cart_pole")
    state = model.random_state(key)
    policy = lambda t, s: -2.0 * s.v[:1] + t  # noqa: E731
    out = rb.rollout(model, state, policy, 0.01, steps=10)
    ctrls = jax.vmap(policy)(out.ts[:-1], rb.State(out.q[:-1], out.v[:-1]))
    again = rb.rollout(model, state, ctrls, 0.01)
    np.testing.assert_allclose(out.q, again.q, rtol=0, atol=1e-14)


def test_save_every_keeps_a_subset(key):
    model = rb.load("pendulum")
    state = model.random_state(key)
    every = rb.rollout(model, state, None, 0.01, steps=12)
    some = rb.rollout(model, state, None, 0.01, steps=12, save_every=4)
    np.testing.assert_allclose(some.q, every.q[::4], rtol=0, atol=1e-15)
    np.testing.assert_allclose(some.ts, every.ts[::4])
    assert some.state(-1).q.shape == (1,)


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4", SLOW_DOPRI8])
def test_reverse_gradient_is_the_difference_quotient(integrator, key):
    """With respect to controls, state and a leaf of the model at once."""
    model = rb.load("cart_pole")
    state = model.random_state(key)
    ctrls = jax.random.normal(key, (20, 1))

    @jax.jit
    def loss(ctrls, q, v, mass):
        changed = model.replace(bodies=model.bodies.replace(mass=mass))
        out = rb.rollout(changed, rb.State(q, v), ctrls, 0.01, integrator=integrator, save_every=4)
        return (out.q**2).sum() + jnp.sin(out.v).sum()

    at = (ctrls, state.q, state.v, model.bodies.mass)
    gradient = jax.jit(jax.grad(loss, (0, 1, 2, 3)))(*at)
    keys = jax.random.split(key, 4)
    step = tuple(jax.random.normal(k, x.shape) for k, x in zip(keys, at, strict=True))
    h = 1e-5
    ahead, behind = (loss(*(x + s * h * d for x, d in zip(at, step, strict=True))) for s in (1, -1))
    along = sum((g * d).sum() for g, d in zip(gradient, step, strict=True))
    assert relative_error(along, (ahead - behind) / (2 * h)) < GRADIENT


def test_memory_of_the_gradient_follows_the_law(key):
    """Kept states: steps / save_every + save_every, not steps."""
    model = rb.load("double_pendulum")
    state = model.random_state(key)

    def peak(steps, save_every):
        def loss(q):
            out = rb.rollout(
                model, rb.State(q, state.v), None, 1e-3, steps=steps, save_every=save_every,
                kernel=False,
            )  # fmt: skip
            return (out.q[-1] ** 2).sum()

        compiled = jax.jit(jax.grad(loss)).lower(state.q).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    base = peak(64, 8)
    assert peak(6400, 80) < 20 * base  # a hundred times the steps, ten times the kept states
    assert peak(6400, 80) < peak(6400, 1) / 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"integrator": "euler"},
            "expected one of .'semi_implicit_euler', 'variational_midpoint', .*'rk4'",
        ),
        ({"save_every": 7}, "expected a divisor of the 10 steps"),
        ({"ctrl": np.zeros((10, 3))}, "ctrl has shape .10, 3., expected .10, 1."),
        ({"ctrl": np.full((10, 1), np.nan)}, r"ctrl\[0, 0\] is nan, expected finite"),
        ({"ctrl": np.zeros((10, 1), complex)}, "ctrl has dtype complex128, expected float"),
        ({"ctrl": np.zeros((0, 1))}, r"shape \(0, 1\), expected \(1, 1\) or .*: a row .* policy"),
        ({"ctrl": "none"}, "ctrl is str, expected an array"),
        ({"ctrl": None}, "steps is None"),
        ({"ctrl": None, "steps": -3}, "steps is -3, expected an integer of at least 1"),
        ({"ctrl": None, "steps": 0}, "steps is 0, expected an integer of at least 1"),
        ({"ctrl": None, "steps": 2.0}, "steps is 2.0, expected an integer of at least 1"),
        ({"save_every": 2.5}, "save_every is 2.5, expected an integer .* divisor of the 10"),
        ({"save_every": 0}, "save_every is 0, expected an integer of at least 1"),
        ({"state": rb.State(jnp.zeros(3), jnp.zeros(2))}, "q has shape .3,., expected .2,."),
        ({"state": rb.State(None, jnp.zeros(2))}, "q is NoneType, expected an array"),
        ({"state": rb.State(jnp.zeros(2, complex), jnp.zeros(2))}, "q has dtype complex128"),
        ({"state": rb.State(jnp.zeros((3, 2), complex), jnp.zeros((3, 2)))}, "q has dtype complex"),
        ({"state": rb.State(jnp.zeros((0, 2)), jnp.zeros((0, 2)))}, "a batch of no states"),
        ({"state": rb.State(jnp.zeros((3, 2)), jnp.zeros((4, 2)))}, "v has shape .4, 2., ex"),
        ({"state": np.zeros(4)}, "expected rbjax.State"),
        ({"dt": 0.0}, "dt is 0.0, expected a positive step"),
        ({"dt": -0.1}, "dt is -0.1, expected a positive step"),
        ({"dt": np.nan}, "dt is nan, expected finite"),
        ({"dt": np.ones(10)}, r"dt has shape \(10,\), expected \(\): a positive step"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    model = rb.load("cart_pole")
    given = {"state": model.default_state(), "ctrl": np.zeros((10, 1)), "dt": 0.01, **arguments}
    with pytest.raises(rb.InputError, match=message):
        rb.rollout(model, given.pop("state"), given.pop("ctrl"), **given)


@pytest.mark.parametrize("batch", [(), (3,)], ids=["one", "batch"])
@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (jnp.ones(2), r"has shape \(2,\), expected \(1,\): one number for each"),
        (1.0, r"has shape \(\), expected \(1,\)"),
        (None, r"is NoneType, expected an array of shape \(1,\)"),
        (jnp.ones(1, complex), "has dtype complex128"),
    ],
)
def test_a_policy_that_returns_no_control_is_told(returned, message, batch):
    model = rb.load("cart_pole")
    state = rb.State(jnp.zeros((*batch, 2)), jnp.zeros((*batch, 2)))
    with pytest.raises(rb.InputError, match=f"the control returned {message}"):
        rb.rollout(model, state, lambda t, s: returned, 0.01, steps=2)


def test_a_policy_has_nothing_to_say_to_a_robot_without_actuators():
    top = rb.load("spinning_top")
    with pytest.raises(rb.InputError, match=r"has shape \(3,\), expected \(0,\)"):
        rb.rollout(top, top.default_state(), lambda t, s: jnp.ones(3), 0.01, steps=2)


class Gain(eqx.Module):
    k: jax.Array

    def __call__(self, t, state):
        return self.k @ state.v


def test_a_policy_may_be_a_module(key):
    """Its arrays are arguments: differentiable, and others compile nothing again."""
    model = rb.load("cart_pole")
    state, k = model.random_state(key), jnp.array([[-2.0, 0.5]])

    def end(k):
        return rb.rollout(model, state, Gain(k), 0.01, steps=6).q[-1]

    here = end(k)
    closed = rb.rollout(model, state, lambda t, s: k @ s.v, 0.01, steps=6)
    np.testing.assert_allclose(here, closed.q[-1], rtol=0, atol=1e-14)
    other = 1.1 * k
    with compilations() as compiled:
        end(other)
    assert not compiled
    h = 1e-5
    slope = jax.grad(lambda k: end(k).sum())(k)
    along = (end(k + h).sum() - end(k - h).sum()) / (2 * h)
    assert relative_error(slope.sum(), along) < GRADIENT


def test_a_model_that_cannot_move_is_told():
    text = "<mujoco><worldbody><body><inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/></body>"
    still = rb.load(f"{text}</worldbody></mujoco>")
    with pytest.raises(rb.InputError, match=r"no joints, so nothing moves; give .* <joint/>"):
        rb.rollout(still, still.default_state(), None, 0.01, steps=2)


def test_an_empty_x_is_none():
    """x (0,) says what None does of a model without element states."""
    model = rb.load("pendulum")
    plain = model.default_state().replace(q=jnp.array([0.3]))
    empty = plain.replace(x=jnp.zeros(0))
    a, b = (rb.rollout(model, s, None, 0.01, steps=3) for s in (plain, empty))
    assert b.x is None
    np.testing.assert_array_equal(a.q, b.q)
    ts = jnp.array([0.0, 0.1])
    a, b = (rb.simulate(model, s, ts) for s in (plain, empty))
    assert b.x is None
    np.testing.assert_array_equal(a.q, b.q)


def test_a_motion_that_blows_up_is_a_value():
    model = rb.load("cart_pole")
    state = rb.State(jnp.ones(2), 1e200 * jnp.ones(2))
    with pytest.warns(UserWarning, match="the motion has values that are not finite"):
        out = rb.rollout(model, state, None, 1.0, steps=5)
    assert not bool(out.success)


@pytest.mark.slow
def test_a_derivative_of_a_motion_that_blows_up_warns():
    model = rb.load("cart_pole")
    state = rb.State(jnp.ones(2), 1e200 * jnp.ones(2))

    def end(v, dt):
        return rb.rollout(model, state.replace(v=v), None, dt, steps=5).q[-1].sum()

    with pytest.warns(UserWarning, match="the motion has values that are not finite"):
        jax.grad(end, argnums=(0, 1))(state.v, 1.0)


def test_the_rate_of_an_increment_is_the_inverse_right_jacobian():
    top = rb.load("free_body").topology
    u, v = (0.3 * np.sin(np.arange(k, k + 6.0)) for k in (1, 2))
    expected = so3.inverse_right_jacobian(u[3:]) @ v[3:]
    found = np.array(rate_lanes(top, list(jnp.asarray(u)), list(jnp.asarray(v))))
    np.testing.assert_allclose(found[:3], v[:3])
    assert relative_error(found[3:], expected) < F64_TRANSFORM


@pytest.mark.parametrize("steps", [4, 6])
@pytest.mark.parametrize("method", ["rk4", "tsit5"])
def test_turns_of_a_radian_and_more_a_step_are_those_of_the_method_itself(method, steps):
    """A free body at 22.9 rad/s, 3.8 and 5.7 rad a step: the method on Euler's equations, by numpy.

    Beyond its stability the motion of an explicit method grows until it is not finite; before that
    nothing of the rotation's own coordinates adds to it.
    """
    tables = {"tsit5": diffrax.Tsit5.tableau}
    A = [[], [0.5], [0.0, 0.5], [0.0, 0.0, 1.0]]
    b = [1 / 6, 1 / 3, 1 / 3, 1 / 6]
    if method in tables:
        A = [[], *(row.tolist() for row in tables[method].a_lower)]
        b = tables[method].b_sol.tolist()
    model, h = rb.load("free_body"), 1.0 / steps
    inertia = np.asarray(rb.mass_matrix(model, model.default_state().q))[3:, 3:]
    w = np.array([10.0, 20.0, -5.0])
    due = [w]
    for _ in range(steps):
        k: list[np.ndarray] = []
        for row in A:
            x = w + h * sum((a * y for a, y in zip(row, k, strict=False)), np.zeros(3))
            k.append(np.linalg.solve(inertia, -np.cross(x, inertia @ x)))
        w = w + h * sum(c * y for c, y in zip(b, k, strict=False))
        if np.abs(w).max() > 1e6:
            break
        due.append(w)
    start = model.default_state().replace(v=jnp.array([0.0, 0, 0, 10.0, 20.0, -5.0]))
    with warnings.catch_warnings(action="ignore"):  # where the motion grows beyond all numbers
        path = rb.rollout(model, start, None, h, steps=steps, integrator=method)
    np.testing.assert_allclose(path.v[: len(due), 3:], due, rtol=1e-6)
    assert np.isfinite(path.q[: len(due)]).all()
    assert bool(path.success) == (len(due) == steps + 1)


@pytest.mark.parametrize("given", ["another tree", "a Python number"])
def test_an_integrator_that_returns_no_state(given):
    model = rb.load("pendulum")

    def wrong(field, t, state, u, dt):
        return (state.q, state.v) if given == "another tree" else rb.State(1.0, state.v)

    with pytest.raises(rb.InputError, match=r"returned .* expected a State of \[\(1,\), \(1,\)\]"):
        rb.step(model, model.default_state(), None, 0.1, integrator=wrong)
