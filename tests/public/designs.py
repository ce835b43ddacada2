"""Cases of the functions of arrays of control, estimation, sysid and stability."""

from __future__ import annotations

import functools
from collections.abc import Callable
from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax import control, estimation, stability, sysid
from rbjax.control import linear
from tests.public.grid import Case, same
from tests.robots import robot

RNG = np.random.default_rng(4)
F64 = (np.float64,)


def positive(n: int, size: int = 3) -> np.ndarray:
    """Positive definite matrices of condition 10 or so."""
    A = RNG.normal(size=(n, size, size))
    return A @ A.swapaxes(1, 2) + size * np.eye(size)


def state(q, v):
    return rb.State(q, v)


# ---------------------------------------------------------------- control

STABLE = RNG.normal(size=(3, 3, 3)) - 4 * np.eye(3)
INPUT, OUTPUT = RNG.normal(size=(3, 3, 2)), RNG.normal(size=(3, 2, 3))
WEIGHT, SMALL_WEIGHT = positive(3), positive(3, 2)
START = RNG.normal(size=(3, 3))


def steady(A, B, Q, R):
    return linear.LinearQuadratic.constant(A, B, Q, R, 4)


def rolled(A, B, Q, R, x):
    problem = steady(A, B, Q, R)
    return problem.roll(linear.backward(problem), x)


LQ = [0.2 * STABLE, INPUT, WEIGHT, SMALL_WEIGHT]
CONTROL = {
    "lqr": Case(same(lambda *x: control.lqr(*x)[:2]), [STABLE, *LQ[1:]]),
    "backward": Case(same(lambda *x: linear.backward(steady(*x))[:4]), LQ),
    "LinearQuadratic.constant": Case(same(lambda *x: steady(*x)), LQ),
    "backward, parallel": Case(same(lambda *x: linear.backward(steady(*x), parallel=True)[:4]), LQ),
    "LinearQuadratic.roll": Case(same(rolled), [*LQ, START]),
    "lyapunov": Case(same(lambda A, Q: linear.lyapunov(A, Q).X), [STABLE, WEIGHT]),
    "discretise": Case(same(lambda A, B: linear.discretise(A, B, 0.1)), [STABLE, INPUT]),
    "kalman_gain": Case(
        same(lambda A, C, W, V: linear.kalman_gain(A, C, W, V)[:2]),
        [STABLE, OUTPUT, WEIGHT, SMALL_WEIGHT],
    ),
}


def cart(dtype: Any) -> rb.Model:
    return robot("cart_pole", "unrolled").model.astype(dtype)


def of_arm(make: Callable) -> Callable[[Any], Callable]:
    """A law of the arm with seven joints at a state: its torques."""

    def found(dtype: Any) -> Callable:
        model = robot("arm7", "unrolled").model.astype(dtype)
        return lambda q, v: make(model).tau(jnp.asarray(0.0, dtype), rb.State(q, v))

    return found


def of_arm_to(name: str, **options: Any) -> Callable[[Any], Callable]:
    """A law of the arm that holds its tool at a position."""

    def found(dtype: Any) -> Callable:
        model = robot("arm7", "unrolled").model.astype(dtype)

        def tau(q, v, position):
            make = getattr(control, name)
            law = make(model, position, site="tool", task="position", stiffness=25.0, **options)
            return law.tau(jnp.asarray(0.0, dtype), rb.State(q, v))

        return tau

    return found


def follow(model, q, velocity):
    """The velocities of the joints that move the tool with a linear velocity."""
    goal = control.Goal(site="tool", position=velocity)
    return control.differential_inverse_kinematics(model, q, goal, damping=0.1).v


SEVEN = [0.5 * RNG.normal(size=(3, 7)) for _ in range(2)]
REACHED, FEEDBACK = 0.3 * RNG.normal(size=(3, 3)), 0.1 * RNG.normal(size=(3, 2, 3))
FOUR, CART_STATE = np.full((3, 4), 1.0), [0.2 * RNG.normal(size=(3, 2)) for _ in range(2)]
ONE = np.full((3, 1), 1.0)


