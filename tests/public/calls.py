"""Valid calls of public functions, by room: arguments by name.

Bad arguments are made from them: `tests/public/test_bad_calls.py`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax import body, constraints, estimation, planning, rotations, spatial, stability, wheeled
from rbjax.planning import Controls, Footprint, Limits, OccupancyGrid, Path
from rbjax.rotations import se3, so3
from rbjax.spatial import shapes
from tests.body import test_composes as of_bodies
from tests.public import room_calls, term_calls, tool_calls
from tests.rotations import test_public as of_rotations

Calls = dict[str, dict[str, Any]]

X, Y = np.array([0.3, -0.2, 0.5, 0.1, 0.4, -0.6]), np.array([0.1, 0.2, -0.3, 0.7, -0.5, 0.2])
S, D = np.array([0.2, -0.4, 0.3]), np.array([1.0, 1.1, 0.9])
T, R = np.asarray(se3.exp(X)), np.asarray(so3.exp(S))
INERTIA = np.diag([1.0, 1.2, 0.9])
MATRIX = np.asarray(spatial.spatial_inertia(2.0, S, INERTIA))
PSEUDO = np.asarray(spatial.pseudo_inertia(2.0, 0.1 * S, INERTIA))
BOX = shapes.box([1.0, 2.0, 3.0], mass=2.0)


def of_rotation(name: str) -> dict[str, Any]:
    """The first sample of a case of tests/rotations, by the names of the function's arguments."""
    import inspect

    names = inspect.signature(of_rotations.public()[name]).parameters
    return dict(zip(names, (x[0] for x in of_rotations.CASES[name]), strict=False))


ROTATIONS: Calls = {f"rotations.{name}": of_rotation(name) for name in of_rotations.CASES}
ROTATIONS |= {
    "rotations.convert": {
        "x": np.array([0.8, 0.2, 0.4, 0.4]), "source": "unit_quaternion", "target": "mrp",
    },
}  # fmt: skip

SPATIAL: Calls = {
    "central_axis": {"F": X},
    "check_mass_properties": {"mass": 2.0, "com": S, "inertia": INERTIA},
    "consistency": {"mass": 2.0, "inertia": INERTIA},
    "ellipsoid_margin": {
        "mass": 2.0, "com": S, "inertia": INERTIA, "semi_axes": 2 * D, "centre": S,
    },
    "extended_cross": {"omega": S},
    "extended_rotation": {"R": R},
    "extended_translation": {"p": S},
    "force_at": {"f": S, "point": D},
    "force_cross": {"V": X, "f": Y},
    "force_cross_matrix": {"V": X},
    "force_transform": {"T": T},
    "from_pseudo_inertia": {"P": PSEUDO},
    "kinetic_energy": {"matrix": MATRIX, "V": X},
    "mass_properties": {"matrix": MATRIX},
    "merge_wrenches": {"wrenches": np.stack([X, Y]), "points": np.stack([S, D]), "about": S},
    "momentum": {"matrix": MATRIX, "V": X},
    "motion_cross": {"V": X, "m": Y},
    "motion_cross_matrix": {"V": X},
    "motion_transform": {"T": T},
    "transform_properties": {"T": T, "mass": 2.0, "com": S, "inertia": INERTIA},
    "parallel_axes": {"inertia": INERTIA, "mass": 2.0, "offset": S},
    "power": {"F": X, "V": Y},
    "principal_axes": {"inertia": INERTIA},
    "pseudo_inertia": {"mass": 2.0, "com": S, "inertia": INERTIA},
    "rotate_inertia": {"R": R, "inertia": INERTIA},
    "spatial_inertia": {"mass": 2.0, "com": S, "inertia": INERTIA},
    "transform_force": {"T": T, "F": X},
    "transform_inertia": {"T": T, "matrix": MATRIX},
    "transform_motion": {"T": T, "V": X},
    "twist_at": {"V": X, "point": S},
    "wrench_at": {"F": X, "point": S},
    "shapes.box": {"size": D, "mass": 2.0},
    "shapes.capsule": {"radius": 0.2, "length": 1.0, "mass": 2.0},
    "shapes.combine": {"parts": [BOX, BOX]},
    "shapes.cone": {"radius": 0.2, "height": 1.0, "density": 2.0},
    "shapes.cylinder": {"radius": 0.2, "length": 1.0, "density": 2.0},
    "shapes.ellipsoid": {"semi_axes": D, "mass": 2.0},
    "shapes.hole": {"part": BOX},
    "shapes.mesh": {
        "vertices": np.concatenate([np.zeros((1, 3)), np.eye(3)]),
        "triangles": of_bodies.TETRAHEDRON, "density": 2.0,
    },
    "shapes.plate": {"size": D[:2], "mass": 2.0},
    "shapes.points": {"positions": np.stack([S, D]), "masses": D[:2]},
    "shapes.rod": {"length": 1.0, "mass": 2.0},
    "shapes.sphere": {"radius": 1.0, "mass": 2.0},
    "shapes.tube": {"outer": 1.0, "inner": 0.8, "length": 2.0, "mass": 2.0},
}  # fmt: skip

