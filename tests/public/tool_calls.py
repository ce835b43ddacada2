"""Valid calls of plotting, the viewer, adapters, learning, and older functions of all rooms, as in
`tests.public.calls`."""

from __future__ import annotations

import contextlib
import functools
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.cases.mechanisms import pendulum
from rbjax import envs, estimation, kinematics, plotting, stability, sysid, viewer
from rbjax.flexible import modal
from tests.flexible.modal.points import random_points
from tests.public.room_calls import BALL

Calls = dict[str, dict[str, Any]]

FOLDER = Path(tempfile.mkdtemp())
KEY = jax.random.key(0)
PENDULUM, ARM = rb.load("pendulum"), rb.load("double_pendulum")
LOOP = pendulum()
CLOSED = rb.State(jnp.array([0.6, -0.8]), jnp.array([0.8, 0.6]))
REST = PENDULUM.default_state()
STILL = rb.Trajectory(jnp.arange(3.0), jnp.zeros((3, 1)), jnp.zeros((3, 1)), jnp.array(True))
POLE = envs.make("cart_pole_balance", kernel=False)


def axis() -> Any:
    from matplotlib.figure import Figure

    return Figure().add_subplot()


def drawn_axis() -> Any:
    ax = axis()
    ax.plot([0.0, 1.0], [0.0, 2.0])
    return ax


FILM = {"model": PENDULUM, "trajectory": STILL, "source": "pendulum", "fps": 5.0, "samples": 2,
        "follow": False, "tracked": "rod", "title": "a"}  # fmt: skip
PLOTTING: Calls = {
    "animate": FILM | {"path": FOLDER / "a.html", "speed": 1.0, "size": (200, 100),
                       "renderer": "drawing", "trace": "rod", "floating_base": False,
                       "camera": plotting.Camera()},
    "bare": {"ax": drawn_axis(), "margin": 0.05},
    "Camera": {"azimuth": 10.0, "elevation": 20.0},
    "record_policy": {"env": POLE, "seconds": 0.02, "samples": 1, "seed": 0},
    "animate_policy": {"env": POLE, "policy": None, "path": FOLDER / "b.html",
                       "seconds": 0.02, "samples": 1, "seed": 0},
}  # fmt: skip
VIEWER: Calls = {
    "view": FILM | {"host": "127.0.0.1", "port": 8080, "floating_base": False,
                    "camera": plotting.Camera()},
    "motion_of": {"what": "cart_pole_balance", "samples": 1, "seconds": 0.02, "seed": 0},
    "motion_of_policy": {"env": POLE, "policy": None, "samples": 1, "seconds": 0.02, "seed": 0},
}  # fmt: skip
WITH_PARAMS = {"environment": POLE, "params": POLE.default_params}
ADAPTERS: Calls = {
    "to_gymnasium": WITH_PARAMS,
    "to_gymnasium_vector": WITH_PARAMS | {"num_envs": 2, "autoreset": "same_step"},
    "to_gymnasium_functional": WITH_PARAMS,
    "to_gymnax": {"environment": POLE},
    "to_brax": WITH_PARAMS | {"privileged": True},
    "to_rejax": WITH_PARAMS,
    "wrap_brax": {"env": envs.adapters.to_brax(POLE), "episode_length": 10, "action_repeat": 1},
}  # fmt: skip
POLICY = envs.learning.new_policy(POLE, KEY, hidden=(4,))
LEARNING: Calls = {
    "network": {"key": KEY, "sizes": (3, 4, 1), "activation": "tanh", "last": 0.01},
    "new_policy": {"env": POLE, "key": KEY, "hidden": (4,), "activation": "elu", "std": 0.4,
                   "normalise": True},
    "new_critic": {"env": POLE, "key": KEY, "hidden": (4,), "normalise": True},
    "save_policy": {"path": FOLDER / "policy", "policy": POLICY, "task": "cart_pole_balance"},
    "evaluate": {"env": POLE, "policy": POLICY, "key": KEY, "episodes": 1, "noise": False},
    "load_policy": {"path": envs.learning.save_policy(FOLDER / "c", POLICY, "cart_pole_balance")},
}  # fmt: skip