def on(model: Callable[[Any], rb.Model], f: Callable) -> Callable[[Any], Callable]:
    """A function of a model and arrays. The model is made before any tracing."""
    return lambda dtype: functools.partial(f, model(dtype))


def planned(method: str) -> Callable[[Any], Callable]:
    """The controls of a short plan with a strictly convex cost, which has one optimum."""

    def make(dtype: Any) -> Callable:
        model = cart(dtype)
        goal = control.StateError(model.default_state())
        problem = control.Problem(model, 4, 0.05, running=[goal, control.Control()])
        return lambda q, v: control.solve(problem, rb.State(q, v), method=method).ctrl

    return make


def tracked(dtype: Any) -> Callable:
    def gains(q, v, Q, R):
        states = rb.State(jnp.stack([q] * 3), jnp.stack([v] * 3))
        u = jnp.zeros((2, 1), q.dtype)
        return control.time_varying_lqr(cart(dtype), states, u, 0.01, Q, R).K

    return gains


CONTROL |= {
    "time_varying_lqr": Case(tracked, [*CART_STATE, FOUR, ONE]),
    "lqr_at": Case(
        on(cart, lambda m, Q, R: control.lqr_at(m, m.default_state(), 0 * R, Q, R)[:2]),
        [FOUR * np.array([1.0, 2.0, 3.0, 4.0]), ONE],
    ),
    "feedback": Case(
        on(
            cart,
            lambda m, q, v, K: control.feedback(m, m.default_state(), 0 * q[:1], K)(
                0.0, rb.State(q, v)
            ),
        ),
        [*CART_STATE, RNG.normal(size=(3, 1, 4))],
    ),
    "allocate": Case(
        on(cart, lambda m, q, v, u: control.allocate(m, rb.State(q, v), u)[:2]),
        [*CART_STATE, RNG.normal(size=(3, 2))],
    ),
    "computed_torque": Case(
        of_arm(lambda m: control.computed_torque(m, m.default_state().q, stiffness=25.0)), SEVEN
    ),
    "joint_impedance": Case(
        of_arm(
            lambda m: control.joint_impedance(m, m.default_state().q, stiffness=25.0, damping=5.0)
        ),
        SEVEN,
    ),
    "gravity_compensation": Case(of_arm(lambda m: control.gravity_compensation(m)), SEVEN),
    "operational_space": Case(of_arm_to("operational_space"), [*SEVEN, REACHED]),
    "cartesian_impedance": Case(of_arm_to("cartesian_impedance", damping=5.0), [*SEVEN, REACHED]),
    "differential_inverse_kinematics": Case(
        lambda d: lambda q, p: follow(robot("arm7", "unrolled").model.astype(d), q, p),
        [SEVEN[0], REACHED],
    ),
    "controllability": Case(
        same(lambda A, B: linear.controllability(A, B).inside), [STABLE, INPUT[..., :1]]
    ),
    "observability": Case(
        same(lambda A, C: linear.observability(A, C).weakest), [STABLE, OUTPUT[:, :1]]
    ),
    "poles": Case(same(lambda A, B, K: jnp.real(linear.poles(A, B, K))), [STABLE, INPUT, FEEDBACK]),
    # kinks where the loop that is closest to instability changes
    "margins": Case(
        same(lambda *x: [jnp.arctan(y) for y in linear.margins(*x)[:4]]),  # some are infinite
        [STABLE, INPUT, FEEDBACK],
        derivatives=False,
    ),
    # in JAX's default dtype, whatever that of the model
    "solve, ddp": Case(planned("ddp"), CART_STATE, dtypes=F64),
    "solve, sqp": Case(planned("sqp"), CART_STATE, dtypes=F64),
}

# ---------------------------------------------------------------- estimation


def estimate(x, P):
    return estimation.Estimate(x, P)


SPACE = estimation.StateSpace.of(lambda x, u, w: jnp.sin(x) + u + w, lambda x: x[:2])
READ = [RNG.normal(size=(3, 2, 3)), RNG.normal(size=(3, 3, 2))]


def filtered(read: Callable) -> Callable[[Any], Callable]:
    """A filter of three samples of a system of three states, of noise that is known."""

    def found(x, P, u, y, W, V):
        space = estimation.StateSpace.of(lambda x, u, w: jnp.sin(x) + u + w, lambda x: x[:2])
        return read(space, estimation.kalman_filter(space, x, P, u, y, W, V))

    return same(found)