SITUATION = body.Situation(of_bodies.BODY, of_bodies.FORCES)
FRAME = of_bodies.frame(jnp.asarray(X))
BODY: Calls = {
    "ellipsoid_added_mass": {"semi_axes": D, "density": 2.0},
    "formulation": {"name": "kirchhoff"},
    "inertia_matrix": {"body": of_bodies.BODY},
    "kinetic_energy": {"body": of_bodies.BODY, "V": X},
    "potential_energy": {"situation": SITUATION, "T": T},
    "rigid_body": {"properties": BOX, "forces": of_bodies.FORCES},
    "total_wrench": {"situation": SITUATION, "t": 0.0, "T": T, "V": X},
    "Spring": {"stiffness": 2.0, "anchor": S, "point": D, "rest_length": 0.3},
    "Damper": {"damping": 2.0, "anchor": S, "point": D},
    "Buoyancy": {"density": 2.0, "volume": 0.3, "centre": S},
    "CentralGravity": {"mu": 2.0, "centre": S},
    "UniformGravity": {"acceleration": S},
    "LinearDrag": {"coefficients": np.diag(X)},
    "QuadraticDrag": {"coefficients": X},
    "lagrange.mass_matrix": {"system": of_bodies.SYSTEM, "q": S[:2]},
    "lagrange.acceleration": {
        "system": of_bodies.SYSTEM, "q": S[:2], "v": D[:2], "Q": S[:2],
    },
    "relative_motion.velocity": {"frame": FRAME, "r": S, "rd": D},
    "relative_motion.compose": {"outer": FRAME, "inner": FRAME},
}  # fmt: skip

