"""Bad arguments of every public function: a clear error of rbjax or a right result.

A case is a call that works, one of its arguments made bad, drawn with a fixed seed. It must end in
an error that rbjax raises, of more than 30 characters, or in a finite result of the shapes that the
good call has.
"""

from __future__ import annotations

import functools
import inspect
import random
import traceback
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.motion import field

SEED = 7
MODEL, TOP = rb.load("cart_pole"), rb.load("spinning_top")
MANY = jax.tree.map(lambda x: jnp.stack([x, x, x]), MODEL)
STATE, F = MODEL.default_state(), rb.forces
Case = tuple[str, Callable[[], Any], Callable[[], Any]]  # what it is, the good call, the bad call


def arrays(shape: tuple[int, ...]) -> dict[str, Any]:
    """Bad values for an array of this shape."""
    good = np.full(shape, 0.3)
    more = (shape[0] + 1, *shape[1:]) if shape else (2,)
    first = (0,) * len(shape)

    def spoilt(value: float) -> np.ndarray:
        x = good.copy()
        x[first] = value
        return x

    return {
        "one more": np.ones(more),
        "none": np.zeros((0, *shape[1:])),
        "an axis more": good[..., None],
        "a batch": np.stack([good, good]),
        "an empty batch": np.zeros((0, *shape)),
        "a matrix": np.ones((7, 5)),
        "nan": spoilt(np.nan),
        "inf": spoilt(-np.inf),
        "a jax nan": jnp.asarray(spoilt(np.nan)),
        "complex": good + 0j,
        "whole": good.astype(int),
        "bool": good.astype(bool),
        "list": good.tolist(),
        "object": good.astype(object),
        "objects": np.full(shape, None, object),
        "text": np.full(shape, "a"),
        "dates": np.full(shape, np.datetime64("2020-01-01")),
        "a word": "fast",
        "bytes": b"fast",
        "None": None,
        "a dict": {"q": 0.0},
        "a set": {1.0},
        "ragged": [[1.0], [1.0, 2.0]],
        "huge": 10**40,
        "a generator": (x for x in good.ravel()),
        "a function": lambda: good,
        "a function of two": lambda t, state: good,
        "a type": np.ndarray,
        "a key": jax.random.key(0),
        "a shape": jax.ShapeDtypeStruct(shape, float),
        "a model": MODEL,
        "a state": STATE,
    }


