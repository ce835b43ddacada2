"""More than a hundred bad files: each raises a clear error, or is a robot that moves.

The files are bundled scenes and small ones, broken by hand and by a random number generator with a
fixed seed. `load` gives either a model with finite dynamics or an error of rbjax.
"""

import dataclasses
import random
import re
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import loading
from tests.loading.test_load import joint, link, mjcf, urdf
from tests.robots import SMALL

SCENES = Path(loading.__file__).parent / "scenes"
ARM = urdf(link("base", 3), link("arm"), link("hand"), joint("elbow", "base", "arm", "continuous"),
           joint("wrist", "arm", "hand", "prismatic"))  # fmt: skip
BODY = '<body name="{}"><joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>{}</body>'

# ---------------------------------------------------------------------------- broken by hand


def swap(text: str, old: str, new: str, count: int = 1) -> str:
    assert old in text, old
    return text.replace(old, new, count)


def nested(depth: int) -> str:
    inside = ""
    for k in range(depth):
        inside = BODY.format(f"b{k}", inside)
    return mjcf(inside)


def chained(n: int) -> str:
    joints = [joint(f"j{k}", f"l{k - 1}", f"l{k}") for k in range(1, n)]
    return urdf(*(link(f"l{k}") for k in range(n)), *joints)