ROBOT = wheeled.kinds()["differential_drive"].make()
VEHICLE = wheeled.at(ROBOT, "reduced")
STATE = wheeled.start(VEHICLE)
SLIPPING = wheeled.at(ROBOT, "slipping", tyre=wheeled.Fiala(12.0, 0.8))
PATH = np.stack([np.linspace(1, 4, 6), np.linspace(1, 2, 6) ** 2, np.linspace(0.4, 0.9, 6)], -1)
ONE = np.zeros(3)
WHEELED: Calls = {
    "at": {"robot": ROBOT, "fidelity": "reduced"},
    "commands": {"robot": ROBOT, "twist": np.array([0.5, 0.0, 0.1])},
    "contacts": {
        "model": SLIPPING, "state": wheeled.start(SLIPPING), "ctrl": np.zeros(2),
    },
    "controlled": {"model": VEHICLE, "integrator": "rk4", "parts": 1},
    "full_model": {"robot": ROBOT, "base": "planar"},
    "full_model_state": {"model": VEHICLE, "state": STATE, "ctrl": np.zeros(2)},
    "mean_twists": {"t": np.arange(3.0), "poses": PATH[:3]},
    "odometry": {"robot": ROBOT, "t": np.arange(3.0), "angles": np.zeros((3, 2)), "pose": ONE},
    "pure_pursuit": {"path": PATH, "pose": PATH[0], "speed": 0.5, "lookahead": 1.0},
    "rates": {"model": VEHICLE, "state": STATE, "ctrl": np.zeros(2)},
    "reduced": {"model": VEHICLE, "state": STATE, "ctrl": np.zeros(2)},
    "undetermined": {"model": VEHICLE, "state": STATE, "ctrl": np.zeros(2)},
    "rolled_twists": {"robot": ROBOT, "rates": np.ones(2)},
    "rollout": {
        "model": VEHICLE, "state": STATE, "ctrl": np.zeros((3, 2)), "dt": 0.01,
        "integrator": "rk4", "save_every": 1,
    },
    "simulate": {
        "model": VEHICLE, "state": STATE, "ts": np.array([0.0, 0.1]), "ctrl": np.zeros(2),
        "max_steps": 100,
    },
    "stanley": {
        "path": PATH, "pose": PATH[0], "speed": 0.5, "wheelbase": 0.4, "gain": 1.0, "soft": 0.5,
    },
    "start": {"model": VEHICLE, "pose": ONE, "twist": ONE},
    "tracking_gains": {
        "model": VEHICLE, "states": rb.State(jnp.zeros((3, STATE.q.size)), jnp.zeros((3, 2))),
        "ctrl": np.zeros((2, 2)), "dt": 0.1, "Q": np.ones(STATE.q.size + 2), "R": np.ones(2),
    },
    "with_trailers": {"robot": ROBOT, "number": 1, "hitch": 0.0, "drawbar": 1.0, "track": 0.5,
                      "radius": 0.1, "mass": 20.0, "inertia": 1.0},
    "write_mjcf": {"robot": ROBOT, "wheel": "ellipsoid", "width": 0.25, "friction": 1.0},
    "Coulomb": {"friction": 0.8, "width": 0.02, "smooth_speed": 0.05},
    "DCMotor": {"resistance": 2.0, "torque_constant": 0.05, "gear": 20.0, "battery": 24.0,
                "friction": 0.01, "rotor_inertia": 1e-4},
    "Fiala": {"stiffness": 12.0, "friction": 0.8, "smooth_speed": 0.05},
    "HeadingSlip": {"coefficients": np.zeros((3, 4)), "arm": 0.2, "speed": 0.1, "harmonics": 1},
    "Linear": {"stiffness": 12.0, "friction": 0.8},
    "Pacejka": {"stiffness_factor": 10.0, "shape": 1.6, "peak": 1.0, "curvature": 0.5},
    "Relaxing": {"law": wheeled.Fiala(12.0, 0.8), "length": 0.3, "damping_time": 0.01},
    "RollingResistance": {"coefficient": 0.01, "smooth_speed": 0.05},
    "SpeedServo": {"gain": 0.5, "limit": 2.0},
    "TMeasy": {"slope": 25.0, "peak_slip": 0.1, "peak": 1.0, "sliding_slip": 0.4, "sliding": 0.8},
    "Wheel": {"position": np.zeros(2), "heading": 0.0, "radius": 0.1, "inertia": 0.01, "mass": 1.0},
    "Drive": {"wheels": (0,)},
    "Steering": {"wheels": (0,), "lag": 0.2},
    "Body": {"mass": 1.0, "inertia": 0.1, "com": np.zeros(2), "height": 0.2},
    "car": {"wheelbase": 1.0, "track": 0.6, "radius": 0.2},
    "differential_drive": {"track": 0.4, "radius": 0.1, "mass": 5.0},
}  # fmt: skip

GRID = OccupancyGrid(np.zeros((20, 20), bool), 0.2)
FIELD, DISC = GRID.distance_field(), Footprint.disc(0.2)
START, GOAL = np.array([1.0, 1.0, 0.0]), np.array([2.6, 2.0, 0.0])
CAR = Controls.car(0.5, np.deg2rad(20.0), reversal=2)
DRIVEN = Path(START, [[1.0, 0.0, 0.5], [0.5, 0.0, 0.5]])
SEARCH = {"grid": GRID, "footprint": DISC, "start": START, "goal": GOAL, "controls": CAR,
          "headings": 36, "max_count": 2000}  # fmt: skip