STATES = {
    "a pair": (STATE.q, STATE.v), "None": None, "a word": "rest", "a model": MODEL,
    "the class": rb.State, "of nothing": rb.State(None, None), "of words": rb.State("a", "b"),
    "q alone": rb.State(STATE.q, None), "swapped shapes": rb.State(jnp.zeros(3), jnp.zeros(1)),
    "nan": rb.State(STATE.q * np.nan, STATE.v), "whole": rb.State([0, 0], [0, 0]),
    "batched q": rb.State(jnp.zeros((3, 2)), jnp.zeros(2)),
    "batched": rb.State(jnp.zeros((3, 2)), jnp.zeros((3, 2))),
    "batches of two sizes": rb.State(jnp.zeros((3, 2)), jnp.zeros((2, 2))),
    "an empty batch": rb.State(jnp.zeros((0, 2)), jnp.zeros((0, 2))),
    "complex": rb.State(STATE.q + 1j, STATE.v), "an x too many": rb.State(*[STATE.q] * 3),
    "x of a word": rb.State(STATE.q, STATE.v, "x"), "a scalar": rb.State(0.0, 0.0),
    "ragged": rb.State([[0.0], [0.0, 1.0]], [0.0, 0.0]), "a dict": {"q": STATE.q, "v": STATE.v},
}  # fmt: skip
MODELS = {
    "a batch": MANY, "None": None, "its name": "cart_pole", "a state": STATE, "the class": rb.Model,
    "heavy bodies": eqx.tree_at(lambda m: m.bodies, MODEL, MANY.bodies), "a dict": {},
    "a function": rb.load, "an array": np.ones(3),
}  # fmt: skip
STEPS = {
    "negative": -0.01, "zero": 0.0, "nan": np.nan, "inf": np.inf, "a word": "0.01", "list": [0.01],
    "array": np.array([0.01, 0.01]), "complex": 0.01j, "object": object(), "True": True,
    "a function": lambda t: 0.01, "huge": 10**400, "negative array": jnp.array(-1.0),
}  # fmt: skip
COUNTS = {
    "negative": -3, "zero": 0, "half": 2.5, "a word": "5", "nan": np.nan, "inf": np.inf,
    "True": True, "list": [5], "array": np.array([5, 5]), "jax": jnp.array(-5), "complex": 2j,
    "a function": len, "float": 5.0,
}  # fmt: skip
NAMES = {
    "misspelt": "poel", "a number": 0, "beyond": 99, "float": 0.5, "a list": ["pole"],
    "empty": "", "a dict": {}, "True": True, "bytes": b"pole", "an array": np.zeros(2),
}  # fmt: skip
INTEGRATORS = {
    "misspelt": "rk5", "None": None, "number": 4, "a class": dict, "wrong arity": lambda s: s,
    "returns None": lambda f, t, s, u, dt: None, "returns a pair": lambda f, t, s, u, dt: (s, s),
    "wrong shape": lambda f, t, s, u, dt: rb.State(s.q[:1], s.v), "a list": ["rk4"],
    "a solver": diffrax.Tsit5(), "object": object(),
}  # fmt: skip
DYNAMICS = {
    "None": None, "misspelt": "free", "wrong arity": lambda m: m, "number": 1.0,
    "returns None": lambda m, t, s, tau, w: None, "returns a word": lambda m, t, s, tau, w: "a",
    "wrong shape": lambda m, t, s, tau, w: jnp.zeros(7), "scalar": lambda m, t, s, tau, w: 0.0,
    "a list": [1], "complex": lambda m, t, s, tau, w: tau + 1j,
}  # fmt: skip
POLICIES = {
    "wrong arity": lambda t: jnp.zeros(1), "no arguments": lambda: jnp.zeros(1),
    "returns None": lambda t, s: None, "returns a word": lambda t, s: "left",
    "wrong shape": lambda t, s: jnp.zeros(4), "scalar": lambda t, s: 0.0,
    "complex": lambda t, s: jnp.ones(1) * 1j, "nan": lambda t, s: jnp.array([np.nan]),
    "a dict": lambda t, s: {"u": 0.0}, "a class": dict, "a number": 3.0, "a word": "zero",
    "a row": np.zeros(1), "columns": np.zeros((1, 5)), "too few": np.zeros((4, 1)),
    "none": np.zeros((0, 1)), "nans": np.full((5, 1), np.nan), "objects": [[None]] * 5,
    "whole": np.ones((5, 1), int), "a list": [[0.0]] * 5, "three axes": np.zeros((2, 5, 1)),
    "a list of functions": [lambda t, s: 0.0] * 5, "text": [["a"]] * 5, "a dict itself": {"u": 1},
    "a python bool": lambda t, s: [True],
}  # fmt: skip
TIMES = {
    "one": [0.0], "none": [], "scalar": 1.0, "falling": [1.0, 0.0], "equal": [0.0, 0.0],
    "nan": [0.0, np.nan], "inf": [0.0, np.inf], "words": ["a", "b"], "None": None, "a word": "now",
    "complex": [0.0, 1j], "matrix": np.ones((2, 2)), "list": [0.0, 0.02], "bool": [False, True],
    "objects": [None, 1.0], "a range": range(2), "ragged": [[0.0], [1.0, 2.0]], "huge": [0, 10**40],
    "a state": STATE, "a function": lambda: 0.0,
}  # fmt: skip
SOLVERS = {
    "a name": "tsit5", "misspelt": "tsit", "a class": diffrax.Tsit5, "number": 5,
    "an entry": rb.solvers.all()["rk4"], "a function": rb.solvers.newmark,
    "an integrator": lambda f, t, s, u, dt: s, "a list": [diffrax.Tsit5()],
    "of a rigid body": rb.solvers.all()["rigid_body_splitting"].make(),
}  # fmt: skip
OTHERS: dict[str, dict[str, Any]] = {
    "memory": {"negative": -1.0, "word": "1GB", "nan": np.nan},
    "kernel": {"word": "no", "number": 7},
    "stepsize_controller": {"word": "pid", "class": diffrax.PIDController, "number": 1e-3},
    "adjoint": {"word": "direct", "class": diffrax.DirectAdjoint, "number": 1},
    "constraints": {"word": "loops", "list": []},
    "t": {"nan": np.nan, "a word": "now", "array": np.zeros(3), "None": None, "complex": 1j,
          "list": [0.0], "object": object(), "a function": lambda: 0.0},
}  # fmt: skip

