"""simulate: closed forms, invariants, failure as a value, derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.tolerances import F64_IDENTITY, GRADIENT, relative_error

TIGHT = diffrax.PIDController(rtol=1e-11, atol=1e-11)


def test_free_fall_is_a_parabola():
    model = rb.load("free_body").replace(gravity=jnp.array([0.0, 0.0, -9.81]))
    state = model.default_state()
    state = rb.State(state.q, state.v.at[:3].set(jnp.array([1.0, 2.0, 3.0])))
    ts = jnp.linspace(0, 1, 6)
    out = rb.simulate(model, state, ts)
    fall = state.q[:3] + ts[:, None] * state.v[:3] + ts[:, None] ** 2 / 2 * model.gravity
    np.testing.assert_allclose(out.q[:, :3], fall, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [diffrax.Tsit5(), pytest.param(diffrax.Dopri8(), marks=pytest.mark.slow)]
)
def test_energy_momentum_and_unit_length_of_a_tumbling_satellite(solver, key):
    model = rb.load("satellite").replace(driver="rolled")
    model = model.replace(joints=model.joints.replace(damping=jnp.zeros(model.nv)))
    state = model.random_state(key)
    ts = jnp.linspace(0, 3, 7)
    out = rb.simulate(model, state, ts, solver=solver, stepsize_controller=TIGHT)
    energy = jax.jit(jax.vmap(lambda q, v: rb.kinetic_energy(model, q, v)))(out.q, out.v)
    momentum = jax.jit(jax.vmap(lambda q, v: rb.centroidal_momentum(model, q, v)))(out.q, out.v)
    assert np.ptp(energy) < 1e-8 * energy[0]
    assert np.ptp(momentum, axis=0).max() < 1e-8 * np.abs(momentum[0]).max()
    for start in model.topology.quaternion_starts:
        length = jnp.linalg.norm(out.q[:, start : start + 4], axis=-1)
        np.testing.assert_allclose(length, 1, atol=4e-16)


@pytest.mark.slow
def test_adaptive_and_fixed_steps_agree(key):
    model = rb.load("double_pendulum")
    state, ts = model.random_state(key), jnp.linspace(0, 0.5, 3)
    adaptive = rb.simulate(model, state, ts, stepsize_controller=TIGHT, solver=diffrax.Dopri8())
    fixed = rb.simulate(model, state, ts, dt=1e-3, solver=diffrax.Dopri8())
    np.testing.assert_allclose(adaptive.q, fixed.q, atol=1e-9)
    assert adaptive.stats["num_steps"] < fixed.stats["num_steps"] == 500


def test_control_sees_time_and_state(key):
    """A servo written as control is the scene's own servo."""
    model = rb.load("pendulum")
    state, ts = model.random_state(key), jnp.linspace(0, 0.4, 3)
    gain = model.actuators.gain[0, 0]
    torque = lambda t, s: -3.0 * s.q / gain  # noqa: E731
    out = rb.simulate(model, state, ts, torque, stepsize_controller=TIGHT)
    spring = model.replace(
        joints=model.joints.replace(
            stiffness=model.joints.stiffness + 3.0 * model.actuators.gear[0, 0]
        )
    )
    again = rb.simulate(spring, state, ts, stepsize_controller=TIGHT)
    np.testing.assert_allclose(out.q, again.q, atol=1e-8)


def test_a_failed_solve_is_a_result(key):
    model = rb.load("double_pendulum")
    state, ts = model.random_state(key), jnp.linspace(0, 10.0, 3)
    out = rb.simulate(model, state, ts, max_steps=5, throw=False)
    assert not bool(out.success)
    assert out.result != diffrax.RESULTS.successful
    with pytest.raises(Exception, match="maximum number of solver steps"):
        rb.simulate(model, state, ts, max_steps=5)


def test_a_blow_up_with_fixed_steps_is_said(key):
    model = rb.load("double_pendulum")
    state = rb.State(jnp.ones(2), 1e8 * jnp.ones(2))
    ts = jnp.array([0.0, 50.0])
    out = rb.simulate(model, state, ts, dt=1.0, throw=False)
    assert not bool(out.success)


@pytest.mark.slow
def test_a_robot_of_other_numbers_is_not_compiled_anew(key):
    """Outside of jit the model is an argument with known zeros; a new zero pattern recompiles."""
    model, traces = rb.load("cart_pole"), []
    state, ts = model.random_state(key), jnp.linspace(0, 0.3, 3)

    def control(t, state):
        traces.append(t)
        return -state.v[:1]

    inside = jax.jit(lambda m: rb.simulate(m, state, ts, lambda t, s: -s.v[:1], dt=0.01).q)
    bodies = model.bodies
    heavier = model.replace(bodies=bodies.replace(mass=2 * bodies.mass, com=1.1 * bodies.com))
    tilted = model.replace(gravity=jnp.array([1.0, 0.5, -9.0]))
    counts = []
    for m in (model, heavier, tilted, heavier.fix_zeros()):
        path = rb.simulate(m, state, ts, control, dt=0.01)
        counts.append(len(traces))
        assert relative_error(path.q, inside(m)) < F64_IDENTITY
    assert counts[0] == counts[1] < counts[2]