PLANNING: Calls = {
    "plan": {"grid": GRID, "footprint": DISC, "start": START, "goal": GOAL, "drive": "car",
             "radius": 0.5, "method": "hybrid_a_star", "backwards": True},
    "dubins": {"start": START, "goal": GOAL, "radius": 0.5},
    "reeds_shepp": {"start": START, "goal": GOAL, "radius": 0.5},
    "OccupancyGrid": {"occupied": np.zeros((5, 5), bool), "resolution": 0.2, "origin": (0.0, 0.0)},
    "Footprint": {"centers": np.zeros((2, 2)), "radii": D[:2]},
    "clear": {"field": FIELD, "poses": PATH, "footprint": DISC},
    "clear_along": {"field": FIELD, "path": DRIVEN, "footprint": DISC, "parts": 2},
    "clearance": {"field": FIELD, "poses": PATH, "footprint": DISC},
    "Controls": {"speeds": np.ones(3), "turn_rates": S, "dt": 0.1, "reversal": 0, "steering": 0},
    "grid_a_star": {**SEARCH, "tolerance": (0.3, 0.5), "weight": 1.0},
    "grid_dijkstra": {**SEARCH, "tolerance": (0.3, 0.5)},
    "hybrid_a_star": {**SEARCH, "weight": 1.0, "cell": 0.2, "max_count": 50},
    "Path.split": {"spacing": 0.1},
    "Footprint.disc": {"radius": 0.2},
    "Footprint.rectangle": {"ahead": 0.3, "behind": 0.2, "width": 0.3, "discs": 2},
    "Controls.car": {"radius": 0.5, "turn": 0.2, "speed": 1.0},
    "smooth": {"path": DRIVEN, "field": FIELD, "footprint": DISC, "radius": 0.5, "iterations": 2,
               "parts": 2},
    "Limits": {"torque": 1.0, "speed": 2.0, "turn_rate": 1.0, "steering_rate": 1.0},
    "Path": {"start": START, "steps": np.array([[1.0, 0.0, 0.5]])},
    "time_scaling": {"model": VEHICLE, "path": DRIVEN, "limits": Limits(torque=1.0, speed=2.0)},
    "refine": {"model": VEHICLE, "path": DRIVEN, "limits": Limits(torque=1.0, speed=2.0),
               "intervals": 6, "iterations": 1, "parts": 1},
}  # fmt: skip

LOOP_Q, LOOP_V = np.array([0.6, -0.8]), np.array([0.8, 0.6])


def loop() -> rb.Model:
    from benchmarks.cases.mechanisms import pendulum

    return pendulum()


LOOP = loop()
HELD = {"model": LOOP, "state": rb.State(jnp.asarray(LOOP_Q), jnp.asarray(LOOP_V))}
PLACES = {"a": constraints.Place(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])),
          "b": constraints.Place(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), body=0)}  # fmt: skip
ARM = rb.load("double_pendulum")
ELBOW = {"model": ARM, "a": None, "b": "lower", "point": np.zeros(3)}


def residual_of(kind: Callable) -> Callable:
    """A function: fields of a coupling of two joints -> the residual of the arm with it."""

    def found(**fields: Any) -> Any:
        coupling = kind(joint="elbow", driver="shoulder", **fields)
        return constraints.residual(ARM.with_constraints(coupling), ARM.default_state())

    return found


CONSTRAINTS: Calls = {
    "residual of Gear": {"ratio": 2.0},
    "residual of JointPolynomial": {"coefficients": S},
    "Projection": {"iterations": 2},
    "TangentSpace": {"iterations": 2},
    "IndependentCoordinates": {"iterations": 2},
    "Spherical.between": ELBOW,
    "Revolute.between": {**ELBOW, "axis": np.array([0.0, 1.0, 0.0])},
    "Distance.between": {**ELBOW, "other": np.array([1.0, 0.0, 0.0]), "length": 1.0},
    "assemble": {**HELD, "t": 0.0, "tolerance": 1e-8},
    "constrained_dynamics": {"model": LOOP, "q": LOOP_Q, "v": LOOP_V, "tau": np.zeros(2), "t": 0.0},
    "jacobian": {"model": LOOP, "q": LOOP_Q, "t": 0.0},
    "joint_wrenches": {**HELD, "t": 0.0},
    "mobility": {"model": LOOP, "q": LOOP_Q, "t": 0.0, "tolerance": 1e-8},
    "multipliers": {**HELD, "t": 0.0},
    "residual": {**HELD, "t": 0.0},
    "places": {"model": rb.load("cart_pole"), "a": None, "b": "pole", "point": S, "axis": D},
    "AugmentedLagrangian": {"alpha": 1000.0, "iterations": 10},
    "Baumgarte": {"alpha": 20.0, "beta": 20.0},
    "Penalty": {"stiffness": 1e6, "damping": 1e3},
    "Distance": {**PLACES, "length": 1.0},
    "Gear": {"joint": "a", "driver": "b", "ratio": 2.0},
    "JointPolynomial": {"joint": "a", "driver": "b", "coefficients": S},
    "Rack": {"joint": "a", "driver": "b", "radius": 2.0},
    "RollingDisc": {**PLACES, "radius": 1.0},
    "RollingSphere": {**PLACES, "radius": 1.0},
    "Screw": {**PLACES, "pitch": 1.0},
    "TendonPolynomial": {"tendon": "a", "driver": "b", "coefficients": S},
    "Weld": PLACES,
    "Revolute": PLACES,
    "Place": {"position": S, "orientation": np.array([1.0, 0.0, 0.0, 0.0]), "body": "pole"},
}  # fmt: skip

