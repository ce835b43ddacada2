"""Wrong arguments of `ModelBuilder`: one sentence each, before anything is added."""

import re

import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import RbjaxError

QUATERNION = "orientation is a zero quaternion"
GOOD = {
    "add_body": {"name": "b", "parent": "a", "mass": 1.0, "inertia": [0.1, 0.1, 0.1]},
    "add_joint": {"name": "k", "body": "a", "axis": [0, 1, 0]},
    "add_geom": {"name": "g", "body": "a", "kind": "sphere", "size": 0.1},
    "add_site": {"name": "s", "body": "a"},
    "add_motor": {"name": "m", "joint": "j"},
    "attach": {"source": "pendulum", "prefix": "p_"},
    "lock": {"joint": "j"},
}
NAMES = {"": "expected a word", None: "expected a word", 3: "expected a word"}
#: method -> argument -> bad values and a part of the sentence
BAD = {
    "add_body": {
        "name": [*NAMES.items(), ("a", "the name of another body"), ("world", "another body")],
        "parent": [("zz", "known names"), (3, "known names")],
        "mass": [(-1.0, "of at least 0"), (np.nan, "finite"), ("a", "numbers"), ([1], "shape")],
        "inertia": [("a", "numbers"), ([1, 1], "expected 3"), (np.triu(np.eye(3) + 1), "sym")],
        "orientation": [(np.zeros(4), QUATERNION), ([1, 0, 0], "expected 4")],
    },
    "add_joint": {
        "name": [*NAMES.items(), ("j", "the name of another joint")],
        "body": [("zz", "known names"), (3, "known names")],
        "kind": [("hing", "did you mean"), (None, "known names")],
        "range": [([1, -1], "below the upper one"), ([1, 1], "below the upper one"), (1.0, "axes")],
        "damping": [("a", "real numbers"), ([1, 2], "expected a number"), (np.nan, "finite")],
        "dampng": [(1.0, "did you mean")],
    },
    "add_geom": {
        "name": [*NAMES.items(), ("round", "the name of another geom")],
        "kind": [("spher", "did you mean"), ("mesh", "known names")],
        "size": [("a", "numbers"), ([1, 2, 3, 4], "1 to 3"), ([[1]], "1 to 3"), ([], "1 to 3")],
        "friction": [(0.5, "axes"), ([-1, 0, 0], "at least 0"), ([1, 2], "expected 3")],
        "frictin": [(1.0, "did you mean 'friction'")],
        "density": [(-1.0, "at least 0"), (np.nan, "finite")],
        "mass": [(-1.0, "at least 0"), (np.nan, "finite")],
        "contype": [(1.5, "integer"), (2**40, "integer")],
        "condim": [("3", "integer")],
        "rgba": [("red", "(4,) numbers"), ([1, 1], "expected 4")],
        "material": [(3, "expected a name")],
        "orientation": [(np.zeros(4), QUATERNION)],
    },
    "add_site": {
        "name": [*NAMES.items(), ("tip", "the name of another site")],
        "orientation": [(np.zeros(4), QUATERNION)],
    },
    "add_motor": {
        "name": [*NAMES.items(), ("motor", "the name of another actuator")],
        "joint": [("zz", "known names"), (None, "known names")],
        "gear": [("a", "real numbers"), ([1, 2], "expected a number"), (np.nan, "finite")],
        "ctrlrange": [([1, -1], "below the upper"), ([0, 0], "no limits"), (1.0, "axes")],
    },
    "attach": {"prefix": [(3, "expected a word")], "orientation": [(np.zeros(4), QUATERNION)]},
    "lock": {"joint": [(None, "known names")], "q": [(np.nan, "axes"), ([1, 2], "expected 1")]},
}  # fmt: skip


def builder() -> rb.ModelBuilder:
    made = rb.ModelBuilder()
    made.add_body("a", mass=1.0, inertia=[0.1, 0.1, 0.1])
    made.add_joint("j", "a")
    made.add_geom("round", "a", "sphere", 0.1)
    made.add_site("tip", "a")
    made.add_motor("motor", "j")
    return made


@pytest.mark.parametrize("method", BAD)
def test_sentence(method: str) -> None:
    before = builder().spec.to_xml()
    for argument, cases in BAD[method].items():
        for value, part in cases:
            made = builder()
            with pytest.raises(RbjaxError, match=re.escape(part)):
                getattr(made, method)(**GOOD[method] | {argument: value})
            assert made.spec.to_xml() == before, f"{method}({argument}={value!r})"


@pytest.mark.parametrize("method", GOOD)
def test_the_good_call(method: str) -> None:
    getattr(builder(), method)(**GOOD[method])


def test_timestep() -> None:
    for value in (0.0, -1.0, np.nan, "a", True):
        with pytest.raises(RbjaxError, match="timestep is"):
            rb.ModelBuilder(timestep=value)
