"""Bad job files, generated: each is named by an error of rbjax, none is accepted in silence."""

import string

import hypothesis
import pytest
from hypothesis import strategies as st

import rbjax as rb
from rbjax.sysid.jobs.example import write_example
from rbjax.sysid.jobs.job import Job
from rbjax.sysid.jobs.keys import KEYS


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    return write_example(tmp_path_factory.mktemp("job"))


TEXT = st.text(string.ascii_letters + " _-:.[]{}\"'/\\", max_size=12)
NOT_NUMBERS = st.sampled_from([True, False, "", "1", [], ["a"], {}, {"a": 1}])
NOT_FINITE = st.sampled_from([float("nan"), float("inf"), -float("inf")])
NOT_TEXT = st.sampled_from([1, 1.5, True, [], [1], {}, float("nan"), ""])
BELOW = st.floats(-1e9, -1e-9) | st.integers(-(10**9), -1)
UNKNOWN = TEXT.map(lambda x: f"no {x}")
BAD = {  # kind -> values that no key of this kind can have
    "text": NOT_TEXT | UNKNOWN,
    "texts": NOT_TEXT | UNKNOWN | st.just(["", "a"]),
    "factor": NOT_NUMBERS | NOT_FINITE | st.just(0),
    "positive": NOT_NUMBERS | NOT_FINITE | BELOW | st.just(0) | st.just([1.0]),
    "not negative": NOT_NUMBERS | NOT_FINITE | BELOW | st.just(1e9),
    "numbers": NOT_NUMBERS | NOT_FINITE | st.just([1.0, 2.0, 3.0]) | st.just([1.0, "a"]),
    "positives": NOT_NUMBERS | NOT_FINITE | BELOW | st.just([1.0, -1.0]),
    "count": NOT_NUMBERS | NOT_FINITE | BELOW | st.just(0) | st.floats(1.1, 1.9) | st.just(1e300),
    "integer": NOT_NUMBERS | NOT_FINITE | BELOW | st.floats(1.1, 1.9),
    "yes": st.sampled_from([0, 1, "yes", "true", "", [], {}, float("nan")]),
    "true": st.sampled_from([False, 1, "true", [], 5]),
    "sign": NOT_NUMBERS | NOT_FINITE | st.sampled_from([0, 5, -2, 0.5]),
    "unit": st.sampled_from([1, True, [], "furlong", "degrees", "s^2", "rad deg", "N.m"]),
    "index": st.sampled_from([1.5, True, {}, [], [[]], "nobody", 99, -99, ["nobody", 2], [0, 0]]),
    "bounds": st.sampled_from([5, [1], [2, 1], [1, 1], ["a", "b"], [1, 2, 3], "x", {}, [True, 2],
                               [float("nan"), 1.0], [1.0, float("nan")], [10.0, 20.0]]),
    "prior": st.sampled_from([5, [1], [1, 0], [1, -1], ["a", "b"], [1, 2, 3], "x", {}, [True, 2]]),
    "loss": st.sampled_from([3, "l1", "", True, ["huber"]]),
    "decimal": st.sampled_from([3, ";", "", True, [","]]),
    "character": st.sampled_from([3, "", "ab", True, []]),
}  # fmt: skip


def toml(x):
    if isinstance(x, bool):
        return str(x).lower()
    if isinstance(x, str):
        return '"' + x.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(x, list):
        return f"[{', '.join(map(toml, x))}]"
    if isinstance(x, dict):
        return "{" + ", ".join(f"{toml(k)} = {toml(v)}" for k, v in x.items()) + "}"
    return repr(x)


def given():
    q = {"sensor": "q", "unit": "deg"}
    return {
        "": {"model": "arm.xml"},
        "recordings": {"fit": ["run1.csv"], "held_out": ["run3.csv"]},
        "columns": {
            "shoulder angle": q | {"joint": "shoulder"},
            "elbow angle": q | {"joint": "elbow"},
            "shoulder torque": {"sensor": "ctrl", "joint": "shoulder"},
            "elbow torque": {"sensor": "ctrl", "joint": "elbow"},
        },
        "unknowns": {"mass": {"leaf": "bodies.mass", "index": "fore"}},
        "controller": {},
        "options": {},
        "output": {"folder": "found"},
    }


def written(tables):
    lines = []
    for table, inside in tables.items():
        lines += [f"[{table}]"] if table else []
        lines += [f"{toml(key) if table else key} = {toml(x)}" for key, x in inside.items()]
    return "\n".join(lines) + "\n"


@st.composite
def bad_jobs(draw):
    """The text of a job file with one thing wrong."""
    tables = given()
    what = draw(st.sampled_from(["value"] * 6 + ["key", "table", "missing", "text", "cut"]))
    places = [(table, key) for table, keys in KEYS.items() for key in keys if table != "sensors"]
    table, key = draw(st.sampled_from(places))
    inside = tables[table]
    if table in ("columns", "unknowns"):
        inside = inside[draw(st.sampled_from(sorted(inside)))]
    if what == "value":
        if key in ("bounds", "scale", "positive", "index") and table == "unknowns":
            inside.pop("index", None)
        if key in ("inertia", "tilt"):
            inside.clear()
        inside[key] = draw(BAD[KEYS[table][key]])
        hypothesis.assume(inside[key] != [] or key not in ("held_out",))
        # any text of these may be right
        text = isinstance(inside[key], str) and inside[key].strip()
        hypothesis.assume(not (key in ("comment", "folder") and text))
        if key == "longest_delay":
            inside["delay"] = 0.01
    elif what == "key":
        inside[f"{key}_{draw(st.sampled_from('abc'))}"] = 1
    elif what == "table":
        tables[draw(st.sampled_from(["recording", "column", "option", "control"]))] = {"a": 1}
    elif what == "missing":
        tables.pop(draw(st.sampled_from(["", "recordings", "columns", "unknowns"])))
    text = written(tables)
    if what == "cut":
        end = draw(st.integers(0, text.index('"mass"')))
        return text[:end]
    if what == "text":
        at = draw(st.integers(0, len(text)))
        return text[:at] + draw(st.sampled_from(['"', "]", "[[", "=", "\x00", "{"])) + text[at:]
    return text


def never_bare(run):
    """An error of rbjax with a message of a length to read."""
    try:
        run()
    except rb.RbjaxError as error:
        assert 25 < len(str(error)) < 1500, str(error)
        return
    raise AssertionError("accepted")


MANY = hypothesis.settings(
    max_examples=150, derandomize=True, deadline=None, database=None,
    suppress_health_check=list(hypothesis.HealthCheck),
)  # fmt: skip


def bad_job(example, text):
    path = example.with_name("bad.toml")
    path.write_text(text)
    never_bare(lambda: Job.read(path))


def test_the_file_that_is_spoilt_is_good(example):
    path = example.with_name("good.toml")
    path.write_text(written(given()))
    Job.read(path)


@MANY
@hypothesis.given(text=bad_jobs())
def test_150_bad_job_files_are_named(example, text):
    bad_job(example, text)


@pytest.mark.parametrize(
    "content",
    [b"\xff\xfe\x00", b"", b"a = " + b"[" * 5000 + b"]" * 5000, b"model = 9" + b"9" * 5000],
    ids=["binary", "empty", "deep", "long integer"],
)
def test_files_that_are_not_toml_are_named(example, content):
    path = example.with_name("bad.toml")
    path.write_bytes(content)
    never_bare(lambda: Job.read(path))
    never_bare(lambda: Job.read(example.parent))