def test_gradient_through_diffrax(key):
    model = rb.load("cart_pole")
    state, ts = model.random_state(key), jnp.linspace(0, 0.3, 3)

    @jax.jit
    def loss(v, damping):
        changed = model.replace(joints=model.joints.replace(damping=damping))
        return (rb.simulate(changed, rb.State(state.q, v), ts, dt=0.01).q ** 2).sum()

    at = (state.v, model.joints.damping + 0.1)
    gradient = jax.jit(jax.grad(loss, (0, 1)))(*at)
    h, d = 1e-6, jnp.array([0.6, -0.8])
    ahead, behind = (loss(at[0] + s * h * d, at[1] + s * h * d) for s in (1, -1))
    along = (gradient[0] * d).sum() + (gradient[1] * d).sum()
    assert relative_error(along, (ahead - behind) / (2 * h)) < 10 * GRADIENT  # h is 1e-6


def test_bad_times_and_states_are_named():
    model = rb.load("pendulum")
    state = model.default_state()
    with pytest.raises(rb.InputError, match="ts must increase"):
        rb.simulate(model, state, jnp.array([0.0, 1.0, 0.5]))
    for dt in (0.0, -0.1):
        with pytest.raises(rb.InputError, match="expected a positive step"):
            rb.simulate(model, model.default_state(), jnp.array([0.0, 1.0]), dt=dt)
    with pytest.raises(rb.InputError, match="dt is nan, expected finite"):
        rb.simulate(model, model.default_state(), jnp.array([0.0, 1.0]), dt=np.nan)
    with pytest.raises(rb.InputError, match="at least 2 times"):
        rb.simulate(model, state, jnp.array([0.0]))
    with pytest.raises(rb.InputError, match="expected finite values"):
        rb.simulate(model, rb.State(state.q, state.v * jnp.nan), jnp.array([0.0, 1.0]))
    top = rb.load("spinning_top")
    with pytest.raises(rb.InputError, match="zero quaternion"):
        rb.simulate(top, rb.State(jnp.zeros(4), jnp.zeros(3)), jnp.array([0.0, 1.0]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ctrl": jnp.ones((4, 1))}, r"ctrl has shape \(4, 1\), .* or \(1, 1\): .* policy"),
        ({"ctrl": lambda t, s: jnp.ones(2)}, r"the control returned has shape \(2,\), exp"),
        ({"ctrl": dict}, r"ctrl is the class dict, expected a function \(t, state\)"),
        ({"ctrl": lambda t, s: 1.0}, r"returned has shape \(\), expected \(1,\)"),
        ({"ctrl": lambda t, s: None}, "returned is NoneType, expected an array of shape"),
        ({"model": rb.load("spinning_top"), "ctrl": lambda t, s: jnp.ones(3)}, "expected .0,.:"),
        ({"max_steps": 0}, "max_steps is 0, expected an integer of at least 1"),
        ({"state": rb.State(None, jnp.zeros(2))}, "q is NoneType, expected an array"),
        ({"state": None}, "state is None, expected rbjax.State"),
        ({"ts": None}, "at least 2 times"),
        ({"ts": ["0", "1"]}, "ts has dtype <U1, expected times in seconds"),
        ({"dt": 1e-17}, "float64 cannot add to a time of 1.0 s; expected more than"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    model = arguments.get("model", rb.load("cart_pole"))
    given = {"state": model.default_state(), "ts": [0.0, 1.0], "dt": 0.5} | arguments
    given.pop("model", None)
    with pytest.raises(rb.InputError, match=message):
        rb.simulate(model, **given)


@pytest.mark.slow
@pytest.mark.parametrize("start", [1e5, 1e9])
def test_a_late_start_costs_no_digits(start):
    """In f32 a step of a millisecond is lost at 1e5 s; time runs from the first of ts."""
    model = rb.load("pendulum")
    state = rb.State(*(jnp.ones(1, jnp.float32) for _ in range(2)))
    ts = np.array([0.0, 0.02, 0.05])
    seen = lambda t, s: jnp.where(t >= start, 1.0, np.nan) * s.q  # noqa: E731
    now, late = (rb.simulate(model, state, ts + t, c, dt=1e-3)
                 for t, c in ((0.0, lambda t, s: s.q), (start, seen)))  # fmt: skip
    assert relative_error(late.q, now.q) < 1e-6
    assert late.stats["num_steps"] == now.stats["num_steps"] == 50


@pytest.mark.slow
def test_a_forward_derivative_takes_its_own_adjoint(key):
    model = rb.load("pendulum")
    state = model.random_state(key)

    def end(v, **how):
        ts = jnp.array([0.0, 0.05])
        return rb.simulate(model, rb.State(state.q, v), ts, dt=0.01, **how).q[-1]

    with pytest.raises(rb.InputError, match=r"adjoint=diffrax.ForwardMode\(\)"):
        jax.jacfwd(end)(state.v)
    forward = jax.jacfwd(lambda v: end(v, adjoint=diffrax.ForwardMode()))(state.v)
    assert relative_error(forward, jax.jacrev(end)(state.v)) < F64_IDENTITY


def test_a_joint_that_moves_no_mass_is_told():
    model = rb.load("pendulum")
    none = model.bodies.replace(mass=jnp.zeros(1), inertia=jnp.zeros((1, 3, 3)))
    joints = model.joints.replace(armature=jnp.zeros(1))
    empty = model.replace(bodies=none, joints=joints)
    with pytest.raises(rb.ModelError, match=r"moves no mass, .* singular; give its body mass"):
        rb.simulate(empty, model.default_state(), jnp.array([0.0, 0.1]), dt=0.05)
    with pytest.warns(UserWarning, match="values that are not finite, the first at t = 0.05 s"):
        path = rb.rollout(empty, model.default_state(), None, 0.05, steps=2)
    assert not bool(path.success)  # there the numbers are arguments
