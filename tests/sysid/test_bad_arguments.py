"""Wrong arguments of every public function of identification, one at a time: an error of rbjax that
names the argument, never a bare one of Python, never silence. `test_bad_data.py` has readers."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid as y
from rbjax.sysid.statistics import Scored
from tests.sysid import test_bad_data

NAN = float("nan")
MODEL = rb.load("pendulum")
T = np.arange(31) * 0.01
RUN = y.Recording("a", {"q": y.Channel(T, 0.1 * np.cos(5 * T))})
MASS = {"mass": y.Unknown("bodies.mass", 0, positive=True)}
J = np.random.default_rng(0).normal(size=(20, 2))
R = J[:, 0] - 2 * J[:, 1]
NUMBER = [None, "x", NAN, [], object(), np.ones((3, 3, 3))]
TWO = rb.load("double_pendulum")
STILL = '<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>'
ONE, MANY = np.zeros(2), np.zeros((3, 2))
KEY = jax.random.key(0)
SERIES = y.design.Fourier.random(KEY, jnp.zeros(1), 2, period=6.0)
LONG = np.arange(401) * 0.01
DRIVE = y.Recording("b", {s: y.Channel(LONG, np.cos(LONG)) for s in ("q", "tau")})
ROWS = y.torque.torque_rows(MODEL, DRIVE, 2.0).only(["rod.hz", "rod.Iyy"])


@functools.cache
def fit():
    return y.identify(MODEL, RUN, MASS, grid=y.Grid(0.01), restarts=0)


def stiffness_and_mass(q, v, a):
    return jnp.concatenate([q, a], 1)


ROOMS = (y, y.data, y.parameters, y.statistics, y.torque, y.design)
#: public names of identification and of its rooms
PUBLIC = {name: getattr(room, name) for room in ROOMS for name in room.__all__}
CALLED = PUBLIC | {
    "Fourier.random": y.design.Fourier.random, "Spline.random": y.design.Spline.random,
    "encoder_zeros": ROWS.encoder_zeros,
}  # fmt: skip

# function: (its good arguments, {argument: wrong values})
WRONG_MODEL = [5, "x", None, RUN, {}]
WRONG_RUNS = [5, "x", None, MODEL, [], [5], [RUN, 5], {"a": RUN}, [RUN, RUN],
              y.Recording("v", {"v": RUN["q"]})]  # fmt: skip
WRONG_UNKNOWNS = [5, "x", None, {}, {"mass": 5}, {"mass": y.Unknown("bodies.nope")}, [MASS],
                  {"mass": y.Unknown("bodies.mass", 7)}, {"mass": y.Unknown(5)},
                  {"mass": y.Unknown("bodies.mass", "x")}, {"rod": y.Inertia("handle")},
                  {"rotor": y.Unknown("joints.armature", 0, bounds=(5.0, 6.0))}]  # fmt: skip
WRONG_GRID = [5, "x", y.Grid(0), y.Grid(NAN), y.Grid(0.01, -1), y.Grid(0.01, 1.5), y.Grid("x"),
              y.Grid(0.01, longest_delay=-1), y.Grid(100.0), y.Grid(0.01, integrator="x"),
              y.Grid(0.01, integrator=5)]  # fmt: skip
START = "estimate_initial_state"
FITTED = {"model": MODEL, "recordings": RUN, "unknowns": MASS}
WRONG_FIT = {
    "model": WRONG_MODEL, "recordings": WRONG_RUNS, "unknowns": WRONG_UNKNOWNS, "grid": WRONG_GRID,
}  # fmt: skip
CASES = {
    "identify": (FITTED, WRONG_FIT | {
        "segments": [0, -1, NAN, "x", [1]], "multiple_shooting": [0, -1, NAN, "x", 100.0],
        START: ["x", 5, NAN], "loss": ["x", 5, None, []],
        "max_evaluations": [0, 1.5, "x", None, True],
        "restarts": [-1, 1.5, "x", None, True], "save": [5, []],
        "difference_step": [0.0, 0.6, -1, NAN, "x", 0.03],
        "resume": [5, {"nope": 1.0}, {"mass": "x"}, {"mass": NAN}, "nope.json"],
    }),
    "identifiability": (FITTED, WRONG_FIT | {START: ["x", 5, NAN]}),
    "many_starts": (FITTED, WRONG_FIT | {
        "guesses": [0, "x", None, [[1.0, 2.0]], [[-1.0]], [[NAN]], 1.5],
        "spread": [0, -1, NAN, "x", None], "seed": [-1, "x", None, 1.5],
        "finalists": [0, "x"], "loss": ["x", 5], START: ["x", 5],
    }),
    "squares": (FITTED, WRONG_FIT | {
        "mode": ["x", 5], "memory": [0, -1, "x", True], "loss": ["x", 5], START: ["x", 5],
    }),
    "prediction_error": (FITTED, WRONG_FIT | {
        "drive": ["x", 5, None], "driven": ["x", 5, ["nope"], [5]],
        "max_evaluations": [0, "x", None],
    }),
    "free_run": ({"model": MODEL, "recordings": [RUN]}, {
        "model": WRONG_MODEL, "recordings": WRONG_RUNS, "grid": WRONG_GRID, START: ["x", 5],
        "noise": [5, "x", {}, {"q": "x"}, {"q": [0.0]}, {"q": [NAN]}, {"q": [1.0, 2.0]}],
    }),
    "Channel": ({"t": T, "values": T}, {
        "t": [None, "x", T[::-1], T * NAN, T[:5], T[:, None]],
        "values": [None, "x", T * NAN, T[:5]],
        "names": ["ab", ["a", "a"], 5], "unit": ["furlong", 5], "scale": ["x", [1, 2], NAN, None],
        "sign": [0, 5, "x"], "noise": [-1, NAN, "x", [1, 2]], "dropped": ["x", 5, [True]],
    }),
    "Recording": ({"name": "a", "channels": RUN.channels}, {
        "name": [5, None], "channels": [5, "x", None, {}, {"q": 5}, {"nope": RUN["q"]},
                                        {5: RUN["q"]}, [RUN["q"]]],
        "initial_state": [5, "x", np.zeros(1)],
    }),
    "split": ({"recordings": [y.Recording(n, RUN.channels) for n in "abc"]}, {
        "recordings": [5, "x", None, [5], [], MODEL], "train": ["x", NAN, -1, 2, None],
        "validation": ["x", NAN, -1, 2], "test": ["x", NAN, -1], "seed": [-1, "x", 1.5],
    }),
    "findings": ({"recording": RUN}, {"recording": [5, "x", None, [RUN]]}),
    "in_si": ({"unit": "deg"}, {"unit": [5, None, "x", []]}),
    "combinations": ({"J": J, "names": ["a", "b"]}, {
        "J": [*NUMBER, J * NAN, J * 1j, J[0]], "names": [5, None, ["a"], ["a", "a"], [1, 2], "abc"],
        "tolerance": [0, 2, "x", NAN], "first": [5, ["c"], None],
    }),
    "estimates": ({"names": ["a", "b"], "values": [1.0, 2.0], "jacobian": J, "noise": 1.0}, {
        "names": [5, None, ["a"], ["a", "a"], [1, 2]], "values": ["x", [1.0], None],
        "jacobian": [*NUMBER, J * NAN, J[0]], "noise": ["x", 0, -1, NAN, [1.0, 2.0]],
        "bounds": [{"c": (0, 1)}, 5, "x", {"a": 5}, {"a": (1, 0)}],
        "dof": ["x", 0, NAN],
    }),
    "low_pass": ({"t": T, "x": T, "cutoff": 10.0}, {
        "derivative": [-1, 3, "x"],
        "t": ["x", None, T[::-1], T * NAN, T[:3]], "x": ["x", None, T[:3], T * NAN],
        "cutoff": ["x", 0, -1, NAN, 1e6, None], "order": [0, "x", 1.5],
    }),
    "whiteness": ({"residual": R}, {
        "residual": [*NUMBER, R[:3], 0 * R, R * NAN], "lags": [0, 20, "x", 1.5, NAN],
    }),
    "compare": (
        {"smaller": Scored("a", 2.0, 1), "larger": Scored("b", 1.0, 2), "samples": 30},
        {
            "smaller": [5, "x", None, Scored("a", NAN, 1), Scored("a", "x", 1),
                        Scored("a", 2.0, 2), ("a", 2.0, 1)],
            "larger": [5, "x", None, Scored("a", 5.0, 2), Scored("a", 1.0, None)],
            "samples": ["x", None, NAN, 2, [30]],
        },
    ),
    "held_out": ({"fitted": {"a": R}, "unseen": {"b": R}}, {
        "fitted": [5, None, {}, {"a": "x"}, {"a": None}, {"b": R}, {"a": R * NAN}, [R]],
        "unseen": [5, None, {}, {"b": "x"}, {"a": R}, {"b": []}],
        "measured": [5, {}, {"b": R[:3]}, {"b": "x"}], "noise": ["x", 0, -1, NAN],
        "unit": [5, None],
    }),
    "monte_carlo": ({}, {
        "found": [5, "x", None, MODEL], "repetitions": [0, 1, "x", 2.5], "level": [0, 1, "x", NAN],
        "seed": [-1, "x"],
    }),
    "diagnose": ({}, {"found": [5, "x", None, MODEL], "max_evaluations": [0, "x", 1.5]}),
    "report": ({}, {
        "found": [5, "x", None, MODEL], "path": [5, None, "no/such/folder/a.html"],
        "held_out": [5, "x", [5], RUN], "diagnosis": [5, "x"],
    }),
    "nearest_pseudo_inertia": ({"P": np.eye(4)}, {
        "P": [*NUMBER, np.eye(3)], "margin": [0, -1, "x", NAN, None, True],
    }),
    "with_inertial_parameters": (
        {"model": MODEL, "pi": rb.inertial_parameters(MODEL)},
        {"model": [5, None, "x"], "pi": [5, "x", None, np.zeros(10), np.ones(3)]},
    ),
    "regressor": (
        {"model": TWO, "q": ONE, "v": ONE, "a": ONE, "joint_terms": ["gear_loss"], "tau": ONE},
        {
            "model": [5], "q": ["x", ONE * NAN, MANY], "v": [None], "a": [MANY],
            "tau": [None, "x", np.ones(5)], "smoothing": ["x", True, -1, NAN],
            "joint_terms": ["viscous", 5, [5], [[]], ["friction"], ["bias", "bias"]],
        },
    ),
    "regressor of samples": ({"model": TWO, "q": MANY, "v": MANY, "a": MANY}, {
        "model": [5], "q": [None, ONE, MANY * NAN], "v": [MANY[:2]], "a": [MANY[:, :1]],
        "rows": [5, "elbow", ["x"], [9], [], [True], [0, 0], [1.5]],
    }),
    "parameter_names": ({"model": TWO}, {"model": [5], "joint_terms": ["viscous", ["x"]]}),
    "parameter_values": ({"model": TWO}, {"model": [None], "joint_terms": ["viscous", ["x"]]}),
    "base_parameters": ({"model": TWO}, {
        "model": [5, rb.load(STILL)], "q": [MANY], "samples": [0], "joint_terms": ["x"],
    }),
    "torque_rows": ({"model": MODEL, "recording": DRIVE, "cutoff": 2.0}, {
        "model": [5, "arm", rb.load("free_body")],
        "recording": [5, [DRIVE], RUN, DRIVE.segment(0.0, 0.3)],
        "cutoff": [0.0, 300.0, NAN, "fast", None], "signal_cutoff": [-1.0, 300.0],
        "joint_terms": ["viscous", ["viscous", "viscous"], 5, ["coulom"]],
        "smoothing": [-0.1, NAN], "zeros": [[1.0, 2.0], [NAN], "x"],
    }),
    "consistent": ({"model": TWO, "W": np.ones((9, 2, 20)), "tau": np.ones((9, 2))}, {
        "model": [5], "W": ["x"], "tau": ["x", R], "spread": ["x", 0.0, [1.0, NAN]],
        "max_steps": [0], "joint_terms": ["viscous", ["viscous"]],
    }),
    "select": ({"candidates": {"a": (J, "ab")}, "tau": R}, {
        "candidates": [5, {}, {"a": J}, {"a": (5, 5)}], "tau": [None, R[:3]],
    }),
    "regress_with_zeros": ({"rows": [ROWS], "noise": 1.0}, {
        "rows": [5, [], [5], [ROWS, ROWS]], "spread": ["x", 0.0, NAN], "max_steps": [0],
        "noise": [-1.0, [1.0, 2.0]], "prior": [np.ones(9)],
    }),
    "encoder_zeros": ({"parameters": [1.0, 1.0]}, {
        "parameters": [[1.0], [1.0, NAN]], "spread": [0], "noise": [0.0],
    }),
    "Fourier": ({"q0": ONE, "a": np.ones((2, 3)), "b": np.ones((2, 3)), "period": 1.0}, {
        "q0": [None, "x", ONE * NAN, np.ones(3)], "a": ["x", ONE], "b": ["x", np.ones((2, 2))],
        "period": [0.0, -1.0, NAN, "x"],
    }),
    "Fourier.random": ({"key": KEY, "q0": ONE, "harmonics": 2, "period": 1.0}, {
        "key": [5], "q0": ["x", 0.0], "harmonics": [0, 1.5], "period": [-1.0], "speed": [NAN, "x"],
    }),
    "Spline": ({"points": np.ones((1, 5)), "duration": 1.0}, {
        "points": ["x", np.ones((1, 2))], "duration": [0.0, -1.0, NAN, "x"],
    }),
    "Spline.random": ({"key": KEY, "q0": ONE, "points": 5, "duration": 1.0}, {
        "key": [5], "q0": ["x", 0.0], "points": [2, 1.5], "size": [NAN, "x"],
    }),
    "MotionLimits": ({"low": 0.0, "high": 1.0}, {
        "low": [None, 2.0, "x"], "high": [None, -1.0, "x"], "speed": ["x", NAN, -1.0],
        "torque": [3.0], "model": [5, TWO], "own": [5],
    }),
    "design_experiment": ({"start": SERIES, "information": stiffness_and_mass, "rounds": 1}, {
        "start": [5], "criterion": ["F"], "samples": [0], "rounds": [0, 1.5], "steps": ["x"],
        "information": [5, lambda q, v, a: None, lambda q, v, a: q[:, 0],
                        lambda q, v, a: jnp.concatenate([q, 2 * q], 1)],
        "limits": [5, y.design.MotionLimits(speed=np.ones(3))],
        "known": ["x", np.ones(3), np.eye(3), np.full((2, 2), NAN)],
    }),
}  # fmt: skip
REGRESSION = {"W": J, "tau": R, "names": ["a", "b"]}
CASES |= {
    "estimates of residuals": (CASES["estimates"][0] | {"noise": None, "residual": R}, {
        "residual": [None, "x", R[:3], R * NAN, R[:, None]],
    }),
    "regress": (REGRESSION, {
        "method": ["magic", "instrumental"],
        "W": [*NUMBER, J * NAN, J * 1j, J[:3], J[0]], "tau": ["x", None, R[:3], R * NAN],
        "names": [5, None, ["a"], ["a", "a"]], "noise": ["x", 0, -1, NAN, np.ones(3), np.inf],
        "base": [5, "x"], "lengths": [5, [3], ["x"], [0, 20], [10.0, 10.0]],
    }),
    "regress robust": (REGRESSION | {"method": "robust"}, {
        "loss": ["l1"], "max_steps": [0, 1.5], "steps": [5],
    }),
    "regress ordinary": (REGRESSION | {"method": "ordinary"}, {
        "noise": [np.where(np.arange(20) == 7, np.inf, 1.0)[:, None]], "loss": ["huber"],
    }),
    "regress instrumental": (REGRESSION | {"method": "instrumental", "instruments": J[:, None]}, {
        "instruments": [np.ones(3), J[:3, None], 0 * J[:, None]], "max_steps": [0],
    }),
}  # fmt: skip
OF_A_FIT = {"monte_carlo", "diagnose", "report"}
#: readers, which `test_bad_data.py` has
ELSEWHERE = {"read_recording"}
#: of arrays within traced code, in the grid of `tests/public`
ARRAYS = {
    "to_log_cholesky", "from_log_cholesky", "pseudo_inertia_of", "inertial_parameters_of",
    "log_determinant_divergence",
}  # fmt: skip


def calls():
    for name, (_, wrong) in CASES.items():
        for argument, values in wrong.items():
            for k, value in enumerate(values):
                yield pytest.param(name, argument, value, id=f"{name}-{argument}-{k}")


@pytest.mark.parametrize(("name", "argument", "value"), [*calls()])
def test_a_wrong_argument_is_named(name, argument, value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    good = dict(CASES[name][0])
    if name in OF_A_FIT and argument != "found":
        good["found"] = fit()
    with pytest.raises(rb.RbjaxError) as caught:
        CALLED[name.split()[0]](**(good | {argument: value}))
    assert 25 < len(str(caught.value)) < 1500


def test_every_public_function_has_a_table():
    functions = {name for name, x in PUBLIC.items() if callable(x) and not inspect.isclass(x)}
    assert functions - {*CASES} - ELSEWHERE - ARRAYS == set()
    assert [n for n in ELSEWHERE if n not in inspect.getsource(test_bad_data)] == []
