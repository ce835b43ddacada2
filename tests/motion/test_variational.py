"""The variational midpoint method: symplectic, of order 2, momenta kept, gradients, failure."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.motion.variational import VariationalMidpoint
from tests.compiler.host import COMPILER, many_on_host
from tests.forces.elements import Lag, Wind
from tests.tolerances import F64_IDENTITY, F64_TRANSFORM, GRADIENT, relative_error

NAME = "variational_midpoint"
SLOW = pytest.mark.slow


def energies(model: rb.Model, path: rb.Trajectory) -> np.ndarray:
    one = lambda q, v: rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q)  # noqa: E731
    return np.asarray(jax.jit(jax.vmap(one))(path.q, path.v))


def form(model: rb.Model, p: jax.Array) -> np.ndarray:
    """The symplectic form d(p dq) on increments (body axes) and momenta: [[-[p], 1], [-1, 0]], with
    [p] on attitudes alone."""
    n, spin = model.nv, np.zeros((model.nv, model.nv))
    for k in model.topology.turn_starts:
        x, y, z = np.asarray(p)[k : k + 3]
        spin[k : k + 3, k : k + 3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    return np.block([[spin, np.eye(n)], [-np.eye(n), np.zeros((n, n))]])


@pytest.mark.parametrize(
    ("scene", "evaluations"),
    [
        ("double_pendulum", 8),
        ("spinning_top", 12),
        pytest.param("arm7", 14, marks=SLOW),
        pytest.param("free_body", 12, marks=SLOW),
        pytest.param("quadruped", 14, marks=SLOW),
    ],
)
def test_a_step_keeps_the_symplectic_form(scene, evaluations):
    """J^T W(p1) J = W(p0) with J the derivative of a step in (q, p)."""
    model = rb.load(scene)
    model = model.replace(joints=model.joints.replace(damping=0 * model.joints.damping))
    state, n = model.random_state(jax.random.key(1)), model.nv
    method = VariationalMidpoint(evaluations)

    def stepped(dq, dp):
        q = rb.integrate(model, state.q, dq)
        p = rb.mass_matrix(model, state.q) @ state.v + dp
        v = jnp.linalg.solve(rb.mass_matrix(model, q), p)
        after = rb.step(model, rb.State(q, v), None, 0.01, integrator=method)
        return p, after.q, rb.mass_matrix(model, after.q) @ after.v

    @jax.jit
    def both(at):
        p0, q1, p1 = stepped(at, at)

        def moved(dq, dp):
            _, q, p = stepped(dq, dp)
            return jnp.concatenate([rb.difference(model, q1, q), p])

        return p0, p1, jnp.concatenate(jax.jacfwd(moved, (0, 1))(at, at), 1)

    p0, p1, J = both(jnp.zeros(n))
    J, start = np.asarray(J), form(model, p0)
    assert np.abs(J.T @ form(model, p1) @ J - start).max() < 1e-9 * np.abs(start).max()


@pytest.mark.slow
def test_energy_stays_where_semi_implicit_euler_loses_it():
    """A double pendulum that turns over, at 28 rad/s at its fastest: 500,000 steps of 5 ms."""
    model = rb.load("double_pendulum")
    state = rb.State(jnp.array([2.0, 1.0]), jnp.zeros(2))
    off = {}
    for method in ("semi_implicit_euler", NAME):
        path = rb.rollout(
            model, state, None, 0.005, steps=500_000, save_every=50, integrator=method
        )
        assert path.success
        e = energies(model, path)
        off[method] = np.abs(e - e[0])
        late = (e - e[0])[-2000:].mean()
        assert (abs(late) < 5e-3) == (method == NAME)
    assert off[NAME].max() < 0.1 < 10 < off["semi_implicit_euler"].max()


@pytest.mark.slow
def test_momentum_of_a_free_robot_is_kept():
    """In no gravity the discrete Noether theorem holds whatever the step."""
    model = rb.load("free_body")
    model = model.replace(gravity=0 * model.gravity)
    state = model.random_state(jax.random.key(2))
    state = state.replace(v=10 * state.v)
    path = rb.rollout(model, state, None, 0.02, steps=40, save_every=10, integrator=NAME)
    assert path.success
    momentum = jax.vmap(lambda q, v: rb.centroidal_momentum(model, q, v))
    kept = jax.jit(momentum)(path.q, path.v)
    assert relative_error(kept[1:], np.broadcast_to(kept[0], (4, 6))) < F64_IDENTITY
    e = energies(model, path)
    assert np.abs(e - e[0]).max() < 1e-3 * e[0]


def with_states() -> rb.Model:
    model = rb.load("quadrotor")
    return model.with_forces(Wind(jnp.array([3.0, 1.0, 0.0]), jnp.array(2.0)), Lag(jnp.array(0.1)))


@pytest.mark.parametrize(
    "which", ["states", pytest.param("held", marks=SLOW), pytest.param("arm7", marks=SLOW)]
)
def test_order_two_with_forces(which):
    """With controls, drag and an element with a state; under a law; with dampers and servos."""
    scene = {"held": "cart_pole"}.get(which, which)
    model = with_states() if which == "states" else rb.load(scene)
    state, u = model.random_state(jax.random.key(0)), 0.3 * jnp.ones(model.nu)

    def held(model, t, state, tau, f_ext):
        M, b = rb.mass_matrix(model, state.q), rb.bias_forces(model, state.q, state.v)
        return jnp.array([0.0, 1.0]) * (tau - b) / jnp.diag(M)

    more = {"dynamics": held} if which == "held" else {}

    @functools.partial(jax.jit, static_argnums=(0, 1))
    def end(integrator, n):
        path = rb.rollout(
            model, state, jnp.broadcast_to(u, (n, model.nu)), 0.2 / n, save_every=n,
            integrator=integrator, **more,
        )  # fmt: skip
        return jnp.concatenate([x[-1] for x in (path.q, path.v, path.x) if x is not None])

    exact = end("dopri8", 64)
    coarse, fine = (jnp.abs(end(NAME, n) - exact).max() for n in (16, 32))
    assert abs(np.log2(coarse / fine) - 2) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["cart_pole", pytest.param("spinning_top", marks=SLOW)])
def test_gradients_are_difference_quotients(scene):
    """In reverse, by state, controls and masses, with evaluations enough to converge."""
    model, key = rb.load(scene), jax.random.key(4)
    state = model.random_state(key)
    ctrls = jax.random.normal(key, (8, model.nu))

    @jax.jit
    def loss(ctrls, dq, v, mass):
        changed = model.replace(bodies=model.bodies.replace(mass=mass))
        start = rb.State(rb.integrate(model, state.q, dq), v)
        path = rb.rollout(
            changed, start, ctrls, 0.01, integrator=VariationalMidpoint(10), save_every=4
        )
        return (path.q**2).sum() + jnp.sin(path.v).sum()

    at = (ctrls, jnp.zeros(model.nv), state.v, model.bodies.mass)
    gradient = jax.jit(jax.grad(loss, (0, 1, 2, 3)))(*at)
    keys = jax.random.split(key, 4)
    step = tuple(jax.random.normal(k, x.shape) for k, x in zip(keys, at, strict=True))
    h = 1e-5
    ahead, behind = (loss(*(x + s * h * d for x, d in zip(at, step, strict=True))) for s in (1, -1))
    along = sum((g * d).sum() for g, d in zip(gradient, step, strict=True))
    assert relative_error(along, (ahead - behind) / (2 * h)) < GRADIENT


@pytest.mark.slow
def test_a_batch_is_a_loop():
    model = rb.load("cart_pole")
    states = jax.vmap(model.random_state)(jax.random.split(jax.random.key(0), 3))
    ctrls = jax.random.normal(jax.random.key(1), (3, 6, 1))
    batch = rb.rollout(model, states, ctrls, 0.01, integrator=NAME)
    for i in range(3):
        one = jax.tree.map(lambda x, i=i: x[i], states)
        path = rb.rollout(model, one, ctrls[i], 0.01, integrator=NAME)
        np.testing.assert_allclose(batch.q[i], path.q, rtol=0, atol=F64_TRANSFORM)


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize(
    ("scene", "driver"),
    [("cart_pole", "unrolled"), pytest.param("quadruped", "limbs", marks=SLOW)],
)
def test_emitted_c(scene, driver):
    """A step and its transposed derivative as one thread's program."""
    model = rb.load(scene).replace(driver=driver)
    states = jax.vmap(model.random_state)(jax.random.split(jax.random.key(0), 3))

    def f(q, v):
        after = rb.step(model, rb.State(q, v), None, 0.01, integrator=NAME)
        return after.q, after.v

    def slope(q, v):
        return jax.grad(lambda *x: sum((a * a).sum() for a in f(*x)), (0, 1))(q, v)

    given = (states.q, states.v)
    wants = [jax.jit(jax.vmap(g))(*given) for g in (f, slope)]
    for got, want in zip(many_on_host([(f, given), (slope, given)]), wants, strict=True):
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
            assert relative_error(a, b) < F64_IDENTITY