#: bodies, states and matrices
BODY = modal.from_points(
    **random_points(np.random.default_rng(0), 4, 2), stiffness=np.diag([1.0, 2.0]), frames=[0, 3]
)
POINTS = random_points(np.random.default_rng(0), 4, 2)
NODES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
SECTION = modal.BeamSection(EA=1e6, EIy=10.0, EIz=10.0, GJ=5.0, mass=1.0, rotary=(0.1, 0.1, 0.1))
MODAL: Calls = {
    "from_points": POINTS | {"stiffness": np.eye(2), "damping": np.eye(2), "frames": [0, 3],
                             "turn_inertias": False},
    "inertia_invariants": POINTS | {"turn_inertias": False},
    "fast_rotation": {"body": BODY, "omega": np.array([0.0, 0.0, 1.0])},
    "stiffness_in_motion": {"body": BODY, "w": np.array([0.0, 0.0, 1.0]),
                            "acceleration": np.zeros(3), "angular_acceleration": np.zeros(3)},
    "elastic_force": {"body": BODY, "q": np.zeros(2), "qd": np.zeros(2)},
    "write_sid": {"body": BODY, "path": FOLDER / "body.sid"},
    "beam_mesh": {"nodes": np.outer(np.arange(3.0), [1.0, 0, 0]), "section": SECTION},
    "tetrahedral_mesh": {"nodes": NODES, "tetrahedra": np.array([[0, 1, 2, 3]]), "E": 1e9,
                         "poisson": 0.3, "density": 1e3},
    "with_middle_nodes": {"nodes": NODES, "tetrahedra": np.array([[0, 1, 2, 3]])},
    "add_modal_body": {"model": PENDULUM, "name": "blade", "body": BODY, "parent": "rod",
                       "position": np.zeros(3), "orientation": np.array([1.0, 0, 0, 0]),
                       "free": False},
}  # fmt: skip
T = np.arange(40) * 0.01
RUN = sysid.Recording("a", {"q": sysid.Channel(T, np.sin(9 * T))})
PSEUDO = np.asarray(rb.spatial.pseudo_inertia(2.0, np.zeros(3), np.diag([1.0, 1.2, 0.9])))
A2, B2 = np.array([[0.0, 1.0], [-1.0, -0.5]]), np.array([[0.0], [1.0]])
WALK = estimation.StateSpace.of(lambda x, u, w: x + w, lambda x: x)
FILTERED = estimation.kalman_filter(
    WALK, np.zeros(1), np.ones(1), np.zeros(2), np.arange(1.0, 4.0)[:, None], np.ones(1),
    np.ones(1)
)  # fmt: skip
OLDER: Calls = {
    "kinematics.inverse_kinematics": {"model": ARM, "target": np.array([1.0, 0.0, 0.5]),
                                      "body": "lower", "seeds": 2, "iterations": 5,
                                      "tolerance": 1e-6, "limits": True, "side_by_side": 1},
    "kinematics.Goal": {"body": "lower", "position": np.zeros(3), "weight": 1.0},
    "kinematics.differential_inverse_kinematics": {
        "model": ARM, "q": np.zeros(2), "goals": kinematics.Goal(body="lower",
                                                                 position=np.zeros(3)),
        "rate": 1.0, "speed": 2.0, "damping": 1e-6, "dt": 0.01},
    "estimation.kalman_smoother": {"space": WALK, "filtered": FILTERED},
    "estimation.model_state_space": {"model": PENDULUM, "read": lambda s: s.q, "dt": 0.01,
                                     "integrator": "rk4"},
    "stability.measured_order": {"solver": "rk4"},
    "stability.measured_stable_step": {"method": rb.solvers.RK4(), "model": PENDULUM,
                                       "state": REST, "near": 0.1, "steps": 20},
    "stability.limit_cycle": {"return_map": lambda x: 0.5 * x, "guess": np.ones(1),
                              "tolerance": 1e-9, "max_steps": 20, "throw": True},
    "stability.plot_regions": {"methods": {"a": stability.stability_function("euler")},
                               "window": (-3.0, 1.0, -2.0, 2.0), "points": 11, "ax": axis()},
    "stability.plot_spectral_radius": {"methods": {"a": stability.stability_function("euler")},
                                       "h_omega": np.linspace(0.1, 2, 5), "ax": axis()},
    "loading.save_trajectory": {"path": FOLDER / "a.npz", "model": PENDULUM,
                                "trajectory": STILL, "source": "pendulum"},
    "loading.load_trajectory": {"path": FOLDER / "a.npz"},
    "loading.ModelBuilder": {"gravity": np.zeros(3), "timestep": 0.01},
    "solvers.Tableau": {"a": ((0.0,),), "b": (1.0,), "order": 1},
    "solvers.BDF": {"formula_order": 2, "root_find_max_steps": 10},
    "solvers.Adams": {"formula_order": 2, "corrector": "none"},
    "solvers.integrate_until": {"vector_field": lambda t, y, args: jnp.ones(1),
                                "guard": lambda t, y, args: y[0] - 0.5,
                                "t1": 1.0, "t0": 0.0, "max_steps": 64, "tolerance": 1e-6},
    "tendon_lengths": {"model": PENDULUM, "q": np.zeros(1)},
    "rotations.quaternion.random": {"key": KEY, "shape": (2,)},
    "rotations.so3.random": {"key": KEY, "shape": (2,)},
    "sysid.parameters.from_log_cholesky": {"theta": np.zeros(10)},
    "sysid.parameters.to_log_cholesky": {"P": PSEUDO},
    "sysid.parameters.nearest_pseudo_inertia": {"P": PSEUDO, "margin": 1e-6},
    "sysid.parameters.log_determinant_divergence": {"P": PSEUDO, "Q": PSEUDO},
    "sysid.findings": {"recording": RUN},
    "sysid.data.low_pass": {"t": T, "x": np.sin(T), "cutoff": 10.0, "derivative": 1, "order": 4},
    "sysid.data.in_si": {"unit": "deg"},
    "sysid.statistics.whiteness": {"residual": np.sin(T), "lags": 5},
    "sysid.torque.parameter_values": {"model": PENDULUM, "joint_terms": ("viscous",)},
    "sysid.torque.regressor": {"model": PENDULUM, "q": np.zeros(1), "v": np.zeros(1),
                               "a": np.zeros(1), "smoothing": 0.0},
    "sysid.Channel": {"t": T, "values": np.sin(T), "unit": "rad", "scale": 1.0, "sign": 1,
                      "noise": 0.1},
    "sysid.Recording": {"name": "a", "channels": {"q": RUN["q"]}},
    "control.linear.poles": {"A": A2, "B": B2, "K": np.ones((1, 2))},
    "control.linear.margins": {"A": A2, "B": B2, "K": np.ones((1, 2)), "frequencies": 100},
    "control.linear.controllability": {"A": A2, "B": B2, "tolerance": 1e-9},
    "control.linear.observability": {"A": A2, "C": B2.T, "tolerance": 1e-9},
    "control.linear.discretise": {"A": A2, "B": B2, "dt": 0.1},
    "control.linear.kalman_gain": {"A": A2, "C": B2.T, "W": np.eye(2), "V": np.eye(1),
                                   "discrete": False},
    "control.linear.lqr": {"A": A2, "B": B2, "Q": np.eye(2), "R": np.eye(1), "discrete": False},
    "control.laws.allocate": {"model": ARM, "state": ARM.default_state(), "tau": np.zeros(2)},
    "flexible.section_names": {"model": PENDULUM},
    "flexible.elastic_names": {"model": PENDULUM},
    "flexible.elastic_parameters": {"model": PENDULUM},
    "validation.compare": {"source": "pendulum", "states": 1, "seed": 0, "mjx": False,
                           "seconds": 0.01, "gradient": False, "contacts": False},
    "recommend.contact_law": {"model": BALL, "state": BALL.default_state(), "accuracy": 1e-3,
                              "horizon": 0.1, "dt": 0.01, "restitution": 0.0, "progress": False},
    "recommend.solver": {"model": PENDULUM, "state": REST, "accuracy": 1e-3, "horizon": 0.1,
                         "progress": False},
    "recommend.formulation": {"model": LOOP, "state": CLOSED, "accuracy": 1e-3,
                              "horizon": 0.1, "dt": 0.01,
                              "integrator": "rk4", "progress": False},
    "planning.grid_dijkstra_many": {
        "grid": rb.planning.OccupancyGrid(np.zeros((8, 8), bool), 0.2),
        "footprint": rb.planning.Footprint.disc(0.1), "starts": np.array([[0.5, 0.5, 0.0]]),
        "goals": np.array([[1.0, 0.5, 0.0]]), "controls": rb.planning.Controls.car(0.5, np.pi / 6),
        "tolerance": (0.3, 0.5), "headings": 12, "max_count": 100},
}  # fmt: skip

ROOMS: dict[str, tuple[Any, Calls]] = {
    "viewer": (viewer, VIEWER),
    "envs.adapters": (envs.adapters, ADAPTERS),
    "envs.learning": (envs.learning, LEARNING),
    "flexible.modal": (modal, MODAL),
    "older": (rb, OLDER),
}


def view(**given: Any) -> None:
    """`viewer.view` without a server: an accepted call ends where it would import viser."""
    with mock.patch.dict(sys.modules, {"viser": None}), contextlib.suppress(rb.MissingPackage):
        viewer.view(**given)


OTHERS: dict[str, Callable] = {
    "viewer.view": view,
    "older.solvers.integrate_until": functools.partial(rb.solvers.integrate_until, y0=jnp.zeros(1)),
}
