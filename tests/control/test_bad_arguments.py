"""Wrong arguments of every public function and class of `rbjax.control` are rejected by name: wrong
types, shapes, values that are not finite, negative weights, inverted limits, empty lists."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import control as C
from rbjax.errors import RbjaxError

CART = rb.load("cart_pole")
ARM = rb.load("arm7")
UP = CART.keyframe("up")
REST = ARM.default_state().q
KEY = jax.random.key(0)
TWO = np.array([[0.0, 1.0], [0.0, 0.0]])
ONE = np.array([[0.0], [1.0]])
GOAL = C.Goal(site="tool", position=np.array([0.3, 0.1, 0.6]))
POSE = (np.eye(3), np.array([0.3, 0.1, 0.6]))
LINE = C.Equations(lambda t, x, u: u, 1, 1)
BAND = C.linear.LinearQuadratic(*map(jnp.asarray, (
    np.tile(TWO, (3, 1, 1)), np.tile(ONE, (3, 1, 1)), np.zeros((3, 2)),
    np.tile(np.eye(2), (4, 1, 1)), np.zeros((4, 2)), np.ones((3, 1, 1)), np.zeros((3, 1)),
    np.zeros((3, 2, 1)),
)))  # fmt: skip
STATES = rb.State(jnp.zeros((4, 2)), jnp.zeros((4, 2)))


PROBLEM = C.Problem(LINE, 3, 1.0, running=[C.Control()], bounds=(-1.0, 1.0))


# ------------------------------------------------------------ bad values, by kind


def model():
    return [3, "cart_pole", None]


def state():
    return [3, "up", rb.State(jnp.zeros(9), jnp.zeros(9)), rb.State(UP.q * jnp.nan, UP.v)]


def array(*shape):
    """Of this shape."""
    wrong = [np.full(shape, np.nan), np.full(shape, np.inf)]
    return ["x", np.ones((*shape, 5, 5)), *wrong, [[1], [2, 3]]]


def positive():
    return ["x", -1.0, np.nan, np.ones(2), np.inf]


def weight():
    """A number that is not negative."""
    return ["x", -1.0, np.nan, np.ones((3, 3, 3))]


def share():
    return ["x", -0.5, 1.5, np.nan]


def count():
    return [0, -1, 2.5, "3"]


def function():
    return [3, "f", lambda: 0.0]


def name():
    return ["no such", 3]


def rows():
    """A list of things that are not numbers."""
    return [3, [3], "x"]


def flag():
    return ["yes", 3]


POISED = {"model": CART, "state": UP, "ctrl": np.zeros(1)}
LQ = {"A": TWO, "B": ONE, "Q": np.eye(2), "R": np.eye(1)}
WEIGHTS = {"Q": [*array(2, 2), np.ones(3), [[1.0, 2.0], [0.0, 1.0]]],
           "R": [*array(1, 1), -np.eye(1)]}  # fmt: skip
MATRICES = {"A": array(2, 2), "B": array(2, 1)} | WEIGHTS

#: function, valid arguments, bad values of some of them
TABLE = {
    "Problem": (C.Problem, {"model": LINE, "horizon": 3, "dt": 1.0, "running": [C.Control()]}, {
        "model": [3, "cart_pole", None], "horizon": count(), "dt": positive(),
        "running": [3, [3], [], [lambda x: x]], "terminal": [3, [3]], "constraints": rows(),
        "bounds": [3.0, "robot", (1.0, -1.0), (np.nan, 1.0), (np.zeros(3), np.ones(3)), (0, 1, 2)],
        "design": [3, "x"], "free_time": [(2.0, 1.0), (-1.0, 1.0), 3.0, (np.nan, 1.0), "x"],
        "free_start": [[True, False], "x", 3.5], "start_time": ["x", np.nan, np.ones(2)],
        "integral": flag(),
    }),
    "Design": (C.Design, {"apply": lambda m, p: m, "start": [0.1]}, {
        "apply": [3, "f"], "start": ["x", [np.nan], np.ones((2, 2))],
        "low": ["x", np.nan, np.ones(3), 1.0], "high": ["x", np.nan, np.ones(3), -1.0],
    }),
    "Equations": (C.Equations, {"function": lambda t, x, u: u, "size": 1, "controls": 1}, {
        "function": function(), "size": count(), "controls": count(), "parts": count(),
        "discrete": flag(),
    }),
    "Cost": (C.Cost, {"term": C.Control()}, {
        "term": [3, "x", lambda x: x], "weight": ["x", -1.0, np.nan, [1.0, -1.0]],
    }),
    "Constraint": (C.Constraint, {"term": lambda t, x, u: x}, {
        "term": [3, "x", lambda x: x], "low": ["x", np.nan, 1.0], "high": ["x", np.nan, -1.0],
        "where": name(), "name": [3],
    }),
    "StateError": (C.StateError, {"reference": UP}, {"reference": ["up", lambda: UP]}),
    "Control": (C.Control, {"reference": 0.0}, {"reference": ["x", np.nan, lambda: 0.0]}),
    "CenterOfMass": (C.CenterOfMass, {"position": np.zeros(3)}, {"position": array(3)}),
    "Point": (C.Point, {"position": np.zeros(3), "site": "tool"}, {
        "position": array(3), "site": [3], "body": [3, "hand"],
    }),
    "Pose": (C.Pose, {"rotation": np.eye(3), "position": np.zeros(3), "site": "tool"}, {
        "rotation": [*array(3, 3), 2 * np.eye(3), -np.eye(3)], "position": array(3), "site": [3],
    }),
    "FrameVelocity": (C.FrameVelocity, {"site": "tool"}, {"site": [3, None], "body": [3, "hand"]}),
    "Sphere": (C.Sphere, {"centre": np.zeros(3), "radius": 0.1}, {
        "centre": array(3), "radius": weight(),
    }),
    "Capsule": (C.Capsule, {"a": np.zeros(3), "b": np.ones(3), "radius": 0.1}, {
        "a": array(3), "b": array(3), "radius": weight(),
    }),
    "HalfSpace": (C.HalfSpace, {"normal": np.array([0, 0, 1.0])}, {
        "normal": [*array(3), np.zeros(3)], "offset": ["x", np.nan, np.ones(2)],
    }),
    "Clearance": (C.Clearance, {"obstacles": [C.Sphere(np.ones(3), 0.1)], "bodies": ["link7"]}, {
        "obstacles": [3, [3], []], "bodies": [3, [3], []], "radii": ["x", np.nan, np.ones(3), -1.0],
        "margin": ["x", np.nan, np.ones(3)], "offsets": ["x", np.ones(2), np.full((1, 3), np.nan)],
    }),
    "Goal": (C.Goal, {"site": "tool", "position": np.zeros(3)}, {
        "site": [3, None], "position": array(3), "rotation": [*array(3, 3), 2 * np.eye(3)],
        "direction": [*array(3), np.zeros(3)], "point": array(3), "weight": weight(),
    }),
    "solve": (C.solve, {"problem": PROBLEM, "start": np.ones(1)}, {
        "problem": [3, LINE, None], "start": ["x", np.ones(3), np.full(1, np.nan), None],
        "method": name(), "states": ["x", np.ones((3, 1)), np.full((4, 1), np.nan)],
        "ctrl": ["x", np.ones((4, 1)), np.full((3, 1), np.nan)], "parameters": ["x", np.ones(1)],
        "guess": [3, "x"], "iterations": count(), "tolerance": ["x", -1.0, np.nan],
        "violation": ["x", -1.0, np.nan], "seed": ["x", 1.5, -1],
    }),
    "Sampling": (C.Sampling, {}, {
        "update": name(), "samples": count(), "points": count(), "spline": name(),
        "spread": positive(), "cooling": share(), "temperature": positive(), "smoothing": share(),
        "penalty": ["x", -1.0, np.nan],
    }),
    "mpc": (C.mpc, {"problem": PROBLEM}, {
        "problem": [3, "x", lambda: PROBLEM, lambda t: 3], "method": name(), "iterations": count(),
        "delay": [-1, 1.5, "x"], "patience": [-1, 1.5, "x"], "fallback": function(),
        "tolerance": ["x", -1.0, np.nan], "violation": ["x", -1.0, np.nan], "first": count(),
        "feedback": flag(),
    }),
    "RealTime": (C.RealTime, {"controller": C.mpc(PROBLEM), "state": np.ones(1)}, {
        "controller": [3, PROBLEM], "state": ["x", np.ones(3)],
    }),
    "lqr": (C.lqr, LQ, MATRICES | {"S": array(2, 1), "discrete": flag()}),
    "lqr_at": (C.lqr_at, POISED | {"Q": np.ones(4), "R": np.ones(1)}, {
        "model": model(), "state": state(), "ctrl": array(1), "Q": array(4), "R": array(1),
        "dt": positive(), "integrator": name(), "dynamics": [3, "x"], "constraints": name(),
    }),
    "time_varying_lqr": (C.time_varying_lqr, {
        "model": CART, "states": STATES, "ctrl": np.zeros((3, 1)), "dt": 0.1, "Q": np.ones(4),
        "R": np.ones(1),
    }, {
        "model": model(), "states": [3, UP], "dt": [*positive(), 0.0],
        "ctrl": ["x", np.zeros(3), np.zeros((2, 1)), np.full((3, 1), np.nan)],
        "Q": array(4), "R": array(1), "terminal": array(4), "integrator": name(),
    }),
    "feedback": (C.feedback, POISED | {"K": np.ones((1, 4))}, {
        "model": model(), "state": state(), "ctrl": array(1), "K": array(1, 4),
    }),
    "LinearQuadratic.constant": (BAND.constant, LQ | {"horizon": 3}, MATRICES | {
        "R": array(1, 1),  # one that is not definite is a result: success is false
        "horizon": count(), "terminal": array(2, 2), "S": array(2, 1),
    }),
    "backward": (C.linear.backward, {"problem": BAND}, {
        "problem": [3, "x", PROBLEM], "parallel": flag(),
    }),
    "LinearQuadratic.roll": (BAND.roll, {"gains": C.linear.backward(BAND), "start": np.zeros(2)}, {
        "gains": [3, "x"], "start": array(2),
    }),
    "lyapunov": (C.linear.lyapunov, {"A": -np.eye(2), "Q": np.eye(2)}, {
        "A": array(2, 2), "Q": array(2, 2), "method": name(), "discrete": flag(),
    }),
    "controllability": (C.linear.controllability, {"A": TWO, "B": ONE}, {
        "A": array(2, 2), "B": array(2, 1), "tolerance": ["x", -1.0, np.nan],
    }),
    "observability": (C.linear.observability, {"A": TWO, "C": ONE.T}, {
        "A": array(2, 2), "C": array(1, 2), "tolerance": ["x", -1.0, np.nan],
    }),
    "Reach.missing": (C.linear.controllability(np.eye(4), np.eye(4)).missing, {"model": CART}, {
        "model": model(),
    }),
    "poles": (C.linear.poles, {"A": TWO, "B": ONE, "K": np.ones((1, 2))}, {
        "A": array(2, 2), "B": array(2, 1), "K": [*array(1, 2), None],
    }),
    "discretise": (C.linear.discretise, {"A": TWO, "B": ONE, "dt": 0.1}, {
        "A": array(2, 2), "B": array(2, 1), "dt": positive(),
    }),
    "margins": (C.linear.margins, {"A": TWO, "B": ONE, "K": np.ones((1, 2))}, {
        "A": array(2, 2), "B": array(2, 1), "K": array(1, 2), "dt": positive(),
        "frequencies": count(),
    }),
    "kalman_gain": (C.linear.kalman_gain, {"A": TWO, "C": ONE.T, "W": np.eye(2), "V": np.eye(1)}, {
        "A": array(2, 2), "C": array(1, 2), "W": array(2, 2), "V": array(1, 1),
        "discrete": flag(),
    }),
    "computed_torque": (C.computed_torque, {"model": ARM, "reference": REST, "stiffness": 1.0}, {
        "model": model(), "reference": [*array(7), lambda: REST], "stiffness": weight(),
        "damping": weight(), "undriven": name(),
    }),
    "operational_space": (C.operational_space, {
        "model": ARM, "reference": POSE, "site": "tool", "stiffness": 1.0,
    }, {
        "model": model(), "reference": ["x", 3, (np.eye(3),), lambda: POSE], "site": name(),
        "body": name(), "task": name(), "stiffness": weight(), "damping": weight(),
        "posture": array(7), "posture_stiffness": weight(), "posture_damping": weight(),
        "undriven": name(),
    }),
    "cartesian_impedance": (C.cartesian_impedance, {
        "model": ARM, "reference": POSE, "site": "tool", "stiffness": 1.0, "damping": 1.0,
    }, {
        "model": model(), "reference": ["x", 3, (np.eye(3),), lambda: POSE], "site": name(),
        "body": name(), "task": name(), "stiffness": weight(), "damping": weight(),
        "posture": array(7), "posture_stiffness": weight(), "posture_damping": weight(),
        "compensate": name(), "undriven": name(),
    }),
    "joint_impedance": (C.joint_impedance, {
        "model": ARM, "reference": REST, "stiffness": 1.0, "damping": 1.0,
    }, {
        "model": model(), "reference": array(7), "stiffness": weight(), "damping": weight(),
        "compensate": name(), "undriven": name(),
    }),
    "gravity_compensation": (C.gravity_compensation, {"model": ARM}, {
        "model": model(), "wrenches": ["x", np.zeros(6), lambda: 0.0], "undriven": name(),
    }),
    "allocate": (C.allocate, {"model": CART, "state": UP, "tau": np.zeros(2)}, {
        "model": model(), "state": state(), "tau": array(2),
    }),
    "inverse_kinematics": (C.inverse_kinematics, {"model": ARM, "target": GOAL}, {
        "model": model(), "target": [3, "x", [], [3], None], "site": name(), "start": array(7),
        "posture": array(7), "seeds": count(), "side_by_side": count(),
        "weights": ["x", (1.0,), (-1.0, 1.0), (np.nan, 1.0)], "tolerance": ["x", -1.0, np.nan],
        "iterations": count(), "limits": flag(), "key": [3, "x"],
    }),
    "differential_inverse_kinematics": (C.differential_inverse_kinematics, {
        "model": ARM, "q": REST, "goals": GOAL,
    }, {
        "model": model(), "q": array(7), "goals": [3, [], [3]], "rate": ["x", -1.0, np.nan],
        "speed": ["x", -1.0, np.nan, np.ones(3), 0.0], "dt": positive(), "rest": array(7),
        "damping": ["x", -1.0, np.nan],
    }),
    "region_of_attraction": (C.region_of_attraction, {
        "model": CART, "policy": lambda t, s: jnp.zeros(1), "equilibrium": UP,
        "axes": [("hinge", -1.0, 1.0), ("hinge'", -1.0, 1.0)], "points": 2, "duration": 0.1,
        "dt": 0.05,
    }, {
        "model": model(), "policy": function(), "equilibrium": state(),
        "axes": [3, [], [("hinge", -1.0, 1.0)], [("no", -1, 1), ("hinge", -1, 1)],
                 [("hinge", 1.0, -1.0), ("slider", -1, 1)], [("hinge", "x", 1), ("slider", -1, 1)],
                 [("hinge", -1, 1)] * 2, [(9, -1, 1), ("slider", -1, 1)]],
        "points": [0, 1, 2.5, "x", (2, 2, 2)], "duration": [*positive(), 0.0], "dt": positive(),
        "tolerance": ["x", -1.0, np.nan], "angles": flag(), "integrator": name(),
    }),
}  # fmt: skip
#: what has nothing to check: terms without arguments, results and parts that functions make
WITHOUT = {
    "Acceleration", "Configuration", "Controller", "DifferentialInverseKinematics", "Effort",
    "InverseKinematics", "Jerk", "LinearStatus", "LinearQuadratic", "Method", "Solution", "Status",
    "System", "Term", "TickStatus", "Velocity", "methods",
}  # fmt: skip
ROOMS = (C, C.laws, C.linear, C.optimal, rb.kinematics)
SUBROOMS = {"laws", "learning", "linear", "optimal"}
NAMES = {name for room in ROOMS for name in room.__all__} - SUBROOMS


def test_every_public_name_is_in_the_table():
    functions = {name for name in TABLE if "." not in name}  # the others are methods
    assert functions | WITHOUT == NAMES and not functions & WITHOUT
    for call, given, bad in TABLE.values():
        known = inspect.signature(getattr(call, "__wrapped__", call)).parameters
        assert set(given) | set(bad) <= set(known)


@pytest.mark.parametrize("function", TABLE)
def test_bad_arguments_are_rejected(function):
    call, given, bad = TABLE[function]
    for what, values in bad.items():
        for value in values:
            with pytest.raises(RbjaxError) as caught:
                call(**given | {what: value})
                pytest.fail(f"{what}={value!r} is accepted")
            said = str(caught.value)
            cures = ("expected", "known names", "give ", "Give ", "which name their own", ";")
            assert any(cure in said for cure in cures), said