def test_a_law_gives_the_acceleration():
    """Of a cart whose law lets nothing accelerate: only what a midpoint neglects is left."""
    model = rb.load("cart_pole")
    state = rb.State(jnp.array([0.0, 1.0]), jnp.array([0.3, 0.2]))
    after = rb.step(model, state, dt=1e-3, integrator=NAME, dynamics=lambda *_: jnp.zeros(2))
    np.testing.assert_allclose(after.v, state.v, atol=1e-7)


class Stiff(rb.forces.Element):
    """A spring that keeps its stiffness from the iteration."""

    k: jax.Array

    def loads(self, context):
        joint = context.joint(0)
        return joint.push(-self.k * joint.q[0])


def test_a_slow_step_that_does_not_converge_is_no_number_either():
    """Without gravity; a correction is h^2 k / 4 I times the one before."""
    model = rb.load("pendulum").replace(gravity=jnp.zeros(3))
    inertia = rb.mass_matrix(model, jnp.zeros(1))[0, 0]
    for ratio, converges in ((0.01, True), (1.5, False)):
        acted = model.with_forces(Stiff(4 * ratio * inertia / 0.01))
        after = rb.step(acted, rb.State(1e-5 * jnp.ones(1), jnp.zeros(1)), dt=0.1, integrator=NAME)
        assert bool(jnp.isfinite(after.v).all()) == converges