PENDULUM = rb.load("pendulum")
REST = PENDULUM.default_state()
MOVING = {"model": PENDULUM, "state": REST, "ctrl": np.zeros(PENDULUM.nu)}
EULER = stability.stability_function("euler")
SERIES = np.linspace(0, 1, 40), np.sin(np.linspace(0, 9, 40))
STABILITY: Calls = {
    "linear_analysis": {"solver": "rk4"},
    "stability_function": {"solver": "rk4"},
    "characteristic": {"solver": "bdf2"},
    "multistep": {"rho": [-1, 1], "sigma": [1, 0]},
    "adams": {"order": 2, "implicit": True},
    "backward_differentiation": {"order": 2},
    "pece": {"order": 2},
    "alpha_degrees": {"method": EULER},
    "imaginary_limit": {"method": EULER},
    "real_limit": {"method": EULER},
    "stability_region": {"method": EULER, "x": S, "y": S},
    "stiff_stability": {"method": EULER},
    "order_by_conditions": {"solver": "rk4"},
    "growth_factors": {"solver": "rk4", "z": np.array([-0.5])},
    "oscillator_factors": {"solver": "rk4", "h_omega": np.array([0.5]), "damping_ratio": 0.1},
    "spectral_radius": {"solver": "rk4", "h_omega": np.array([0.5]), "damping_ratio": 0.1},
    "dissipation": {"solver": "rk4", "h_omega": np.array([0.5])},
    "period_elongation": {"solver": "rk4", "h_omega": np.array([0.5])},
    "state_matrix": MOVING,
    "motion_matrices": {
        "model": PENDULUM, "states": rb.State(jnp.zeros((3, 1)), jnp.zeros((3, 1))),
    },
    "equilibrium": {**MOVING, "steps": 5},
    "reduced_linearisation": MOVING,
    "stable_step": {"method": EULER, "matrices": -np.eye(2)},
    "trend": {"ts": SERIES[0], "xs": SERIES[1]},
    "lyapunov": {"system": PENDULUM, "y0": REST, "dt": 0.01, "steps": 20, "every": 1,
                 "transient": 0.1},
    "gradient_growth": {"system": PENDULUM, "y0": REST, "dt": 0.01, "steps": 20, "samples": 4},
    "drift": {"system": PENDULUM, "y0": REST, "solver": "rk4", "dt": 0.01, "steps": 20,
              "samples": 4},
    "to_canonical": {"model": PENDULUM, "state": REST},
    "from_canonical": {"model": PENDULUM, "y": (np.zeros(1), np.zeros(1))},
    "verdict": {"ts": SERIES[0], "xs": SERIES[1]},
}  # fmt: skip

SOLVERS: Calls = {
    "gauss_legendre": {"stages": 2}, "radau_iia": {"stages": 2}, "lobatto_iiia": {"stages": 2},
    "lobatto_iiic": {"stages": 2}, "adams_bashforth": {"order": 2}, "adams_moulton": {"order": 2},
    "pece": {"order": 2}, "bdf": {"order": 2}, "rkmk": {"order": 2},
    "newmark": {"beta": 0.25, "gamma": 0.5}, "hht_alpha": {"alpha": -0.1},
    "generalized_alpha": {"rho_inf": 0.9}, "Compensated": {"solver": rb.solvers.RK4()},
    "Splitting": {"kicks": (0.5, 0.5), "drifts": (1.0, 0.0), "formula_order": 2},
}  # fmt: skip