GOOD: dict[str, Any] = {
    "q": np.array([0.1, 0.2]), "q0": np.array([0.1, 0.2]), "q1": np.array([0.3, 0.2]),
    "v": np.array([0.3, -0.1]), "a": np.ones(2), "dq": np.ones(2), "tau": np.ones(2),
    "wrenches": np.ones((2, 6)), "point": np.ones(3), "ctrl": np.ones(1), "state": STATE,
    "dt": 0.01, "ts": [0.0, 0.02], "integrator": "rk4", "t": 0.0, "dynamics": field.free_motion,
    "source": "cart_pole",
}  # fmt: skip
QUATERNIONS = {"zero": np.zeros(4), "tiny": np.full(4, 1e-200), "endless": np.full(4, 1e200)}
LEAVES = ("mass", "com", "inertia", "position", "orientation")


def bad_values(name: str, value: Any) -> dict[str, Any]:
    """Bad values for an argument."""
    known = {
        "model": MODELS, "state": STATES, "dt": STEPS, "steps": COUNTS,
        "save_every": COUNTS, "max_steps": COUNTS, "body": NAMES, "site": NAMES,
        "dynamics": DYNAMICS,
        "integrator": INTEGRATORS, "ts": TIMES,
        "solver": SOLVERS, "source": SOURCES, "elements": ELEMENTS,
        "name": NAMES, "kind": KINDS,
        "a": ELEMENTS, "joints": JOINTS, "bodies": JOINTS, "dtype": DTYPES, "number": COUNTS,
    } | OTHERS  # fmt: skip
    if name == "a" and eqx.is_array_like(value):  # accelerations; of a spring it is an end
        return arrays(np.shape(value))
    if name == "ctrl" and np.shape(value) != (1,):  # of a motion: an array or a policy
        return POLICIES
    return known.get(name) or arrays(np.shape(value))