def test_a_step_that_does_not_converge_is_no_number():
    model = rb.load("double_pendulum")
    state = rb.State(jnp.array([2.0, 1.0]), jnp.array([20.0, -30.0]))
    with pytest.warns(UserWarning, match="not finite"):
        assert not rb.rollout(model, state, None, 0.5, steps=3, integrator=NAME).success
    assert rb.rollout(model, state, None, 0.005, steps=3, integrator=NAME).success
    still = rb.load("pendulum").default_state()  # nothing moves: there is nothing to correct
    assert rb.rollout(rb.load("pendulum"), still, None, 0.5, steps=3, integrator=NAME).success


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, pytest.param(jnp.float64, marks=SLOW)])
def test_at_rest_corrections_are_rounding(dtype):
    """A robot that comes to rest is no step that does not converge."""
    model = rb.load("double_pendulum").astype(dtype)
    damped = model.joints.replace(damping=jnp.full(2, 2.0))
    state = rb.State(jnp.array([0.3, 0.2], dtype), jnp.zeros(2, dtype))
    path = rb.rollout(
        model.replace(joints=damped), state, None, 0.01, steps=4000, save_every=500, integrator=NAME
    )
    assert path.success and np.abs(path.v[-1]).max() < 1e-3


@pytest.mark.slow
def test_springs_and_dampers_of_joints_may_be_stiff():
    model = rb.load("double_pendulum")
    stiff = model.joints.replace(damping=1e4 * jnp.ones(2), stiffness=1e6 * jnp.ones(2))
    state = rb.State(jnp.array([0.1, 0.2]), jnp.array([1.0, -1.0]))
    path = rb.rollout(model.replace(joints=stiff), state, None, 0.01, steps=50, integrator=NAME)
    assert path.success and np.abs(path.v).max() < 30


@pytest.mark.parametrize(
    "kind", ["slide", pytest.param("screw", marks=SLOW), pytest.param("planar", marks=SLOW)]
)
def test_servos_of_joints_may_be_stiff(kind):
    """On whatever joint of coordinates that add: h = 19 sqrt(m / k) and more."""
    model = rb.load("cart_pole").with_joint("slider", kind)
    bias = jnp.array([[0.0, -1e6, -1e3]])
    model = model.replace(actuators=model.actuators.replace(bias=bias))
    state = model.default_state().replace(v=0.3 * jnp.ones(model.nv))
    path = rb.rollout(model, state, jnp.zeros((50, 1)), 0.02, integrator=NAME)
    assert path.success and np.abs(path.q[:, 0]).max() < 0.01


@pytest.mark.parametrize("wrong", [1, 0, 2.0, None])
def test_the_number_of_evaluations_is_checked(wrong):
    with pytest.raises(rb.InputError, match="expected an integer of at least 2"):
        VariationalMidpoint(wrong)
