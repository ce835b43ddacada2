"""`linearise` and `step` against differences of `rollout`, and a closed form."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces.inputs import Inputs
from rbjax.motion.linearise import box_minus, box_plus
from tests.forces.elements import Lag, Wind
from tests.tolerances import F64_IDENTITY, relative_error

EPS = 1e-6


linearised = jax.jit(rb.linearise)


def model_with_states() -> rb.Model:
    model = rb.load("quadrotor")
    return model.with_forces(Wind(jnp.array([3.0, 1.0, 0.0]), jnp.array(2.0)), Lag(jnp.array(0.1)))


def test_a_pendulum_in_closed_form():
    model = rb.load("pendulum")
    A, B = rb.linearise(model, model.default_state(), jnp.zeros(1))
    mass, length = model.bodies.mass[0], jnp.linalg.norm(model.bodies.com[0])
    inertia = rb.mass_matrix(model, model.default_state().q)[0, 0]
    stiffness = mass * 9.81 * length
    damping = model.joints.damping[0]
    gravity = float(-model.gravity[2])
    wanted = [[0, 1], [-stiffness * gravity / 9.81 / inertia, -damping / inertia]]
    np.testing.assert_allclose(A, np.array(wanted, float), rtol=1e-12)
    gear = model.actuators.gear[0, 0] * model.actuators.gain[0, 0]
    np.testing.assert_allclose(B, [[0.0], [gear / inertia]], rtol=1e-12)


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_a_step_is_one_of_rollout(integrator, key):
    model = model_with_states()
    state, u = model.random_state(key), 0.3 * jnp.ones(model.nu)
    stepped = jax.jit(functools.partial(rb.step, integrator=integrator))
    one = stepped(model, state, u, 0.01)
    path = rb.rollout(model, state, u[None], 0.01, integrator=integrator)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(path.state(1)), strict=True):
        assert relative_error(a, b) < F64_IDENTITY


def test_a_step_takes_what_a_rollout_takes():
    """Integrators and laws that are functions, too."""
    model = rb.load("cart_pole")
    state = model.default_state().replace(v=jnp.array([1.0, 2.0]))

    def euler(field, t, state, inputs, dt):
        a, _ = field.rates(t, state, inputs)
        return rb.State(field.retract(state.q, dt * state.v), state.v + dt * a)

    def held(model, t, state, tau, f_ext):
        return jnp.zeros(2)

    after = rb.step(model, state, dt=0.01, integrator=euler, dynamics=held)
    np.testing.assert_allclose(after.q - state.q, [0.01, 0.02], rtol=1e-12)
    A, _ = rb.linearise(model, state, dt=0.01, integrator=euler, dynamics=held)
    np.testing.assert_allclose(A[:2], np.eye(4)[:2] + 0.01 * np.eye(4)[2:], rtol=1e-12)


def test_a_step_is_differentiated(key):
    model = model_with_states()
    state, u = model.random_state(key), 0.3 * jnp.ones(model.nu)
    A, B = linearised(model, state, u, 0.01)
    n = 2 * model.nv + model.nx
    assert A.shape == (n, n) and B.shape == (n, model.nu)

    @jax.jit
    def moved(dx, du):
        after = rb.step(model, box_plus(model, state, dx), u + du, 0.01)
        return box_minus(model, rb.step(model, state, u, 0.01), after)

    def differences(f, size):
        return np.stack([(f(e) - f(-e)) / (2 * EPS) for e in EPS * np.eye(size)], -1)

    still = jnp.zeros(n), jnp.zeros(model.nu)
    by_state = differences(lambda e: moved(jnp.asarray(e), still[1]), n)
    by_control = differences(lambda e: moved(still[0], jnp.asarray(e)), model.nu)
    assert relative_error(A, by_state) < 1e-7
    assert relative_error(B, by_control) < 1e-7


def test_the_continuous_form_is_the_limit_of_the_discrete_one(key):
    """(A_dt - 1) / dt = A + O(dt), for attitudes and element states too."""
    model = model_with_states()
    state, u = model.random_state(key), 0.3 * jnp.ones(model.nu)
    A, B = linearised(model, state, u)
    errors = []
    for dt in (1e-3, 1e-4):
        Ad, Bd = linearised(model, state, u, dt)
        slope = (Ad - jnp.eye(len(A))) / dt
        errors.append([relative_error(slope, A), relative_error(Bd / dt, B)])
    coarse, fine = np.array(errors)
    np.testing.assert_allclose(coarse / fine, 10.0, rtol=0.1)


def test_no_controls_no_columns():
    model = rb.load("cart_pole")
    assert rb.linearise(model, model.default_state()).B.shape == (4, 0)


def test_bad_arguments():
    model = rb.load("cart_pole")
    with pytest.raises(rb.InputError, match=r"step: integrator 'rk5', expected one of \['semi_"):
        rb.step(model, model.default_state(), integrator="rk5")
    with pytest.raises(rb.InputError, match="linearise: dt is -1"):
        rb.linearise(model, model.default_state(), dt=-1.0)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("dt", [None, 0.01])
def test_the_acceleration_at_the_point_is_reported(dtype, dt):
    """Zero where the pendulum hangs; where it leans it is that of forward dynamics."""
    model = rb.load("pendulum").astype(dtype)
    for angle in (0.0, 0.3):
        state = rb.State(jnp.full(1, angle, dtype), jnp.zeros(1, dtype))
        found = rb.linearise(model, state, jnp.zeros(1, dtype), dt)
        want = rb.forward_dynamics(model, state.q, state.v, jnp.zeros(1, dtype))
        assert found.acceleration.dtype == dtype and len(list(found)) == 2
        assert abs(found.acceleration - want).max() <= 1e-5 * (1 + abs(want).max())
        assert bool(abs(found.acceleration).max() < 1e-6) == (angle == 0.0)


@pytest.mark.parametrize("name", ["cart_pole", pytest.param("quadruped", marks=pytest.mark.slow)])
def test_the_closed_form_of_free_motion_is_the_derivative_of_its_rates(name: str) -> None:
    """With springs, actuators, attitudes, a wrench on a body and an element with a state."""
    from rbjax.motion import linearise as of

    model = rb.load(name)
    body = model.body_names[-1]
    on = rb.forces.Place.on
    spring = rb.forces.PointSpring.of(
        on(), on(body=body, point=[0.1, 0.0, 0.2]), stiffness=3.0, length=0.1
    )
    model = model.with_forces(spring)
    state = model.random_state(jax.random.key(0))
    ctrl = 0.1 * jnp.ones(model.nu)
    given = Inputs(ctrl)
    own = of._free_rates(model, state, given, 0.0)
    want = of._rates(model, state, given, 0.0, of.free_motion)
    for x, y in zip(own, want, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-10 * max(1.0, float(jnp.abs(y).max())))


HOPPER = """<mujoco><worldbody><geom type="plane" size="0 0 1"/>
  <body pos="0 0 0.0999"><joint name="z" type="slide" axis="0 0 1"/>
    <joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body></worldbody>
  <actuator><motor joint="z"/></actuator></mujoco>"""


@pytest.mark.parametrize("law", ["mujoco", "coulomb", "impulse"])
def test_a_step_with_a_contact(law):
    model, dt, e = rb.load(HOPPER), 0.002, 1e-6  # small, within one face of the cone
    state = rb.State(jnp.zeros(2), jnp.array([-0.01, 0.02]))
    A, B = rb.linearise(model, state, jnp.zeros(1), dt=dt, contact=law)

    def after(x, u):
        found = rb.step(model, rb.State(x[:2], x[2:]), u, dt, contact=law)
        return jnp.concatenate([found.q, found.v])

    x = jnp.concatenate([state.q, state.v])
    for k, d in enumerate(e * np.eye(4)):
        due = (after(x + d, jnp.zeros(1)) - after(x - d, jnp.zeros(1))) / (2 * e)
        np.testing.assert_allclose(A[:, k], due, atol=1e-5)
    due = (after(x, jnp.full(1, e)) - after(x, jnp.full(1, -e))) / (2 * e)
    np.testing.assert_allclose(B[:, 0], due, atol=1e-5)
