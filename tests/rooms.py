"""Good calls of planning, wheeled, constraints, stability and solvers, whose arguments a test makes
bad one at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax import constraints as rc
from rbjax import estimation, planning, solvers, stability, wheeled

Room = dict[str, tuple[Callable, dict[str, Any]]]

LOOP = rb.load("four_bar")
AT = LOOP.default_state()
ARM = rb.load("double_pendulum")
STATE = ARM.default_state()
CAR = wheeled.kinds()["car"].make()
CART = wheeled.kinds()["differential_drive"].make(caster=None)
ON = wheeled.at(CART, "kinematical")
REST = wheeled.start(ON)
HELD = wheeled.at(CART, "constrained")
GRID = planning.OccupancyGrid(np.zeros((20, 20), bool), 0.1)
FIELD, DISC = GRID.distance_field(), planning.Footprint.disc(0.2)
PATH = planning.Path([0.5, 1.0, 0.0], [[0.3, 0.0, 0.0]])
PRIMITIVES = planning.Controls.car(0.5, np.pi / 18)
POSES = [[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]
TIMES, ANGLES = [0.0, 0.1, 0.2], [[0.0, 0.0], [0.1, 0.1], [0.3, 0.3]]

PLANNING: Room = {
    "dubins": (planning.dubins, {"start": [0.0, 0, 0], "goal": [2.0, 1, 0], "radius": 0.5}),
    "reeds_shepp": (
        planning.reeds_shepp, {"start": [0.0, 0, 0], "goal": [2.0, 1, 0], "radius": 0.5},
    ),
    "Path": (planning.Path, {"start": [0.0, 0, 0], "steps": [[0.3, 0, 0]]}),
    "Path.split": (PATH.split, {"spacing": 0.1}),
    "Footprint": (planning.Footprint, {"centers": [[0.0, 0]], "radii": [0.2]}),
    "Footprint.disc": (planning.Footprint.disc, {"radius": 0.2}),
    "Footprint.rectangle": (
        planning.Footprint.rectangle, {"ahead": 0.3, "behind": 0.2, "width": 0.3, "discs": 2},
    ),
    "OccupancyGrid": (
        planning.OccupancyGrid,
        {"occupied": np.zeros((4, 4), bool), "resolution": 0.1, "origin": [0.0, 0.0]},
    ),
    "Limits": (
        planning.Limits,
        {"torque": 1.0, "speed": 2.0, "turn_rate": 1.0, "steering_rate": 1.0, "steering": 0.5},
    ),
    "Controls.car": (planning.Controls.car, {"radius": 0.5, "turn": 0.2, "speed": 1.0}),
    "clear": (planning.clear, {"field": FIELD, "poses": [1.0, 1, 0], "footprint": DISC}),
    "clearance": (planning.clearance, {"field": FIELD, "poses": [1.0, 1, 0], "footprint": DISC}),
    "clear_along": (
        planning.clear_along, {"field": FIELD, "path": PATH, "footprint": DISC, "parts": 2},
    ),
    "hybrid_a_star": (planning.hybrid_a_star, {
        "grid": GRID, "footprint": DISC, "start": [0.5, 1, 0], "goal": [1.5, 1, 0],
        "controls": PRIMITIVES, "headings": 72, "cell": 0.2, "weight": 1.0, "max_count": 50,
    }),
    "grid_a_star": (planning.grid_a_star, {
        "grid": GRID, "footprint": DISC, "start": [0.5, 1, 0], "goal": [1.5, 1, 0],
        "controls": PRIMITIVES, "tolerance": (0.2, 0.3), "headings": 72, "max_count": 50,
    }),
    "plan": (planning.plan, {
        "grid": GRID, "footprint": DISC, "start": [0.5, 1, 0], "goal": [1.5, 1, 0],
        "drive": "car", "radius": 0.5, "max_count": 50, "smoothed": False,
    }),
    "smooth": (planning.smooth, {
        "path": PATH, "field": FIELD, "footprint": DISC, "radius": 0.5, "margin": 0.2,
        "iterations": 1, "parts": 1,
    }),
    "time_scaling": (
        planning.time_scaling,
        {"vehicle": ON, "path": PATH, "limits": planning.Limits(1.0, speed=1.0)},
    ),
}  # fmt: skip

WHEELED: Room = {
    "car": (wheeled.kinds()["car"].make, {"wheelbase": 1.0, "track": 0.6, "radius": 0.2}),
    "differential_drive": (
        wheeled.kinds()["differential_drive"].make, {"track": 0.4, "radius": 0.1, "mass": 5.0},
    ),
    "at": (wheeled.at, {"robot": CART, "fidelity": "kinematical"}),
    "start": (wheeled.start, {"model": ON, "pose": [0.0, 0, 0], "twist": [0.1, 0, 0]}),
    "commands": (wheeled.commands, {"robot": CART, "twist": [0.1, 0, 0.2]}),
    "mean_twists": (wheeled.mean_twists, {"t": TIMES, "poses": POSES}),
    "rolled_twists": (wheeled.rolled_twists, {"robot": CART, "rates": ANGLES}),
    "odometry": (wheeled.odometry, {
        "robot": CART, "t": TIMES, "angles": ANGLES, "pose": [0.0, 0, 0],
    }),
    "pure_pursuit": (wheeled.pure_pursuit, {
        "path": POSES, "pose": [0.1, 0.1, 0], "speed": 1.0, "lookahead": 0.5,
    }),
    "stanley": (wheeled.stanley, {
        "path": POSES, "pose": [0.1, 0.1, 0], "speed": 1.0, "wheelbase": 0.5, "gain": 1.0,
        "soft": 0.5,
    }),
    "reduced": (wheeled.reduced, {"model": ON, "state": REST, "ctrl": [0.1, 0.1]}),
    "undetermined": (wheeled.undetermined, {"model": ON, "state": REST, "ctrl": [0.1, 0.1]}),
    "rates": (wheeled.rates, {"model": ON, "state": REST, "ctrl": [0.1, 0.1]}),
    "contacts": (wheeled.contacts, {
        "model": HELD, "state": wheeled.start(HELD), "ctrl": [0.1, 0.1],
    }),
    "rollout": (wheeled.rollout, {
        "model": ON, "state": REST, "ctrl": [[0.1, 0.1]] * 2, "dt": 0.01, "integrator": "rk4",
        "save_every": 1,
    }),
    "Coulomb": (wheeled.Coulomb, {"friction": 0.5, "width": 0.02, "smooth_speed": 0.05}),
    "DCMotor": (wheeled.DCMotor, {
        "resistance": 1.0, "torque_constant": 0.1, "gear": 10.0, "battery": 12.0, "friction": 0.0,
        "rotor_inertia": 0.0,
    }),
    "Fiala": (wheeled.Fiala, {"stiffness": 10.0, "friction": 0.8, "smooth_speed": 0.05}),
    "Linear": (wheeled.Linear, {"stiffness": 10.0, "friction": 0.8, "smooth_speed": 0.05}),
    "Pacejka": (wheeled.Pacejka, {
        "stiffness_factor": 10.0, "shape": 1.5, "peak": 0.8, "curvature": 0.1,
    }),
    "TMeasy": (wheeled.TMeasy, {
        "slope": 10.0, "peak_slip": 0.2, "peak": 0.9, "sliding_slip": 0.6, "sliding": 0.7,
    }),
    "Relaxing": (wheeled.Relaxing, {"law": wheeled.Fiala(10.0, 0.8), "length": 0.3}),
    "SpeedServo": (wheeled.SpeedServo, {"gain": 2.0, "limit": 5.0}),
    "RollingResistance": (wheeled.RollingResistance, {"coefficient": 0.01, "smooth_speed": 0.05}),
    "with_trailers": (wheeled.with_trailers, {
        "robot": CAR, "number": 1, "hitch": 0.1, "drawbar": 1.0, "track": 0.5, "radius": 0.1,
    }),
    "full_model": (wheeled.full_model, {"robot": CART, "base": "planar"}),
    "Wheel": (wheeled.Wheel, {"position": [0.1, 0.2], "radius": 0.1, "mass": 1.0}),
    "Body": (wheeled.Body, {"mass": 1.0, "inertia": 0.1, "com": [0.0, 0.0], "height": 0.2}),
}  # fmt: skip

ELBOW = {"model": ARM, "a": None, "b": "lower", "point": [0.0, 0, 0]}


def held(kind: Callable, **fields: Any) -> Any:
    """The residual of the arm with a constraint of these fields."""
    return rc.residual(ARM.with_constraints(kind(**fields)), STATE)


def coupled(kind: Callable) -> Callable:
    return lambda **fields: held(kind, **fields)


CONSTRAINTS: Room = {
    "Gear": (coupled(rc.Gear), {"joint": "elbow", "driver": "shoulder", "ratio": 2.0}),
    "JointPolynomial": (coupled(rc.JointPolynomial), {
        "joint": "elbow", "driver": "shoulder", "coefficients": [0.0, 1.0],
    }),
    "Prescribed": (coupled(rc.Prescribed), {"joint": "elbow", "function": jnp.sin}),
    "Holonomic": (coupled(rc.Holonomic), {
        "f": lambda t, q: q[:1], "size": 1,
    }),
    "residual": (rc.residual, {"model": LOOP, "state": AT, "t": 0.0}),
    "jacobian": (rc.jacobian, {"model": LOOP, "q": AT.q, "t": 0.0}),
    "multipliers": (rc.multipliers, {"model": LOOP, "state": AT, "t": 0.0}),
    "joint_wrenches": (rc.joint_wrenches, {"model": LOOP, "state": AT, "t": 0.0}),
    "constrained_dynamics": (
        rc.constrained_dynamics, {"model": LOOP, "q": AT.q, "v": AT.v, "tau": 0 * AT.v, "t": 0.0},
    ),
    "assemble": (rc.assemble, {
        "model": LOOP, "state": AT, "t": 0.0, "pinned": (), "tolerance": 1e-8, "throw": True,
    }),
    "mobility": (rc.mobility, {"model": LOOP, "q": AT.q, "t": 0.0, "tolerance": 1e-7}),
    "Baumgarte": (rc.Baumgarte, {"alpha": 20.0, "beta": 20.0}),
    "Penalty": (rc.Penalty, {"stiffness": 1e6, "damping": 1e3}),
    "AugmentedLagrangian": (rc.AugmentedLagrangian, {"alpha": 1e3, "iterations": 10}),
    "Projection": (rc.Projection, {"iterations": 2}),
    "TangentSpace": (rc.TangentSpace, {"iterations": 2}),
    "Spherical.between": (rc.Spherical.between, ELBOW),
    "Revolute.between": (rc.Revolute.between, {**ELBOW, "axis": [0.0, 1.0, 0.0]}),
    "Distance.between": (rc.Distance.between, {
        "model": ARM, "a": None, "b": "lower", "point": [0.0, 0, 0], "other": [1.0, 0, 0],
        "length": 1.0,
    }),
}  # fmt: skip

STABILITY: Room = {
    "adams": (stability.adams, {"order": 2, "implicit": True}),
    "backward_differentiation": (stability.backward_differentiation, {"order": 2}),
    "pece": (stability.pece, {"order": 2}),
    "multistep": (stability.multistep, {"rho": [1.0, -1.0], "sigma": [0.0, 1.0]}),
    "growth_factors": (stability.growth_factors, {"solver": "rk4", "z": [0.1, 0.2]}),
    "spectral_radius": (
        stability.spectral_radius, {"solver": "newmark", "h_omega": [0.1], "damping_ratio": 0.1},
    ),
    "dissipation": (stability.dissipation, {"solver": "newmark", "h_omega": [0.1]}),
    "period_elongation": (stability.period_elongation, {"solver": "newmark", "h_omega": [0.1]}),
    "real_limit": (stability.real_limit, {"method": stability.stability_function("rk4")}),
    "state_matrix": (stability.state_matrix, {"model": ARM, "state": STATE}),
    "equilibrium": (stability.equilibrium, {"model": ARM, "state": STATE, "steps": 3}),
    "reduced_linearisation": (stability.reduced_linearisation, {"model": LOOP, "state": AT}),
    "stable_step": (stability.stable_step, {
        "method": "rk4", "matrices": np.array([[[0.0, 1.0], [-1.0, -0.1]]]),
    }),
    "trend": (stability.trend, {"ts": np.arange(20.0), "xs": np.arange(20.0)}),
    "verdict": (stability.verdict, {
        "ts": np.arange(5.0), "xs": np.zeros((5, 2)), "reference": np.zeros((5, 2)),
    }),
}  # fmt: skip

SOLVERS: Room = {
    "gauss_legendre": (solvers.gauss_legendre, {"stages": 2}),
    "radau_iia": (solvers.radau_iia, {"stages": 3}),
    "lobatto_iiia": (solvers.lobatto_iiia, {"stages": 3}),
    "adams_bashforth": (solvers.adams_bashforth, {"order": 2}),
    "pece": (solvers.pece, {"order": 2}),
    "bdf": (solvers.bdf, {"order": 2}),
    "rkmk": (solvers.rkmk, {"order": 4}),
    "newmark": (solvers.newmark, {"beta": 0.25, "gamma": 0.5}),
    "hht_alpha": (solvers.hht_alpha, {"alpha": -0.1}),
    "generalized_alpha": (solvers.generalized_alpha, {"rho_inf": 0.9}),
    "Compensated": (solvers.Compensated, {"solver": solvers.RK4()}),
    "Splitting": (
        solvers.Splitting, {"kicks": (0.5, 0.5), "drifts": (1.0, 0.0), "formula_order": 2},
    ),
}  # fmt: skip

WALK = estimation.StateSpace.of(lambda x, u, w: x + w, lambda x: x)
ESTIMATE = estimation.Estimate(jnp.zeros(1), jnp.ones((1, 1)))
ESTIMATION: Room = {
    "kalman_filter": (estimation.kalman_filter, {
        "space": WALK, "start": [0.0], "covariance": [1.0], "inputs": np.zeros(2),
        "readings": [[1.0], [2.0], [3.0]], "process": [1.0], "noise": [1.0],
    }),
    "kalman_update": (estimation.kalman_update, {
        "space": WALK, "estimate": ESTIMATE, "reading": [1.0], "noise": [1.0],
    }),
    "kalman_predict": (estimation.kalman_predict, {
        "space": WALK, "estimate": ESTIMATE, "process": [1.0], "given": 0.0,
    }),
}  # fmt: skip

ROOMS = {
    "planning": PLANNING, "wheeled": WHEELED, "constraints": CONSTRAINTS, "stability": STABILITY,
    "solvers": SOLVERS, "estimation": ESTIMATION,
}  # fmt: skip