def doors() -> Iterator[tuple[str, Callable, dict[str, Any]]]:
    """Each public function: its name, the function, and good arguments by name."""
    for name in (*rb.__all__, "dynamics.generalized_forces", "forces.elastic_energy"):
        function = functools.reduce(getattr, name.split("."), rb)
        taken = inspect.signature(function).parameters if inspect.isroutine(function) else {}
        if next(iter(taken), None) != "model" or name in ("rollout", "simulate"):
            continue
        given = {"model": MODEL} | {n: GOOD[n] for n in taken if n in GOOD}
        if "site" in taken:
            given |= {"body": "pole"}
        yield name, function, given
    row = np.zeros((5, 1))
    yield "rollout", rb.rollout, {
        "model": MODEL, "state": STATE, "ctrl": row, "dt": 0.01, "tau": np.zeros((5, 2)),
        "wrenches": np.zeros((5, 2, 6)), "integrator": "semi_implicit_euler", "save_every": 1,
        "steps": 5, "dynamics": field.free_motion, "memory": 1e9, "kernel": False,
    }  # fmt: skip
    yield "simulate", rb.simulate, {
        "model": MODEL, "state": STATE, "ts": [0.0, 0.02], "ctrl": CONTROL, "tau": np.zeros(2),
        "wrenches": np.zeros((2, 6)), "solver": diffrax.Euler(), "dt": 0.01, "max_steps": 100,
        "stepsize_controller": diffrax.ConstantStepSize(), "constraints": None,
        "dynamics": field.free_motion, "adjoint": diffrax.RecursiveCheckpointAdjoint(),
    }  # fmt: skip
    yield "load", rb.load, {"source": "pendulum"}
    spring = F.PointSpring.of(F.Place.on(), F.Place.on(body="pole"))
    yield "with_forces", MODEL.with_forces, {"elements": spring}
    for leaf in ("mass", "inertia", "orientation"):
        yield "bodies.replace", MODEL.bodies.replace, {leaf: getattr(MODEL.bodies, leaf)}
    yield "with_joint", MODEL.with_joint, {
        "name": "slider", "kind": "screw", "axis": [0.0, 1.0, 0.0], "reference": [0.2],
        "pitch": 0.01,
    }  # fmt: skip
    yield "Model.replace", MODEL.replace, {"gravity": MODEL.gravity}
    yield "astype", MODEL.astype, {"dtype": float}
    for kind, given in numbers_of_elements().items():
        yield kind, functools.partial(pushed, getattr(F, kind)), given
    yield "PointSpring.of", spring_of, {"stiffness": 1.0, "damping": [1.0, 2.0], "length": 0.5}
    yield "Place.on", anchored, {"point": [0.0, 0.0, 1.0], "body": "pole"}
    for name, good in {"bdf": 2, "rkmk": 2, "gauss_legendre": 2, "generalized_alpha": 0.5}.items():
        yield f"solvers.{name}", getattr(rb.solvers, name), {"number": good}


def numbers_of_elements() -> dict[str, dict[str, Any]]:
    """Good fields of the elements that are made of numbers and names."""
    names, two = MODEL.joint_names, jnp.ones(2)
    anchors = {"a": F.Place.on(), "b": F.Place.on(body="pole")}
    limits = dict.fromkeys(("stiffness", "damping", "margin", "width"), two)
    friction = ("coulomb", "breakaway", "stribeck", "smoothing", "viscous")
    return {
        "JointLimits": {**limits, "joints": names},
        "JointFriction": {**dict.fromkeys(friction, two), "joints": names},
        "JointCurves": {
            "range": jnp.array([[-1.0, 1.0]] * 2),
            "torque": two[:, None],
            "coulomb": two[:, None],
            **dict.fromkeys(friction[1:4], two),
            "joints": names,
        },
        "GearLoss": {"loss": two, "smoothing": two, "joints": names},
        "JointPolynomials": {"stiffness": two[:, None], "damping": two[:, None], "joints": names},
        "GravityCompensation": {"fraction": two, "bodies": MODEL.body_names},
        "Bushing": {**anchors, "stiffness": jnp.ones(6), "damping": jnp.ones(6)},
        "PointSpring": {**anchors, "stiffness": two, "damping": two, "slack": two},
    }


def pushed(kind: type, **fields: Any) -> jax.Array:
    """What an element of these fields does to the cart and its pole."""
    return rb.applied_forces(MODEL.with_forces(kind(**fields)), rb.State(GOOD["q"], GOOD["v"]))


def spring_of(**numbers: Any) -> jax.Array:
    ends = F.Place.on(), F.Place.on(body="pole")
    made = F.PointSpring.of(*ends, **numbers)
    return rb.applied_forces(MODEL.with_forces(made), rb.State(GOOD["q"], GOOD["v"]))


def anchored(**given: Any) -> jax.Array:
    made = F.PointSpring.of(F.Place.on(), F.Place.on(**given), stiffness=3.0)
    return rb.applied_forces(MODEL.with_forces(made), rb.State(GOOD["q"], GOOD["v"]))