HAND: dict[str, Any] = {
    "empty": "",
    "blank": " \n\t",
    "zeros": b"\0" * 100,
    "binary": bytes(range(256)) * 4,
    "utf-16 of MJCF": mjcf(BODY.format("b", "")).encode("utf-16"),
    "latin-1 undeclared": mjcf(BODY.format("é", "")).encode("latin-1"),
    "an encoding that there is not": b'<?xml version="1.0" encoding="klingon"?>' + ARM.encode(),
    "another encoding than declared": b'<?xml version="1.0" encoding="utf-16"?><a/>',
    "a byte order mark": b"\xef\xbb\xbf" + mjcf(BODY.format("b", "")).encode(),
    "text": "a robot with two arms",
    "json": '{"robot": {"links": 3}}',
    "yaml": "robot:\n  - link: base",
    "html": "<!DOCTYPE html><html><body/></html>",
    "sdf": '<sdf version="1.7"><model name="m"/></sdf>',
    "two roots": ARM + ARM,
    "an entity": '<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"><link name="l"/></robot>',
    "entities without end": '<!DOCTYPE r [<!ENTITY a "&b;"><!ENTITY b "&a;">]><robot>&a;</robot>',
    "a comment without end": "<mujoco><!-- </mujoco>",
    "xacro": swap(ARM, "<robot", '<robot xmlns:xacro="http://ros.org"').replace(
        "</robot>", '<xacro:arm side="left"/></robot>'),
    "xacro's expressions": ARM.replace('value="1.0"', 'value="${m * 2}"'),
    "an empty world": mjcf(),
    "only mujoco": "<mujoco/>",
    "only robot": "<robot/>",
    "an include that is nowhere": '<mujoco><include file="gone.xml"/></mujoco>',
    "an include of nothing": "<mujoco><include/></mujoco>",
    "deep": nested(300),
    "too deep": nested(900),
    "a long chain": chained(1500),
    "a huge name": mjcf(BODY.format("n" * 100_000, "")),
    "an empty name": mjcf(BODY.format("", "")),
    "a body named world": mjcf(BODY.format("world", "")),
    "names with markup": mjcf(BODY.format("&lt;a&gt;&#10;", "")),
    "one name twice": mjcf(BODY.format("b", ""), BODY.format("b", "")),
    "one joint name twice": mjcf(*[BODY.format(k, "").replace("<joint", '<joint name="j"')
                                  for k in "ab"]),
    "an unknown class": mjcf(BODY.format("b", "").replace("<joint", '<joint class="gone"')),
    "an unknown joint": mjcf(BODY.format("b", "").replace("<joint", '<joint type="screw"')),
    "an actuator of nothing": mjcf(extra='<actuator><motor joint="gone"/></actuator>'),
    "an actuator without a target": mjcf(extra="<actuator><motor/></actuator>"),
    "a tendon of nothing": mjcf(extra="<tendon><spatial/></tendon>"),
    "an equality of nothing": mjcf(extra='<equality><weld body1="gone"/></equality>'),
    "a short keyframe": mjcf(BODY.format("b", ""), extra='<keyframe><key qpos="1 2"/></keyframe>'),
    "a keyframe of nan": mjcf(BODY.format("b", ""), extra='<keyframe><key qvel="nan"/></keyframe>'),
    "a free joint below": mjcf(BODY.format("a", BODY.format("b", "").replace(
        "<joint", "<freejoint"))),
    "two free joints": mjcf(BODY.format("a", "").replace("<joint/>", "<freejoint/>" * 2)),
    "seven slides": mjcf(BODY.format("a", "").replace("<joint/>", "".join(
        f'<joint type="slide" axis="{k} 1 {k * k}"/>' for k in range(7)))),
    "two hinges on one line": mjcf(BODY.format("a", "").replace("<joint/>", "<joint/>" * 2)),
    "a zero quaternion": mjcf(swap(BODY.format("b", ""), "<body", '<body quat="0 0 0 0"')),
    "a zero axis": mjcf(swap(BODY.format("b", ""), "<joint", '<joint axis="0 0 0"')),
    "a range upside down": mjcf(swap(BODY.format("b", ""), "<joint", '<joint range="1 -1"')),
    "no timestep": mjcf(BODY.format("b", ""), extra='<option timestep="0"/>'),
    "time backwards": mjcf(BODY.format("b", ""), extra='<option timestep="-1"/>'),
    "an endless timestep": mjcf(BODY.format("b", ""), extra='<option timestep="inf"/>'),
    "endless gravity": mjcf(BODY.format("b", ""), extra='<option gravity="0 0 -inf"/>'),
    "a negative density": mjcf(BODY.format("b", ""), extra='<option density="-1"/>'),
    "an endless density": mjcf(BODY.format("b", ""), extra='<option density="inf"/>'),
    "a wind of nan": mjcf(BODY.format("b", ""), extra='<option wind="nan 0 0" density="1"/>'),
    "damping of nan": mjcf(swap(BODY.format("b", ""), "<joint", '<joint damping="nan"')),
    "polynomials of nan": mjcf(swap(BODY.format("b", ""), "<joint", '<joint damping="1 nan"')),
    "an endless stiffness": mjcf(swap(BODY.format("b", ""), "<joint", '<joint stiffness="inf"')),
    "endless compensation": mjcf(swap(BODY.format("b", ""), "<body", '<body gravcomp="inf"')),
    "compensation of nan": mjcf(swap(BODY.format("b", ""), "<body", '<body gravcomp="nan"')),
    "an endless armature": mjcf(swap(BODY.format("b", ""), "<joint", '<joint armature="inf"')),
    "a negative armature": mjcf(swap(BODY.format("b", ""), "<joint", '<joint armature="-9"')),
    "a huge mass": mjcf(swap(BODY.format("b", ""), 'mass="1"', 'mass="1e300"')),
    "no inertia": mjcf(swap(BODY.format("b", ""), "1 1 1", "0 0 0")),
    "a negative inertia": mjcf(swap(BODY.format("b", ""), "1 1 1", "-1 1 1")),
    "a triangle broken": mjcf(swap(BODY.format("b", ""), "1 1 1", "1 1 3")),
    "four numbers for three": mjcf(swap(BODY.format("b", ""), "1 1 1", "1 1 1 1")),
    "two numbers for three": mjcf(swap(BODY.format("b", ""), "1 1 1", "1 1")),
    "words for numbers": mjcf(swap(BODY.format("b", ""), "1 1 1", "one one one")),
    "a mesh that is nowhere": mjcf(swap(BODY.format("b", ""), "</body>",
                                        '<geom type="mesh" mesh="gone"/></body>')),
    "a filter of nan": swap(SMALL, "<motor name", '<general joint="slide" dyntype="filter" '
                            'dynprm="nan"/><motor name'),
    "a spring of nan": swap(SMALL, "</mujoco>", '<tendon><spatial stiffness="nan"><site '
                            'site="tip"/><site site="tip"/></spatial></tendon></mujoco>'),
    "urdf: no link": "<robot name='r'><joint name='j'/></robot>",
    "urdf: a link without a name": urdf("<link/>"),
    "urdf: a joint without a name": swap(ARM, 'name="elbow" ', ""),
    "urdf: a joint without a type": swap(ARM, ' type="continuous"', ""),
    "urdf: a joint without a parent": swap(ARM, '<parent link="base"/>', ""),
    "urdf: a parent that is nowhere": swap(ARM, 'parent link="base"', 'parent link="gone"'),
    "urdf: its own parent": swap(ARM, 'parent link="base"', 'parent link="arm"'),
    "urdf: a cycle": swap(ARM, 'parent link="base"', 'parent link="hand"'),
    "urdf: two parents": swap(ARM, "</robot>", joint("more", "base", "hand") + "</robot>"),
    "urdf: one name twice": swap(ARM, 'link name="hand"', 'link name="arm"'),
    "urdf: one joint name twice": swap(ARM, 'name="wrist"', 'name="elbow"'),
    "urdf: an unknown joint": swap(ARM, "prismatic", "screw"),
    "urdf: a zero axis": swap(ARM, '<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'),
    "urdf: an axis of nan": swap(ARM, '<axis xyz="0 1 0"/>', '<axis xyz="nan 1 0"/>'),
    "urdf: an origin of nan": swap(ARM, 'xyz="0 0 1"', 'xyz="nan 0 1"'),
    "urdf: an endless origin": swap(ARM, 'xyz="0 0 1"', 'xyz="inf 0 1"'),
    "urdf: no mass": re.sub(r'mass value="[\d.]*"', 'mass value="0"', ARM),
    "urdf: negative mass": re.sub(r'mass value="[\d.]*"', 'mass value="-1"', ARM),
    "urdf: mass of nan": re.sub(r'mass value="[\d.]*"', 'mass value="nan"', ARM),
    "urdf: zero inertia": re.sub(r'i(..)="[\d.]*"', r'i\1="0"', ARM),
    "urdf: negative inertia": re.sub(r'i(..)="0.1"', r'i\1="-0.1"', ARM),
    "urdf: limits of nan": swap(ARM, 'lower="-1"', 'lower="nan"'),
    "urdf: limits upside down": swap(ARM, 'lower="-1" upper="1"', 'lower="1" upper="-1"'),
    "urdf: a mimic of nothing": swap(ARM, "</joint>", '<mimic joint="gone"/></joint>'),
}  # fmt: skip

