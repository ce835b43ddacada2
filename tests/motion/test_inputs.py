"""Forces as inputs of a motion, and a user's own laws and integrators."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces.inputs import Inputs
from rbjax.model import State
from tests.forces.elements import Lag, Wind
from tests.tolerances import F64_IDENTITY, relative_error

STEPS, DT = 3, 0.01
#: whether samples are threads; quick tests of other files run under XLA by default
KERNEL = [pytest.param(False, marks=pytest.mark.slow), True]


@functools.cache
def scene():
    model = rb.load("cart_pole")
    model = model.with_forces(Wind(jnp.array([3.0, 1.0, 0.0]), jnp.array(2.0)), Lag(jnp.array(0.1)))
    states = jax.vmap(model.random_state)(jax.random.split(jax.random.key(3), 2))
    rng = np.random.default_rng(1)
    shapes = [(model.nu,), (model.nv,), (model.nb, 6)]
    given = Inputs(*(jnp.asarray(rng.normal(size=(2, STEPS, *s))) for s in shapes))
    return model, states, given


def by_hand(model: rb.Model, state: State, given: Inputs, i: int) -> State:
    """The last of semi-implicit Euler's states of sample i, from the public algorithms."""
    for k in range(STEPS):
        u, tau, w = (x[i, k] for x in given)
        t = k * DT
        tau = tau + rb.applied_forces(model, state, u, t)
        a = rb.forward_dynamics(model, state.q, state.v, tau, w)
        lag = model.forces[-1]
        x = state.x + DT * (jnp.sin(t) - state.x) / lag.delay
        v = state.v + DT * a
        state = State(rb.integrate(model, state.q, DT * v), v, x)
    return state


@pytest.mark.parametrize("kernel", KERNEL)
def test_arrays_are_those_of_the_definition(kernel):
    model, states, given = scene()
    path = rb.rollout(
        model, states, given.ctrl, DT, tau=given.tau, wrenches=given.wrenches, kernel=kernel
    )
    for i in range(2):
        want = jax.jit(functools.partial(by_hand, i=i))(
            model, jax.tree.map(lambda x, i=i: x[i], states), given
        )
        found = jax.tree.map(lambda x, i=i: x[i], path.state(STEPS))
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
            assert relative_error(a, b) < F64_IDENTITY


@pytest.mark.parametrize("kernel", KERNEL)
@pytest.mark.parametrize("functions", [("ctrl",), ("tau", "wrenches")])
def test_functions_are_arrays_of_their_values(functions, kernel):
    """A function of only time gives the same as its values in an array, mixed with arrays."""
    model, states, given = scene()
    given = jax.tree.map(lambda x: x[0], given)

    def at(values):
        return lambda t, state: values[jnp.round(t / DT).astype(int)]

    mixed = Inputs(*(at(x) if name in functions else x for name, x in given._asdict().items()))
    run = functools.partial(rb.rollout, model, states, dt=DT, steps=STEPS, kernel=kernel)
    one = run(given.ctrl, tau=given.tau, wrenches=given.wrenches)
    other = run(mixed.ctrl, tau=mixed.tau, wrenches=mixed.wrenches)
    assert relative_error(other.q, one.q) < F64_IDENTITY
    assert relative_error(other.x, one.x) < F64_IDENTITY


def test_simulate_takes_them_too():
    """Functions of (t, state): a spring by wrenches, as one by tau."""
    model = rb.load("cart_pole")
    start = rb.State(jnp.array([0.3, 0.1]), jnp.zeros(2))
    ts = jnp.linspace(0.0, 0.5, 3)

    def pull(t, state):
        return jnp.zeros((2, 6)).at[0, 3].set(-4.0 * state.q[0])

    by_wrench = rb.simulate(model, start, ts, wrenches=pull)
    by_tau = rb.simulate(model, start, ts, tau=lambda t, s: jnp.array([-4.0, 0.0]) * s.q)
    np.testing.assert_allclose(by_wrench.q, by_tau.q, atol=1e-9)


@pytest.mark.slow
def test_simulate_holds_arrays():
    model = rb.load("cart_pole")
    start = rb.State(jnp.array([0.3, 0.1]), jnp.zeros(2))
    ts = jnp.linspace(0.0, 0.5, 3)
    held = rb.simulate(model, start, ts, tau=jnp.array([1.0, 0.0]))
    fine = rb.rollout(
        model,
        start,
        None,
        1e-3,
        steps=500,
        tau=lambda t, s: jnp.array([1.0, 0.0]),
        integrator="rk4",
    )
    np.testing.assert_allclose(held.q[-1], fine.q[-1], atol=1e-7)