def cases() -> list[Case]:
    """A random sample of all bad calls, with the same seed on every run."""
    every: list[Case] = []
    for door, function, given in doors():
        for name, value in given.items():
            for kind, bad in bad_values(name, value).items():
                good = functools.partial(called, function, given)
                call = functools.partial(called, function, given | {name: bad})
                every.append((f"{door}({name}: {kind})", good, call))
    return every


@pytest.mark.parametrize("count", [50, pytest.param(300, marks=pytest.mark.slow)])
def test_bad_arguments_end_in_a_sentence_or_in_a_right_result(count: int) -> None:
    every = cases()
    assert len(every) > 3000
    drawn = random.Random(SEED).sample(every, count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {what: wrong_with(what, bad, good) for what, good, bad in drawn}
    wrong = [f"{what}: {how}" for what, how in found.items() if how]
    assert not wrong, "\n".join(["", *wrong])


def called(function: Callable, given: dict[str, Any]) -> Any:
    """The function of these arguments; a solver's is its only one, and elements have no name."""
    alone = given.keys() & {"number", "elements", "dtype"}
    return function(*given.values()) if alone else function(**given)


OF_OTHER_SHAPES = {"linearise(ctrl: None)", "rollout(state: batched)", "load(source: no joints)"}
PYTHON = "inspect.py"  # which says that an argument is missing, or one too many
CONTROL = lambda t, s: -s.v[:1]  # noqa: E731
SOURCES = {
    "misspelt": "pendulom", "None": None, "number": 3, "no XML": "<mujoco>", "no file": "a.xml",
    "a folder": "/tmp", "bytes": b"<mujoco/>", "empty": "", "a model": MODEL, "list": [],
    "no URDF": "<robot>", "no joints": "<mujoco><worldbody/></mujoco>", "binary": "\0",
}  # fmt: skip
JOINTS = {
    "misspelt": ("slidr", "hinge"), "beyond": (0, 9), "before": (-1, -2), "None": None,
    "a word": "slider", "halves": (0.5, 1.5), "a list": [0, 1], "of bools": (True, False),
    "of None": (None, None), "one": (0,), "three": (0, 1, 0), "number": 3,
}  # fmt: skip
KINDS = {**NAMES, "without a pitch": "hinge", "of other size": "ball"}
DTYPES = {"int": int, "complex": complex, "a word": "flot", "None": None, "a number": 3,
          "bool": bool, "object": object, "an array": np.ones(2), "half": jnp.float16}  # fmt: skip
ELEMENTS = {
    "None": None, "a word": "spring", "a class": F.PointSpring, "a function": lambda now: 0.0,
    "a list": [F.Place.on()], "an anchor": F.Place.on(), "a number": 3.0,
}  # fmt: skip


def wrong_with(what: str, call: Callable, good: Callable) -> str | None:
    """The problem with the result of a bad call, or None."""
    try:
        got = call()
    except rb.RbjaxError as error:
        return None if len(str(error)) > 30 else f"says only {str(error)!r}"
    except Exception as error:
        raised = traceback.extract_tb(error.__traceback__)[-1]
        ours = "rbjax" in raised.filename and str(raised.line).startswith("raise")
        known = isinstance(error, (TypeError, ValueError)) and (ours or PYTHON in raised.filename)
        told = known or "simulate: integration failed" in str(error)
        return None if told and len(str(error)) > 30 else f"{type(error).__name__}: {error}"
    if isinstance(got, rb.Trajectory) and not got.success.all():
        return None  # it says so
    want = good()
    leaves, wanted = jax.tree.leaves(got), jax.tree.leaves(want)
    shapes, due = ([np.shape(x) for x in y] for y in (leaves, wanted))
    if shapes != due and what not in OF_OTHER_SHAPES:
        return f"gives shapes {shapes}, not {due}"
    free = np.isinf if isinstance(got, rb.Model) else np.zeros_like  # no limit is an endless one
    for x in map(np.asarray, leaves):
        if x.dtype.kind == "f" and not (np.isfinite(x) | np.asarray(free(x), bool)).all():
            return f"gives {x}"
    return None
