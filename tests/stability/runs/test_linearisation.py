"""Linearised motion against differences, and the predicted largest steps against runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rbjax as rb
from rbjax import stability
from rbjax.motion.integrators import INTEGRATORS
from tests.tolerances import GRADIENT, relative_error

# A step too large by a share e grows a deviation by about (1 + 4 e)^2000 at a root that leaves at
# the usual slope: 1e5 is passed at half a per cent.
SHARP = 0.01
HOME = np.array([0.0, -0.3, 0.0, 1.9, 0.0, 1.54, 0.8])  # of arm7, and its servos' targets
FIRST = "rollout semi_implicit_euler"
slow = pytest.mark.slow


def test_turning_axes_are_in_the_matrix() -> None:
    """A free body without forces, by rotations of SciPy: log(R^T S) after a short time, where R
    turns at w, and S, from R exp(x), at w + dw."""
    model = rb.load("free_body").replace(gravity=jnp.zeros(3))
    rng = np.random.default_rng(0)
    w = rng.normal(size=3)
    state = rb.State(model.default_state().q, np.concatenate([np.zeros(3), w]))
    program = jax.jit(lambda s: stability.state_matrix(model, s))
    A = np.asarray(program(state))
    dt, step = 1e-5, 1e-4
    for x, dw in ((step * rng.normal(size=3), np.zeros(3)), (np.zeros(3), step * np.ones(3))):
        first, second = Rotation.from_rotvec(dt * w), Rotation.from_rotvec(dt * (w + dw))
        after = (first.inv() * Rotation.from_rotvec(x) * second).as_rotvec()
        rate = A[3:6] @ np.concatenate([np.zeros(3), x, np.zeros(3), dw])
        np.testing.assert_allclose((after - x) / dt, rate, atol=20 * step**2)
    I = np.diag([1 / float(x) for x in np.diag(rb.inverse_mass_matrix(model, state.q))[3:]])
    euler = np.array([np.cross(I @ u, w) + np.cross(I @ w, u) for u in np.eye(3)]).T
    np.testing.assert_allclose(A[9:, 9:], np.linalg.solve(I, euler), atol=1e-12)


@slow
def test_the_matrix_is_the_derivative_of_the_acceleration() -> None:
    """Central differences of forward dynamics under the servos of an arm."""
    model, step = rb.load("arm7"), 1e-5
    v, ctrl = 0.3 * np.arange(-3, 4), HOME + 0.1
    A = stability.state_matrix(model, rb.State(HOME, v), ctrl)

    @jax.jit
    def rate(x):
        state = rb.State(HOME + x[:7], v + x[7:])
        return rb.forward_dynamics(
            model, state.q, state.v, rb.applied_forces(model, state, jnp.asarray(ctrl))
        )

    columns = [(rate(u) - rate(-u)) / (2 * step) for u in step * np.eye(14)]
    assert relative_error(A[7:], np.stack(columns).T) < GRADIENT


def test_a_spring_is_seen() -> None:
    """omega^2 = (k + m g l) / I of the pendulum, by its mass matrix."""
    model = rb.load("pendulum")
    stiff = model.replace(joints=model.joints.replace(stiffness=jnp.array([1e5])))
    state = model.default_state()
    I = float(rb.mass_matrix(model, state.q)[0, 0])
    still = rb.State(*np.zeros((2, 9, 1)))
    plain, sprung = (-stability.motion_matrices(m, still)[0, 1, 0] for m in (model, stiff))
    assert float(sprung - plain) == pytest.approx(1e5 / I, rel=1e-12)


@pytest.mark.parametrize(
    "method",
    [m if m == FIRST else pytest.param(m, marks=slow) for m in (
        "rollout semi_implicit_euler", "rollout rk4", "rk4", "stoermer_verlet",
        "central_differences", "adams_bashforth3", "rkmk3", "pece4", "yoshida4",
    )],  # Tsit5 and Dopri8 leave the region beside the imaginary axis too slowly to be seen
)  # fmt: skip
def test_largest_step_of_a_pendulum(method: str) -> None:
    model = rb.load("pendulum")
    state = model.default_state()
    solver = stability.ROLLOUT[method[8:]] if method.startswith("rollout") else method
    predicted = stability.stable_step(solver, stability.state_matrix(model, state))
    measured = stability.measured_stable_step(method, model, state, near=predicted)
    assert measured == pytest.approx(predicted, rel=SHARP)


def test_every_integrator_of_rollout_has_its_solver() -> None:
    """But for the variational one, of which linear theory has the implicit midpoint rule: stable at
    any step, which its fixed number of evaluations does not reach; and for steps that are implicit
    in the velocity, since a matrix A does not say which damping is implicit."""
    implicit = {"euler_implicit_damping", "implicitfast", "implicit", "discrete"}
    assert stability.ROLLOUT.keys() == INTEGRATORS.keys() - {"variational_midpoint"} - implicit


@slow
@pytest.mark.parametrize("method", ["rollout semi_implicit_euler", "rollout rk4"])
def test_largest_step_of_an_arm_with_servos(method: str) -> None:
    model = rb.load("arm7")
    state = stability.equilibrium(model, rb.State(HOME, np.zeros(7)), HOME)
    A = stability.state_matrix(model, state, HOME)
    predicted = stability.stable_step(stability.ROLLOUT[method[8:]], A)
    assert predicted < 0.02, "the servos' damping decides"
    measured = stability.measured_stable_step(method, model, state, HOME, near=predicted)
    assert measured == pytest.approx(predicted, rel=SHARP)


def test_implicit_methods_have_no_largest_step() -> None:
    """Overdamped, undamped, and a mode that grows by nature, which does not count."""
    over, free, falling = (
        np.array([[0.0, 1.0], [k, d]]) for k, d in ((-1e2, -1e5), (-1e6, 0.0), (9.0, -1.0))
    )
    for A in (over, free, falling):
        for name in ("radau_iia3", "bdf2", "ros34pw2"):
            assert stability.stable_step(name, A) == np.inf
    assert stability.stable_step("rk4", over) == pytest.approx(2.785293563405282e-5, rel=1e-5)
    assert stability.stable_step("rk4", free) == pytest.approx(2.8284271e-3, rel=1e-6)
    assert stability.stable_step("stoermer_verlet", free) == pytest.approx(2e-3, rel=1e-6)
    assert stability.stable_step("rk4", falling) > 0.5  # of the mode that decays alone


def beside(k: float, d: float) -> np.ndarray:
    """A pair's matrix (4, 4): q_1'' = k q_1, q_2'' = -1e4 q_2, and d v_j into either's equation."""
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2:, :2] = np.diag([k, -1e4 if d == 0 else 0.0])
    A[2:, 2:] = np.array([[0, d], [d, 0]])
    return A


@pytest.mark.parametrize(
    ("method", "vibrating", "turning"),
    [
        ("newmark", np.inf, np.inf),
        ("stoermer_verlet", 0.02, 4 / 3),  # half kicks by an explicit method that reaches -2
        *(pytest.param(*row, marks=slow) for row in (
            ("symplectic_euler", 0.02, 2 / 3), ("central_differences", 0.02, 2 / 3),
            ("semi_implicit_euler", 0.02, np.inf), ("generalized_alpha", np.inf, np.inf),
            ("variational_midpoint", np.inf, np.inf), ("yoshida4", 0.0157340194743, None),
        )),
    ],
)  # fmt: skip
def test_modes_that_grow_do_not_count_for_second_order_methods(
    method: str, vibrating: float, turning: float | None
) -> None:
    """They neither hold back a method nor hide a vibration, omega = 100, that it makes grow.

    Turning about the middle axis, omega' = D omega, has the rates +-3: 1 - 3 h of an explicit
    step leaves at 2 / 3. yoshida4: the trace of its three steps' matrix is 2 at 1.57340195.
    """
    assert stability.stable_step(method, beside(25.0, 0.0)) == pytest.approx(vibrating, rel=1e-6)
    if turning is not None:
        assert stability.stable_step(method, beside(0.0, 3.0)) == pytest.approx(turning, rel=1e-6)


def test_what_has_no_equilibrium_says_so() -> None:
    model = rb.load("pendulum")
    state = model.default_state()
    with pytest.raises(rb.InputError, match=r"an acceleration of .* is left after 50 steps"):
        stability.equilibrium(model, state, np.array([5.0]))  # more than its weight can hold
    with pytest.raises(rb.InputError, match=r"equilibrium: q\[0\] is nan"):
        stability.equilibrium(model, rb.State(np.array([np.nan]), np.zeros(1)))
    with pytest.raises(rb.InputError, match=r"expected one of .*'rk4'"):
        stability.measured_stable_step("rollout euler", model, state, near=1.0)
    bent, upright, moving = (
        rb.State(np.array([q]), np.array([v])) for q, v in ((0.5, 0.0), (np.pi, 0.0), (0.0, 1.0))
    )
    for start, options, words in (
        (bent, {}, r"accelerates at .*expected one at rest.*equilibrium"),
        (moving, {}, "moves at 1.0"),
        (upright, {}, r"unstable, the exact motion departs from it as exp\(3.8 t\)"),
        (state, {"near": 0.0}, "near is 0.0, expected a time above zero"),
        (state, {"near": -1.0}, "near is -1.0, expected a time above zero"),
        (state, {"steps": 0}, "steps is 0, expected .*10"),
        (np.zeros(1), {}, "state is array"),
    ):
        with pytest.raises(rb.InputError, match=words):
            stability.measured_stable_step("rk4", model, start, **{"near": 0.3, **options})
    with pytest.raises(rb.InputError, match=r"expected \(T, nq\)"):
        stability.motion_matrices(model, state)
