"""Valid calls of wheeled robots and planning, as in `tests.public.calls`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax import planning, wheeled
from rbjax.planning import Controls, Footprint, Limits, OccupancyGrid, Path
from tests.public.space_calls import D, S

Calls = dict[str, dict[str, Any]]

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
    "LinearTyre": {"stiffness": 12.0, "friction": 0.8},
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
    "plan": {"grid": GRID, "robot": DISC, "start": START, "goal": GOAL, "drive": "car",
             "radius": 0.5, "steering": 0.6, "method": "hybrid_a_star", "backwards": True},
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

ROOMS: dict[str, tuple[Any, Calls]] = {
    "wheeled": (wheeled, WHEELED),
    "planning": (planning, PLANNING),
}
OTHERS: dict[str, Callable] = {
    "planning.Path.split": DRIVEN.split,
    "wheeled.car": wheeled.kinds()["car"].make,
    "wheeled.differential_drive": wheeled.kinds()["differential_drive"].make,
}