# ---------------------------------------------------------------------------- broken at random


def _words(text: str) -> list[re.Match]:
    return list(re.finditer(r'="([^"]*)"', text))


def cut(text: str, rng: random.Random) -> str:
    return text[: rng.randrange(1, len(text))]


def number(text: str, rng: random.Random) -> str:
    """A number replaced by something else."""
    found = [m for m in re.finditer(r'(?<=[" ])-?\d[\d.e-]*(?=[" ])', text)]
    at = rng.choice(found)
    new = rng.choice(["nan", "inf", "-inf", "-1", "0", "1e308", "1e-308", "", "x", "1,5", "0x10"])
    return text[: at.start()] + new + text[at.end() :]


def tag(text: str, rng: random.Random) -> str:
    at = rng.choice(list(re.finditer(r"<(\w+)", text)))
    new = rng.choice(["body", "joint", "geom", "nonsense"])
    return text[: at.start(1)] + new + text[at.end(1) :]


def name(text: str, rng: random.Random) -> str:
    """A word of the file replaced by another one."""
    words = _words(text)
    at, other = rng.choice(words), rng.choice(words)
    return text[: at.start(1)] + other[1] + text[at.end(1) :]


def lines(text: str, rng: random.Random) -> str:
    """An element removed, or repeated."""
    parts = re.split(r"(?=<)", text)
    at = rng.randrange(1, len(parts))
    parts[at : at + 1] = [parts[at]] * rng.choice([0, 2])
    return "".join(parts)