WALK = estimation.StateSpace.of(lambda x, u, w: x + w, lambda x: x)
ESTIMATE = estimation.Estimate(jnp.zeros(1), jnp.ones((1, 1)))
ESTIMATION: Calls = {
    "kalman_filter": {
        "space": WALK, "start": np.zeros(1), "covariance": np.ones(1), "inputs": np.zeros(2),
        "readings": np.arange(1.0, 4.0)[:, None], "process": np.ones(1), "noise": np.ones(1),
    },
    "kalman_update": {
        "space": WALK, "estimate": ESTIMATE, "reading": np.ones(1), "noise": np.ones(1),
    },
    "kalman_predict": {
        "space": WALK, "estimate": ESTIMATE, "process": np.ones(1), "given": 0.0,
    },
}  # fmt: skip

LOADING: Calls = {
    "load": {"source": "pendulum", "strict": False, "limits": False},
    "compile_model": {"source": "pendulum"},
    "write_back": {"model": rb.load("pendulum"), "source": "pendulum"},
    "write_mjcf": {"model": rb.load("pendulum"), "strict": False},
}


def axis() -> Any:
    from matplotlib.figure import Figure

    return Figure().add_subplot()


SHOWN = rb.Trajectory if hasattr(rb, "Trajectory") else None
PLOTTING: Calls = {
    "draw": {"model": PENDULUM, "q": np.zeros(1), "ax": axis()},
    "draw_solids": {"ax": axis(), "shapes": rb.plotting.solids("pendulum"), "R": np.eye(3)[None],
                    "p": np.zeros((1, 3)), "alpha": 1.0},
    "poses": {"model": PENDULUM, "q": np.zeros((2, 1))},
    "skeleton": {"model": PENDULUM},
    "solids": {"source": "pendulum"},
    "strobe": {"ax": axis(), "source": None, "model": PENDULUM, "q": np.zeros((2, 1))},
    "time_plot": {"ax": [axis(), axis()], "ts": np.arange(3.0), "q": np.zeros((3, 2)),
                  "v": np.zeros((3, 2)), "names": ["hip", "knee"]},
    "top_view": {"ax": axis(), "model": VEHICLE, "robots": 2,
                 "trajectory": wheeled.rollout(VEHICLE, STATE, np.zeros((3, 2)), 0.01)},
}  # fmt: skip

ROOMS: dict[str, tuple[Any, Calls]] = (
    {
        "rotations": (rotations, {n.removeprefix("rotations."): c for n, c in ROTATIONS.items()}),
        "spatial": (spatial, SPATIAL),
        "body": (body, BODY),
        "wheeled": (wheeled, WHEELED),
        "planning": (planning, PLANNING),
        "constraints": (constraints, CONSTRAINTS),
        "stability": (stability, STABILITY),
        "solvers": (rb.solvers, SOLVERS),
        "estimation": (estimation, ESTIMATION),
        "loading": (rb.loading, LOADING),
        "plotting": (rb.plotting, PLOTTING | tool_calls.PLOTTING),
    }
    | room_calls.ROOMS
    | tool_calls.ROOMS
    | term_calls.ROOMS
)

#: functions that are not names of their room
OTHERS: dict[str, Callable] = room_calls.OTHERS | tool_calls.OTHERS | term_calls.OTHERS | {
    "planning.Path.split": DRIVEN.split,
    "wheeled.car": wheeled.kinds()["car"].make,
    "wheeled.differential_drive": wheeled.kinds()["differential_drive"].make,
} | {
    f"constraints.residual of {name}": residual_of(getattr(constraints, name))
    for name in ("Gear", "JointPolynomial")
}  # fmt: skip


def function_of(room: str, name: str) -> Callable:
    """The function of a call."""
    found = OTHERS.get(f"{room}.{name}")
    return found or functools.reduce(getattr, name.split("."), ROOMS[room][0])
