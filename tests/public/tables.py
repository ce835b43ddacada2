"""Cases of every public function of arrays, by room.

`ELSEWHERE` has the other public names: functions that read files, draw, search or print, and what
makes objects. Files of their own test them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.cases.mechanisms import pendulum
from rbjax import constraints, control, planning, rotations, stability, sysid
from tests import test_registry as of_models
from tests.body import test_composes as of_bodies
from tests.public.grid import Case, same
from tests.robots import robot
from tests.rotations import test_public as of_rotations
from tests.wheeled import test_registry as of_wheels

RNG = np.random.default_rng(4)
F64 = (np.float64,)


def positive(n: int, size: int = 3) -> np.ndarray:
    """Positive definite matrices of condition 10 or so."""
    A = RNG.normal(size=(n, size, size))
    return A @ A.swapaxes(1, 2) + size * np.eye(size)


# ---------------------------------------------------------------- models: rb, dynamics, forces


def of_model(entry: of_models.Entry) -> Callable[[Any], Callable]:
    def make(dtype: Any) -> Callable:
        model = robot(entry.robot, "unrolled").model.astype(dtype)
        return lambda *x: entry.function(model, *x, **entry.rest)

    return make


MODELS = {
    name: Case(of_model(entry), of_models.samples(entry.arrays, entry.robot))
    for name, entry in of_models.REGISTRY.items()
}


def of_world(name: str) -> Callable[[Any], Callable]:
    """A frame of the world, which does not move."""

    def make(dtype: Any) -> Callable:
        model = robot("small", "unrolled").model.astype(dtype)
        return lambda *x: getattr(rb, name)(model, *x, body="world")

    return make


def motion(run: Callable) -> Callable[[Any], Callable]:
    def make(dtype: Any) -> Callable:
        model = robot("double_pendulum", "unrolled").model.astype(dtype)
        return lambda q, v, tau: run(model, rb.State(q, v), tau)

    return make


def rolled_out(model, state, tau):
    path = rb.rollout(model, state, None, 0.01, tau=tau)
    return path.q, path.v


def simulated(model, state, tau):
    ts = jnp.array([0.0, 0.02], state.q.dtype)
    path = rb.simulate(model, state, ts, tau=tau[0], dt0=0.01, solver=diffrax.Midpoint())
    return path.q, path.v


SWING = [RNG.normal(size=(3, 2)), RNG.normal(size=(3, 2)), RNG.normal(size=(3, 2, 2))]
MODELS |= {
    f"{name}, world": Case(of_world(name), of_models.samples(arrays))
    for name, arrays in {
        "jacobian": ("q",), "jacobian_rate": ("q", "v"), "frame_velocity": ("q", "v"),
        "frame_bias_acceleration": ("q", "v"),
    }.items()
}  # fmt: skip
MODELS["rollout"] = Case(motion(rolled_out), SWING)
MODELS["simulate"] = Case(motion(simulated), SWING, derivatives=False)


# ---------------------------------------------------------------- spatial, body, rotations

BODIES = {
    f"{room.__name__.rpartition('.')[2]}.{name}": Case(same(f), of_bodies.samples(), dtypes=F64)
    for room, entries in of_bodies.ROOMS.items()
    for name, f in entries.items()
}

Q = RNG.normal(size=(3, 4))
Q /= np.linalg.norm(Q, axis=1, keepdims=True)
ROTATIONS = {
    name: Case(same(of_rotations.public()[name]), xs) for name, xs in of_rotations.CASES.items()
}
ROTATIONS["convert"] = Case(
    same(lambda q: rotations.convert(q, "unit_quaternion", "mrp")), [np.abs(Q)]
)


def there_and_back(representation: Any) -> Callable:
    def found(q):
        R = rotations.quaternion.to_matrix(q)
        return representation.to_matrix(representation.from_matrix(R))

    return found


ROTATIONS |= {
    f"representations: {name}": Case(same(there_and_back(r)), [np.abs(Q)])
    for name, r in rotations.representations().items()
}

# ---------------------------------------------------------------- constraints


@cache
def loop(dtype: Any) -> rb.Model:
    return pendulum().astype(dtype)


def state(q, v):
    return rb.State(q, v)


ANGLE = np.array([0.3, -0.5, 1.1])
ON = np.stack([np.sin(ANGLE), -np.cos(ANGLE)], -1)
ALONG = np.stack([np.cos(ANGLE), np.sin(ANGLE)], -1)
CONSTRAINTS = {
    "jacobian": Case(lambda d: lambda q: constraints.jacobian(loop(d), q), [ON]),
    "residual": Case(
        lambda d: lambda q, v: constraints.residual(loop(d), state(q, v)), [ON, ALONG]
    ),
    "multipliers": Case(
        lambda d: lambda q, v: constraints.multipliers(loop(d), state(q, v)), [ON, ALONG]
    ),
    "constrained_dynamics": Case(
        lambda d: lambda q, v, u: constraints.constrained_dynamics(loop(d), q, v, u),
        [ON, ALONG, RNG.normal(size=(3, 2))],
    ),
    "joint_wrenches": Case(
        lambda d: lambda q, v: constraints.joint_wrenches(loop(d), state(q, v)), [ON, ALONG]
    ),
}

# ---------------------------------------------------------------- wheeled

WHEELED = {name: Case(same(f), xs, dtypes=F64) for name, (f, xs) in of_wheels.REGISTRY.items()}

# ---------------------------------------------------------------- planning

POSES = RNG.uniform(-1, 1, (3, 3))
FAR = POSES + np.array([4.0, 2.0, 0.5])


def curve(name: str) -> Callable:
    def found(start, goal):
        path = getattr(planning, name)(start, goal, jnp.asarray(0.5, start.dtype))
        return path.poses(5)

    return found


def cast(tree: Any, dtype: Any) -> Any:
    """The floating arrays of a record in a dtype."""
    return jax.tree.map(
        lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


@cache
def field(dtype: Any) -> planning.DistanceField:
    cells = np.zeros((30, 30), bool)
    cells[18:24, 5:9] = True
    found = planning.OccupancyGrid(cells, 0.1, [-1.5, -1.5]).distance_field()
    return cast(found, dtype)


DISC = planning.Footprint.disc(0.2)


PLANNING = {name: Case(same(curve(name)), [POSES, FAR]) for name in ("dubins", "reeds_shepp")}
PLANNING["clearance"] = Case(
    lambda d: lambda p: planning.clearance(field(d), p, cast(DISC, d)), [0.5 * POSES]
)

# ---------------------------------------------------------------- control

STABLE = RNG.normal(size=(3, 3, 3)) - 4 * np.eye(3)
INPUT, OUTPUT = RNG.normal(size=(3, 3, 2)), RNG.normal(size=(3, 2, 3))
WEIGHT, SMALL_WEIGHT = positive(3), positive(3, 2)
START = RNG.normal(size=(3, 3))


def linear(A, B, Q, R):
    return control.constant_problem(A, B, Q, R, 4)


def rolled(A, B, Q, R, x):
    problem = linear(A, B, Q, R)
    return control.roll(problem, control.backward(problem), x)


def rolled_in_parallel(A, B, Q, R, x):
    problem = linear(A, B, Q, R)
    return control.parallel_roll(problem, control.parallel_backward(problem), x)


def cost(A, B, Q, R, x):
    problem = linear(A, B, Q, R)
    return control.quadratic_cost(problem, *rolled(A, B, Q, R, x))


LQ = [0.2 * STABLE, INPUT, WEIGHT, SMALL_WEIGHT]
CONTROL = {
    "lqr": Case(same(lambda *x: control.lqr(*x)[:2]), [STABLE, *LQ[1:]]),
    "lqr_finite": Case(same(lambda *x: control.lqr_finite(*x, 4).K), LQ),
    "backward": Case(same(lambda *x: control.backward(linear(*x))[:4]), LQ),
    "constant_problem": Case(same(lambda *x: linear(*x)), LQ),
    "parallel_backward": Case(same(lambda *x: control.parallel_backward(linear(*x))[:4]), LQ),
    "roll": Case(same(rolled), [*LQ, START]),
    "parallel_roll": Case(same(rolled_in_parallel), [*LQ, START]),
    "quadratic_cost": Case(same(cost), [*LQ, START]),
    "lyapunov": Case(same(lambda A, Q: control.lyapunov(A, Q).X), [STABLE, WEIGHT]),
    "controllability_gramian": Case(
        same(lambda A, B: control.controllability_gramian(A, B).X), [STABLE, INPUT]
    ),
    "observability_gramian": Case(
        same(lambda A, C: control.observability_gramian(A, C).X), [STABLE, OUTPUT]
    ),
    "discretise": Case(same(lambda A, B: control.discretise(A, B, 0.1)), [STABLE, INPUT]),
    "kalman_gain": Case(
        same(lambda A, C, W, V: control.kalman_gain(A, C, W, V)[:2]),
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


def estimate(x, P):
    return control.Estimate(x, P)


SPACE = control.StateSpace.of(lambda x, u, w: jnp.sin(x) + u + w, lambda x: x[:2])
SEVEN = [0.5 * RNG.normal(size=(3, 7)) for _ in range(2)]
FOUR, CART_STATE = np.full((3, 4), 1.0), [0.2 * RNG.normal(size=(3, 2)) for _ in range(2)]
ONE = np.full((3, 1), 1.0)


def moved(read: Callable) -> Callable[[Any], Callable]:
    def make(dtype: Any) -> Callable:
        space = control.observed(cart(dtype), lambda state: state.q, 0.01)
        return lambda q, v, u: read(space, rb.State(q, v), u)

    return make


def planned(method: str) -> Callable[[Any], Callable]:
    """The controls of a short plan with a strictly convex cost, which has one optimum."""

    def make(dtype: Any) -> Callable:
        model = cart(dtype)
        goal = control.StateError(model.default_state())
        problem = control.Problem(model, 4, 0.05, running=[goal, control.Control()])
        return lambda q, v: control.solve(problem, rb.State(q, v), method=method).ctrls

    return make


def tracked(dtype: Any) -> Callable:
    def gains(q, v, Q, R):
        states = rb.State(jnp.stack([q] * 3), jnp.stack([v] * 3))
        u = jnp.zeros((2, 1), q.dtype)
        return control.time_varying_lqr(cart(dtype), states, u, 0.01, Q, R).K

    return gains


CONTROL |= {
    "kalman_predict": Case(
        same(
            lambda x, P, u: control.kalman_predict(
                SPACE, estimate(x, P), u, jnp.eye(3, dtype=x.dtype)
            )
        ),
        [START, WEIGHT, START[::-1]],
    ),
    "kalman_update": Case(
        same(lambda x, P, y, V: control.kalman_update(SPACE, estimate(x, P), y, V)),
        [START, WEIGHT, START[:, :2], SMALL_WEIGHT],
    ),
    "observed": Case(
        moved(lambda space, x, u: space.move(x, u, jnp.zeros(4, u.dtype))), [*CART_STATE, ONE]
    ),
    "steer": Case(
        same(lambda A, B, Q, R, x: control.steer(linear(A, B, Q, R), x, 0 * x)[:2]), [*LQ, START]
    ),
    "time_varying_lqr": Case(tracked, [*CART_STATE, FOUR, ONE]),
    "lqr_at": Case(
        lambda d: (
            lambda Q, R: control.lqr_at(cart(d), cart(d).default_state(), jnp.zeros(1, d), Q, R)[:2]
        ),
        [FOUR * np.array([1.0, 2.0, 3.0, 4.0]), ONE],
    ),
    "feedback": Case(
        lambda d: (
            lambda q, v, K: control.feedback(cart(d), cart(d).default_state(), jnp.zeros(1, d), K)(
                0.0, rb.State(q, v)
            )
        ),
        [*CART_STATE, RNG.normal(size=(3, 1, 4))],
    ),
    "allocate": Case(
        lambda d: lambda q, v, u: control.allocate(cart(d), rb.State(q, v), u)[:2],
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
    # in JAX's default dtype, whatever that of the model
    "solve, ddp": Case(planned("ddp"), CART_STATE, dtypes=F64),
    "solve, sqp": Case(planned("sqp"), CART_STATE, dtypes=F64),
}

# ---------------------------------------------------------------- sysid

PSEUDO = positive(3, 4)
THETA = 0.3 * RNG.normal(size=(3, 10))


@cache
def arm(dtype: Any) -> rb.Model:
    return robot("double_pendulum", "unrolled").model.astype(dtype)


TWO = [RNG.normal(size=(3, 2)) for _ in range(3)]
SYSID = {
    "regressor": Case(
        lambda d: lambda q, v, a: sysid.regressor(arm(d), q, v, a, joint_terms=("viscous",)), TWO
    ),
    "energy_regressor": Case(lambda d: lambda q, v: sysid.energy_regressor(arm(d), q, v), TWO[:2]),
    "momentum_regressor": Case(
        lambda d: lambda q, v: sysid.momentum_regressor(arm(d), q, v), TWO[:2]
    ),
    "to_log_cholesky": Case(same(sysid.to_log_cholesky), [PSEUDO]),
    "from_log_cholesky": Case(same(sysid.from_log_cholesky), [THETA]),
    "log_cholesky_parameters": Case(same(sysid.log_cholesky_parameters), [THETA]),
    "log_cholesky_volume": Case(same(sysid.log_cholesky_volume), [THETA]),
    "pseudo_inertia_of": Case(same(sysid.pseudo_inertia_of), [THETA]),
    "inertial_parameters_of": Case(same(sysid.inertial_parameters_of), [PSEUDO]),
    "nearest_pseudo_inertia": Case(same(sysid.nearest_pseudo_inertia), [PSEUDO]),
    "with_inertial_parameters": Case(
        lambda d: (
            lambda t: (
                sysid.with_inertial_parameters(
                    arm(d), jnp.stack([sysid.log_cholesky_parameters(t)] * 2)
                ).bodies
            )
        ),
        [THETA],
    ),
    "model_log_cholesky": Case(
        lambda d: (
            lambda m: sysid.model_log_cholesky(arm(d).replace(bodies=arm(d).bodies.replace(mass=m)))
        ),
        [np.abs(RNG.normal(size=(3, 2))) + 1],
    ),
    "log_determinant_divergence": Case(
        same(sysid.log_determinant_divergence), [PSEUDO, PSEUDO[::-1]]
    ),
    "affine_invariant_distance": Case(
        same(sysid.affine_invariant_distance), [PSEUDO, PSEUDO[::-1]]
    ),
    "pullback_distance": Case(same(sysid.pullback_distance), [PSEUDO, PSEUDO[::-1] + 1]),
    "pullback_metric": Case(
        same(lambda t: sysid.pullback_metric(sysid.log_cholesky_parameters(t))), [THETA]
    ),
    "prior_residual": Case(same(sysid.prior_residual), [THETA, THETA[::-1]]),
}

# ---------------------------------------------------------------- stability

STABILITY = {
    "state_matrix": Case(
        lambda d: lambda q, v: stability.state_matrix(arm(d), state(q, v)), TWO[:2]
    ),
    "to_canonical": Case(
        lambda d: lambda q, v: stability.to_canonical(arm(d), state(q, v)), TWO[:2]
    ),
    "from_canonical": Case(
        lambda d: lambda q, p: stability.from_canonical(arm(d), (q, p)), TWO[:2]
    ),
}

TABLES: dict[str, dict[str, Case]] = {
    "models": MODELS,
    "bodies": BODIES,
    "rotations": ROTATIONS,
    "constraints": CONSTRAINTS,
    "wheeled": WHEELED,
    "planning": PLANNING,
    "control": CONTROL,
    "sysid": SYSID,
    "stability": STABILITY,
}

#: other public functions by room: they read, write, draw, search, make objects or run on the host
ELSEWHERE: dict[str, set[str]] = {
    "rb": {"compile", "compiler_options", "load", "operation_count", "scenes", "threads",
           "write_back", "write_mjcf"},
    "rotations": {"representations"},
    "spatial": set(),
    "body": {"formulation", "formulations"},
    "dynamics": set(),
    "forces": {"on_each"},
    "joints": {"kind", "kinds", "register", "turning"},
    "loading": {"compile_model", "load", "scenes", "write_back", "write_mjcf"},
    # rows are functions of frames: tests/constraints/test_pairs.py and test_rows.py
    "constraints": {"assemble", "coordinate", "cosine", "displacement", "distance", "formulations",
                    "kinds", "mobility", "places", "recommend", "time", "turn"},
    "wheeled": {"at", "controlled", "fidelities", "from_file", "kinds", "recommend", "simulate",
                "with_trailers", "write_mjcf"},
    "planning": {"clear", "clear_along", "drives", "grid_a_star", "grid_dijkstra",
                 "grid_dijkstra_many", "hybrid_a_star", "methods", "plan", "refine", "smooth",
                 "time_scaling"},
    "validation": {"compare"},
}  # fmt: skip
