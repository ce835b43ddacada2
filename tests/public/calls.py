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
from rbjax import constraints, estimation, stability, wheeled
from tests.public import planar_calls, room_calls, space_calls, term_calls, tool_calls
from tests.public.planar_calls import STATE, VEHICLE
from tests.public.space_calls import D, S

Calls = dict[str, dict[str, Any]]

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
        "constraints": (constraints, CONSTRAINTS),
        "stability": (stability, STABILITY),
        "solvers": (rb.solvers, SOLVERS),
        "estimation": (estimation, ESTIMATION),
        "loading": (rb.loading, LOADING),
        "plotting": (rb.plotting, PLOTTING | tool_calls.PLOTTING),
    }
    | space_calls.ROOMS
    | planar_calls.ROOMS
    | room_calls.ROOMS
    | tool_calls.ROOMS
    | term_calls.ROOMS
)

#: functions that are not names of their room
OTHERS: dict[str, Callable] = (
    planar_calls.OTHERS
    | room_calls.OTHERS
    | tool_calls.OTHERS
    | term_calls.OTHERS
    | {
        f"constraints.residual of {name}": residual_of(getattr(constraints, name))
        for name in ("Gear", "JointPolynomial")
    }
)


def function_of(room: str, name: str) -> Callable:
    """The function of a call."""
    found = OTHERS.get(f"{room}.{name}")
    return found or functools.reduce(getattr, name.split("."), ROOMS[room][0])