def moved(read: Callable) -> Callable[[Any], Callable]:
    def make(dtype: Any) -> Callable:
        space = estimation.model_state_space(cart(dtype), lambda state: state.q, 0.01)
        return lambda q, v, u: read(space, rb.State(q, v), u)

    return make


ESTIMATION = {
    "kalman_predict": Case(
        same(
            lambda x, P, u: estimation.kalman_predict(
                SPACE, estimate(x, P), u, jnp.eye(3, dtype=x.dtype)
            )
        ),
        [START, WEIGHT, START[::-1]],
    ),
    "kalman_update": Case(
        same(lambda x, P, y, V: estimation.kalman_update(SPACE, estimate(x, P), y, V)),
        [START, WEIGHT, START[:, :2], SMALL_WEIGHT],
    ),
    "model_state_space": Case(
        moved(lambda space, x, u: space.move(x, u, jnp.zeros(4, u.dtype))), [*CART_STATE, ONE]
    ),
    "kalman_filter": Case(
        filtered(lambda space, x: (x.state, x.covariance, x.log_likelihood)),
        [START, WEIGHT, *READ, WEIGHT, SMALL_WEIGHT],
    ),
    "kalman_smoother": Case(
        filtered(estimation.kalman_smoother), [START, WEIGHT, *READ, WEIGHT, SMALL_WEIGHT]
    ),
}

# ---------------------------------------------------------------- sysid

PSEUDO = positive(3, 4)
THETA = 0.3 * RNG.normal(size=(3, 10))


@cache
def arm(dtype: Any) -> rb.Model:
    return robot("double_pendulum", "unrolled").model.astype(dtype)


def heavier(f: Callable) -> Callable[[Any], Callable]:
    """A function of the masses of the two bodies."""
    return on(arm, lambda model, mass: f(model.replace(bodies=model.bodies.replace(mass=mass))))


LONG = [RNG.normal(size=(3, 4, 2)) for _ in range(3)]
TWO = [RNG.normal(size=(3, 2)) for _ in range(3)]
MASSES = np.abs(RNG.normal(size=(3, 2))) + 1
SYSID = {
    "regressor": Case(
        on(arm, lambda m, q, v, a: sysid.torque.regressor(m, q, v, a, joint_terms=("viscous",))),
        TWO,
    ),
    "to_log_cholesky": Case(same(sysid.parameters.to_log_cholesky), [PSEUDO]),
    "from_log_cholesky": Case(same(sysid.parameters.from_log_cholesky), [THETA]),
    "pseudo_inertia_of": Case(same(sysid.parameters.pseudo_inertia_of), [THETA]),
    "inertial_parameters_of": Case(same(sysid.parameters.inertial_parameters_of), [PSEUDO]),
    "nearest_pseudo_inertia": Case(same(sysid.parameters.nearest_pseudo_inertia), [PSEUDO]),
    "with_inertial_parameters": Case(
        on(
            arm,
            lambda m, t: (
                sysid.parameters.with_inertial_parameters(
                    m, jnp.stack([sysid.parameters.log_cholesky.log_cholesky_parameters(t)] * 2)
                ).bodies
            ),
        ),
        [THETA],
    ),
    "parameter_values": Case(heavier(sysid.torque.parameter_values), [MASSES]),
    "regressor, samples": Case(
        on(arm, lambda m, q, v, a: sysid.torque.regressor(m, q, v, a)), LONG
    ),
    "log_determinant_divergence": Case(
        same(sysid.parameters.log_determinant_divergence), [PSEUDO, PSEUDO[::-1]]
    ),
}

# ---------------------------------------------------------------- stability

STABILITY = {
    "state_matrix": Case(on(arm, lambda m, q, v: stability.state_matrix(m, state(q, v))), TWO[:2]),
    "to_canonical": Case(on(arm, lambda m, q, v: stability.to_canonical(m, state(q, v))), TWO[:2]),
    "from_canonical": Case(on(arm, lambda m, q, p: stability.from_canonical(m, (q, p))), TWO[:2]),
}
