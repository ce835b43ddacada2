"""`rb.contact.with_geom`: a geom added to a model is the geom of a file."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.tolerances import F64_TRANSFORM

FILE = """
<mujoco><option cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1" friction="0.7"/>
  <body name="fixed" pos="1 0 0"/>
  <body name="arm" pos="0 0 0.3"><joint axis="0 1 0"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
    <geom name="upper" type="capsule" size="0.05 0.1" mass="0"/>
    <body name="grip" pos="0.3 0 0">
      <body name="hand" pos="0.2 0 0"><joint axis="0 1 0"/>
        <inertial pos="0 0 0" mass="0.5" diaginertia="0.1 0.1 0.1"/>{geom}</body></body></body>
  <body name="ball" pos="0.5 0 0.49"><freejoint/>
    <geom name="ball" type="sphere" size="0.1" mass="1"/></body>
</worldbody>{contact}</mujoco>"""
EXCLUDE = '<contact><exclude body1="{one}" body2="{other}"/></contact>'
NEW = """<geom name="pad" type="{kind}" size="0.1 0.05 0.2" pos="0 0 -0.22" quat="1 0.1 0 0"
  mass="0" friction="0.5 0.01 0.001" condim="4" solref="0.03 0.9" margin="0.01" contype="{bit}"
  conaffinity="{bit}" priority="1"/>"""


def both(kind: str, bit: int, contact: str = "") -> tuple[rb.Model, rb.Model]:
    """The model with an added geom, and that of a file with the geom."""
    want = rb.load(FILE.format(geom=NEW.format(kind=kind, bit=bit), contact=contact))
    last = want.geoms.names.index("pad")
    model = rb.contact.with_geom(
        rb.load(FILE.format(geom="", contact=contact)), "pad", "hand", kind, want.geoms.size[last],
        position=(0, 0, -0.22), orientation=want.geoms.orientation[last],
        friction=(0.5, 0.01, 0.001), condim=4, solref=(0.03, 0.9), margin=0.01, contype=bit,
        conaffinity=bit, priority=1,
    )  # fmt: skip
    return model, want


@pytest.mark.parametrize(("kind", "bit"), [("sphere", 1), ("box", 1), ("capsule", 2)])
def test_geoms_and_pairs_are_those_of_a_file(kind: str, bit: int) -> None:
    model, want = both(kind, bit)
    place = [want.geoms.names.index(x) for x in model.geoms.names]
    for key in ("size", "position", "orientation", "friction", "solref", "solimp", "margin"):
        x, y = getattr(model.geoms, key), getattr(want.geoms, key)[np.array(place)]
        np.testing.assert_allclose(x, y, atol=F64_TRANSFORM)
    for key in ("types", "bodies", "contype", "condim", "priority", "rgba", "group"):
        assert getattr(model.geoms, key) == tuple(getattr(want.geoms, key)[k] for k in place)
    assert pairs_by_name(model) == pairs_by_name(want)
    assert len(model.geoms.pairs) == len(want.geoms.pairs)
    kinds = [tuple(model.geoms.types[g] for g in pair) for pair in model.geoms.pairs]
    assert set(kinds) <= set(rb.contact.pairs())


@pytest.mark.parametrize(("one", "other"), [("hand", "ball"), ("ball", "hand"), ("world", "hand")])
def test_excluded_bodies_of_the_file_do_not_touch(one: str, other: str) -> None:
    """Also not after the model is written to a file and read back."""
    contact = EXCLUDE.format(one=one, other=other)
    model, want = both("sphere", 1, contact)
    assert pairs_by_name(model) == pairs_by_name(want) < pairs_by_name(both("sphere", 1)[0])
    read = rb.load(rb.write_mjcf(rb.load(FILE.format(geom="", contact=contact))))
    read = rb.contact.with_geom(read, "pad", "hand", "sphere", 0.1)
    assert pairs_by_name(read) == pairs_by_name(want)


def pairs_by_name(model: rb.Model) -> set[frozenset[str]]:
    return {frozenset(model.geoms.names[g] for g in pair) for pair in model.geoms.pairs}


def test_the_acceleration_is_that_of_a_file() -> None:
    model, want = both("sphere", 1)
    state = want.default_state()
    found = rb.acceleration(model, state)
    np.testing.assert_allclose(found, rb.acceleration(want, state), atol=1e-9)
    free = rb.acceleration(model.replace(contact=None), state)
    assert np.abs(found - free).max() > 1.0  # the contact acts


def test_a_model_without_geoms() -> None:
    """Contact is switched on; the numbers of the geom have derivatives."""
    model = rb.load("pendulum").replace(geoms=None, contact=None)
    model = rb.contact.with_geom(model, "bob", "rod", "sphere", 0.1, position=(0, 0, -1))
    assert model.contact is None and model.geoms.pairs == ()
    model = rb.contact.with_geom(model, "floor", "world", "plane", [0, 0, 1], position=(0, 0, -2))
    assert model.contact == "mujoco" and model.geoms.pairs == ((1, 0),)

    def height(r):
        one = rb.contact.with_geom(model, "foot", "rod", "sphere", r, position=(0, 0, -1))
        return rb.contact.detect(one, one.default_state().q, reach=jnp.inf).distance[1]

    assert jax.grad(height)(0.2) == pytest.approx(-1.0)


WRONG = {
    "name is 'floor', expected a new name": ("floor", "hand", "sphere", 0.1, {}),
    "unknown body 'foot'": ("x", "foot", "sphere", 0.1, {}),
    "unknown kind of geom 'cone'": ("x", "hand", "cone", 0.1, {}),
    "unknown attribute of a geom 'mass'": ("x", "hand", "sphere", 0.1, {"mass": 1.0}),
    "the plane 'x' is on 'hand', expected a fixed body": ("x", "hand", "plane", [1, 1, 1], {}),
    "size has shape (1,), expected (3,) for a box": ("x", "hand", "box", 0.1, {}),
    "the size of the sphere 'x' is [-0.1]": ("x", "hand", "sphere", -0.1, {}),
    "got nan at [0], expected finite": ("x", "hand", "sphere", float("nan"), {}),
    "orientation is zero": ("x", "hand", "sphere", 0.1, {"orientation": np.zeros(4)}),
    "position=...): got shape (2,)": ("x", "hand", "sphere", 0.1, {"position": (0, 0)}),
    "expected 1, 3, 4 or 6": ("x", "hand", "sphere", 0.1, {"condim": 2}),
    "got -1.0, expected numbers of at least 0": (
        "x", "hand", "sphere", 0.1, {"friction": -np.ones(3)}
    ),
}  # fmt: skip


@pytest.mark.parametrize("sentence", WRONG)
def test_wrong_arguments_are_sentences(sentence: str) -> None:
    *given, attributes = WRONG[sentence]
    with pytest.raises((rb.InputError, rb.UnknownName), match=re.escape(sentence)):
        rb.contact.with_geom(rb.load(FILE.format(geom="", contact="")), *given, **attributes)


def test_a_pair_without_narrow_phase_is_left_out() -> None:
    model = rb.load(FILE.format(geom="", contact=""))
    with pytest.warns(UserWarning, match=r"ellipsoid 'x' has no narrow phase with \['ball'\]"):
        model = rb.contact.with_geom(model, "x", "hand", "ellipsoid", [0.1, 0.1, 0.2])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rb.contact.detect(model, model.default_state().q)
