"""Motions with contact: steps, policies, forces, derivatives and integrators, against MuJoCo C."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.model import State
from tests.compiler.test_saved import count
from tests.tolerances import F64_PARITY, relative_error

pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model")

#: a leg with a damped, driven and limited knee, which lands and slides
HOPPER = """<mujoco><option timestep=".002" integrator="{integrator}" cone="{cone}"/><worldbody>
<geom type="plane" size="0 0 1"/><body pos="0 0 .6">
<joint type="slide" axis="0 0 1" damping=".1"/><joint type="slide" axis="1 0 0"/>
<geom size=".1" mass="3" contype="0" conaffinity="0"/>
<body><joint axis="0 1 0" damping=".5" range="-40 40" name="knee"/>
<geom type="capsule" fromto="0 0 0 0.1 0 -.5" size=".04"/></body></body></worldbody>
<actuator><position joint="knee" kp="20" kv="2"/></actuator></mujoco>"""
Q, V = np.array([-0.1, 0.0, 0.2]), np.array([-1.0, 0.5, 0.3])
STEPS = 100


def hopper(integrator: str = "implicitfast", cone: str = "elliptic") -> mujoco.MjModel:
    m = mujoco.MjModel.from_xml_string(HOPPER.format(integrator=integrator, cone=cone))
    m.opt.tolerance, m.opt.iterations = 0, 300
    return m


def stepped(m: mujoco.MjModel, ctrl: Any, steps: int, v: Any = V, dt: float = 0.002, **given: Any):
    """The states of MuJoCo after each step, (steps, 6)."""
    m.opt.timestep = dt
    d, out, contacts = mujoco.MjData(m), [], 0
    d.qpos[:], d.qvel[:] = Q, v
    for name, x in given.items():
        getattr(d, name)[:] = x
    for _ in range(steps):
        d.ctrl[:] = ctrl(d.qpos) if callable(ctrl) else ctrl
        mujoco.mj_step(m, d)
        out.append([*d.qpos, *d.qvel])
        contacts += d.ncon
    assert contacts > 10
    return np.array(out)


def flat(path: rb.Trajectory) -> np.ndarray:
    return np.concatenate([path.q, path.v], -1)[..., 1:, :]


def agree(path: rb.Trajectory, want: np.ndarray, tolerance: float = F64_PARITY) -> None:
    assert relative_error(flat(path), want, floor=1.0) < tolerance


def policy(t: Any, state: State) -> jax.Array:
    return 0.5 - 0.3 * state.q[2:]


START = State(jnp.asarray(Q), jnp.asarray(V))


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "implicit", "RK4"])
def test_the_integrator_of_the_file(integrator: str, cone: str) -> None:
    """Without a name of an integrator the step is that of the file."""
    m = hopper(integrator, cone)
    path = rb.rollout(rb.load(m, contacts=True), START, jnp.array([0.3]), steps=STEPS)
    agree(path, stepped(m, 0.3, STEPS))


@pytest.mark.parametrize("kernel", [False, True])
def test_policy_and_batch(kernel: bool) -> None:
    m = hopper()
    v = np.stack([V, 0.5 * V, [-1.5, 0.0, 0.0]])
    state = State(jnp.stack([START.q] * 3), jnp.asarray(v))
    path = rb.rollout(rb.load(m, contacts=True), state, policy, steps=STEPS, kernel=kernel)
    for i in range(3):
        want = stepped(m, lambda q: 0.5 - 0.3 * q[2], STEPS, v[i])
        assert relative_error(flat(path)[i], want, floor=1.0) < F64_PARITY


def test_forces_of_a_user() -> None:
    m, tau = hopper(), np.array([0.0, 1.0, 0.2])
    model = rb.load(m, contacts=True)
    path = rb.rollout(model, START, jnp.array([0.3]), tau=jnp.asarray(tau), steps=STEPS)
    agree(path, stepped(m, 0.3, STEPS, qfrc_applied=tau))
    force = np.zeros((2, 6))
    force[0, 3] = 2.0
    path = rb.rollout(
        model, START, jnp.array([0.3]), wrenches=lambda t, state: jnp.asarray(force), steps=STEPS
    )
    agree(path, stepped(m, 0.3, STEPS, xfrc_applied=[[0] * 6, [2, *[0] * 5], [0] * 6]))


@pytest.mark.parametrize("kernel", [False, True])
def test_single_precision_with_a_model_in_double(kernel: bool) -> None:
    m = hopper()
    state = State(START.q.astype(jnp.float32)[None], START.v.astype(jnp.float32)[None])
    ctrl = jnp.array([0.3], jnp.float32)
    path = rb.rollout(rb.load(m, contacts=True), state, ctrl, steps=STEPS, kernel=kernel)
    assert path.q.dtype == jnp.float32
    agree(path, stepped(m, 0.3, STEPS)[None], 1e-4)


@pytest.mark.parametrize("kernel", [False, True])
def test_a_longer_step_softens_contacts(kernel: bool) -> None:
    """The least time constant of a contact is two steps of the motion: 30 ms, in place of 20."""
    m = hopper()
    model = rb.load(m, contacts=True)
    path = rb.rollout(model, START, jnp.array([0.3]), 0.015, steps=30, kernel=kernel)
    agree(path, stepped(m, 0.3, 30, dt=0.015))
    one = rb.step(model, START, jnp.array([0.3]), 0.015)
    np.testing.assert_allclose(one.v, path.v[1], rtol=1e-12)


@pytest.mark.parametrize("integrator", ["euler_implicit_damping", "implicitfast", "rk4"])
def test_linearise(integrator: str) -> None:
    model = rb.load(hopper(), contacts=True)
    path = rb.rollout(model, START, jnp.array([0.3]), steps=60)
    at, u, h = State(path.q[-1], path.v[-1]), jnp.array([0.3]), 1e-6
    A, B = rb.linearise(model, at, u, 0.002, integrator=integrator)

    @jax.jit
    def after(x: jax.Array) -> jax.Array:
        state = State(at.q + x[:3], at.v + x[3:6])
        found = rb.step(model, state, u + x[6:], 0.002, integrator=integrator)
        return jnp.concatenate([found.q, found.v])

    J = [(after(h * e) - after(-h * e)) / (2 * h) for e in jnp.eye(7)]
    assert relative_error(jnp.concatenate([A, B], 1), jnp.stack(J, 1), floor=1.0) < 1e-8


@pytest.mark.filterwarnings("ignore:.*biased at any step size")
@pytest.mark.parametrize("kernel", [False, True])
def test_gradient_of_a_rollout(kernel: bool) -> None:
    """Reverse, forward and differences agree through a landing."""
    model = rb.load(hopper(), contacts=True)

    def loss(x: jax.Array, us: jax.Array) -> jax.Array:
        path = rb.rollout(model, State(x[:3], x[3:]), us, kernel=kernel)
        return (path.q[-1] ** 2).sum() + path.v[-1, 1]

    at = (jnp.concatenate([START.q, START.v]), jnp.full((60, 1), 0.3))
    to = (jnp.arange(1.0, 7) / 6, jnp.cos(jnp.arange(60.0))[:, None])
    back = jax.jit(jax.grad(loss, (0, 1)))(*at)
    rate = jax.jit(lambda at, to: jax.jvp(loss, at, to)[1])(at, to)
    run, h = jax.jit(loss), 1e-6
    ends = [run(*(x + s * h * y for x, y in zip(at, to, strict=True))) for s in (1, -1)]
    both = sum(jnp.vdot(x, y) for x, y in zip(back, to, strict=True))
    assert relative_error(both, rate) < 1e-12
    assert relative_error(rate, (ends[0] - ends[1]) / (2 * h)) < 1e-7


@pytest.mark.filterwarnings("ignore:.*biased at any step size")
def test_gradients_of_loops_over_steps_save_as_rollouts_do() -> None:
    """A loop in a thread, a loop of threads and a loop of steps: the slopes of `rollout`, and no
    Newton iteration in the reverse loop."""
    model, steps = rb.load(hopper(), contacts=True), 8
    start = rb.rollout(model, START, jnp.array([0.3]), steps=60).state(-1)

    def last(state: State) -> jax.Array:
        return (state.q**2).sum() + state.v[1]

    def rolled(x: jax.Array) -> jax.Array:
        state = State(start.q + x[:3], start.v + x[3:6])
        return last(rb.rollout(model, state, x[6:], steps=steps, kernel=False).state(-1))

    def looped(step: Callable) -> Callable:
        def end(x: jax.Array) -> jax.Array:
            state = State(start.q + x[:3], start.v + x[3:6])
            turn = lambda state, _: (step(state, x[6:]), None)  # noqa: E731
            return last(jax.lax.scan(turn, state, None, length=steps)[0])

        return end

    def step(state: State, u: jax.Array) -> State:
        return rb.step(model, state, u)

    x = jnp.zeros(7)
    want = jax.jit(jax.grad(rolled))(x)
    loops = [rb.threads(looped(step)), looped(rb.threads(step)), looped(step)]
    forward = count(jax.make_jaxpr(lambda x: jax.linearize(loops[2], x)[0])(x), "while")
    for k, f in enumerate(loops):
        assert relative_error(jax.jit(jax.grad(f))(x), want) < 1e-11
        values, both = (count(jax.make_jaxpr(g)(x), "while") for g in (f, jax.grad(f)))
        # a thread whose slope is asked for computes the values twice
        assert both - forward - (values if k == 0 else 0) < values
    many = jnp.stack([x, x + 1e-3, x])
    found = jax.jit(jax.vmap(jax.grad(loops[0])))(many)
    assert relative_error(found[0], want) < 1e-11 and relative_error(found[1], want) > 1e-5


def test_simulate_takes_fixed_steps_as_rollout() -> None:
    model, ts = rb.load(hopper(), contacts=True), jnp.linspace(0, 0.06, 4)
    u = jnp.array([0.3])
    path = rb.simulate(model, START, ts, u, dt=2e-4)
    want = rb.rollout(model, START, u, 2e-4, steps=300, save_every=100, integrator="tsit5")
    assert relative_error(path.v, want.v, floor=1.0) < F64_PARITY


def test_no_state_is_a_sentence() -> None:
    model = rb.load(hopper(), contacts=True)
    none = State(jnp.zeros((0, 3)), jnp.zeros((0, 3)))
    with pytest.raises(rb.InputError, match="a batch of no states"):
        rb.rollout(model, none, jnp.zeros(1), steps=3)