@pytest.mark.parametrize("kernel", KERNEL)
def test_a_law_and_an_integrator_of_a_user(kernel):
    """A law that keeps the first coordinate constant; explicit Euler as a user's integrator."""
    model = rb.load("cart_pole")
    state = rb.State(jnp.array([[0.0, 0.5], [0.1, 1.0]]), jnp.zeros((2, 2)))

    def held(model, t, state, tau, f_ext):
        M = rb.mass_matrix(model, state.q)
        b = rb.bias_forces(model, state.q, state.v)
        return jnp.stack([jnp.zeros(()), (tau[1] - b[1]) / M[1, 1]])

    path = rb.rollout(model, state, None, DT, steps=20, dynamics=held, kernel=kernel)
    assert np.ptp(path.q[..., 0], axis=-1).max() == 0
    long = rb.simulate(
        model, rb.State(state.q[0], state.v[0]), jnp.linspace(0, 0.2, 3), dynamics=held
    )
    np.testing.assert_allclose(long.q[-1], path.q[0, -1], atol=2e-2)

    def explicit(field, t, state, inputs, dt):
        a, _ = field.rates(t, state, inputs)
        return State(field.retract(state.q, dt * state.v), state.v + dt * a)

    one = rb.rollout(model, state, None, DT, steps=1, integrator=explicit, kernel=kernel)
    np.testing.assert_array_equal(one.q[:, 1], state.q)


def test_bad_inputs():
    model = rb.load("cart_pole")
    start = model.default_state()
    with pytest.raises(rb.InputError, match=r"rollout: tau has shape \(5, 3\), expected \(5, 2\)"):
        rb.rollout(model, start, None, DT, tau=jnp.zeros((5, 3)))
    with pytest.raises(rb.InputError, match=r"wrenches returned has shape \(2,\), "):
        rb.rollout(model, start, None, DT, steps=2, wrenches=lambda t, s: jnp.zeros(2))
    with pytest.raises(rb.InputError, match=r"simulate: tau has shape \(3,\), expected \(2,\)"):
        rb.simulate(model, start, jnp.linspace(0, 1, 3), tau=jnp.zeros(3))


def test_what_a_law_returns_is_checked():
    """Wherever a law is called: for accelerations, and for the forces that give them."""
    model = rb.load("cart_pole")
    for integrator in ("semi_implicit_euler", "variational_midpoint"):
        with pytest.raises(rb.InputError, match=r"result of the dynamics has shape \(3,\), "):
            rb.step(
                model, model.default_state(), dt=DT, integrator=integrator,
                dynamics=lambda model, t, state, tau, f_ext: jnp.zeros(3),
            )  # fmt: skip


def test_one_form_of_inputs_for_every_motion():
    """Constants, functions and rows give the same motion in all functions."""
    model, state = rb.load("two_link"), rb.load("two_link").random_state(jax.random.key(0))
    tau, w = jnp.array([0.3, -0.2]), jnp.arange(6.0 * model.nb).reshape(model.nb, 6)
    given = {"tau": tau, "wrenches": w}
    functions = {"tau": lambda t, s: tau, "wrenches": lambda t, s: w}
    a = rb.acceleration(model, state, **given)
    bare = rb.applied_forces(model, state)
    want = rb.forward_dynamics(model, state.q, state.v, bare + tau, w)
    np.testing.assert_allclose(a, want, rtol=1e-10)
    np.testing.assert_allclose(rb.acceleration(model, state, **functions), a, rtol=1e-12)
    once = rb.step(model, state, dt=0.01, **given)
    rows = {name: jnp.stack([x] * 3) for name, x in given.items()}
    for inputs in (given, functions, rows):
        path = rb.rollout(model, state, None, 0.01, steps=3, **inputs)
        np.testing.assert_allclose(path.v[1], once.v, rtol=1e-12)
        found = rb.simulate(model, state, jnp.arange(4) * 0.01, **inputs)
        np.testing.assert_allclose(found.v[-1], path.v[-1], atol=0.1)
        ends = found.v[-1] if inputs is given else ends  # noqa: F821
        np.testing.assert_allclose(found.v[-1], ends, rtol=1e-9)


def test_rows_of_a_simulation_are_held_over_its_intervals():
    model = rb.load("two_link")
    state, ts = model.default_state(), jnp.array([0.0, 0.1, 0.25])
    tau = jnp.array([[1.0, 0.0], [0.0, -2.0]])
    path = rb.simulate(model, state, ts, tau=tau)
    middle = rb.simulate(model, state, ts[:2], tau=tau[0]).state(-1)
    end = rb.simulate(model, middle, ts[1:], tau=tau[1])
    np.testing.assert_allclose(path.q[-1], end.q[-1], atol=1e-6)
    with pytest.raises(rb.InputError, match=r"tau has shape \(3, 2\), expected \(2,\) or \(2, 2\)"):
        rb.simulate(model, state, ts, tau=jnp.zeros((3, 2)))


def test_a_policy_closes_the_loop_of_a_linearisation():
    model = rb.load("cart_pole")
    state, K = model.default_state(), jnp.array([[1.0, -2.0, 0.5, 0.3]])
    policy = lambda t, s: -K @ jnp.concatenate([s.q, s.v])  # noqa: E731
    for dt in (None, 0.01):
        A, B = rb.linearise(model, state, jnp.zeros(1), dt)
        closed, same = rb.linearise(model, state, policy, dt)
        np.testing.assert_allclose(closed, A - B @ K, atol=1e-9)
        np.testing.assert_allclose(same, B, atol=1e-12)
    push = jnp.zeros((model.nb, 6)).at[1, 3].set(2.0)
    by_hand = jax.jacfwd(lambda v: rb.acceleration(model, state.replace(v=v), wrenches=push))(
        state.v
    )
    A = rb.linearise(model, state, wrenches=push).A
    np.testing.assert_allclose(A[2:, 2:], by_hand, atol=1e-9)