def noise(text: str, rng: random.Random) -> bytes:
    raw = bytearray(text.encode())
    for _ in range(5):
        raw[rng.randrange(len(raw))] = rng.randrange(256)
    return bytes(raw)


WAYS: tuple[Callable, ...] = (cut, number, number, number, tag, name, name, lines, noise)


def files() -> dict[str, str | bytes]:
    """The broken files by name."""
    scenes = {p.stem: p.read_text() for p in sorted(SCENES.glob("*.xml"))}
    sources = scenes | {"small": SMALL, "arm.urdf": ARM, "arm2.urdf": ARM}
    out, rng = dict(HAND), random.Random(0)
    for k in range(60):
        source, way = rng.choice([*sources]), WAYS[k % len(WAYS)]
        out[f"{source} {k}: {way.__name__}"] = way(sources[source], rng)
    return out


FILES = files()


def told(path: Path) -> rb.Model | None:
    """The model, or None of a file of which a sentence says that it does not move."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            model = rb.load(path)
        except rb.RbjaxError as error:
            assert len(str(error)) > 30
            assert "\n" not in str(error)
            return None
    return None if any("move no mass" in str(w.message) for w in said) else model


@jax.jit
def accelerations(model, q, v):
    state = rb.State(q, v, model.start(q.dtype))
    return rb.forward_dynamics(model, q, v, rb.applied_forces(model, state, jnp.ones(model.nu)))


def check_that_it_moves(model: rb.Model) -> None:
    """Small ones here, whose programs are soon compiled; of all, that every number is one."""
    for at, leaf in jax.tree_util.tree_leaves_with_path(model):
        name = jax.tree_util.keystr(at)
        assert not np.isnan(leaf).any(), name
        assert name.endswith(("range", "limits")) or np.isfinite(leaf).all(), name
    if 0 < model.nv <= 2:
        model = dataclasses.replace(model, dropped=())
        assert np.isfinite(accelerations(model, model.default_state().q, jnp.ones(model.nv))).all()


@pytest.mark.parametrize("part", range(4))
def test_every_bad_file_is_refused_or_is_a_robot(
    part: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log of warnings
    for k, which in enumerate(FILES):
        if k % 4 == part:
            content, path = FILES[which], tmp_path / f"{k}.xml"
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
            try:
                model = told(path)
                if model is not None:
                    check_that_it_moves(model)
            except Exception as error:
                raise AssertionError(f"{which}: {type(error).__name__}: {error}") from error


def test_there_are_enough_of_them() -> None:
    assert len(FILES) >= 120


@pytest.mark.filterwarnings("ignore:Inertia matrix")  # MuJoCo's own, which names no joint
def test_joints_that_undo_each_other_are_named() -> None:
    with pytest.warns(UserWarning, match="together move no mass: joint0, joint1; the mass matrix"):
        rb.load(HAND["two hinges on one line"])
    held = HAND["two hinges on one line"].replace("<joint/>", '<joint armature="0.1"/>', 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rb.load(held)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_a_crowd_is_refused_before_it_takes_hours(kind: str) -> None:
    n = 100_000
    if kind == "mjcf":
        text = mjcf(*(BODY.format(f"b{k}", "") for k in range(n)))
    else:
        spokes = (joint(f"j{k}", "l0", f"l{k}") for k in range(1, n))
        text = urdf(*(link(f"l{k}") for k in range(n)), *spokes)
    start = time.perf_counter()
    with pytest.raises(rb.ModelError, match="got 100,000 bodies, expected at most 20,000"):
        rb.load(text)
    assert time.perf_counter() - start < 30
