"""Wrong input of beams: one sentence each."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import InputError, RbjaxError, UnknownName, UnsupportedFeature
from tests.flexible.beams import round_beam

flexible = rb.flexible
WORLD = rb.load("<mujoco/>")
ROUND = {"E": 1e8, "nu": 0.3, "density": 1e3}
BENDING = [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]


def planar(degrees=None, **given):
    """A beam of a given stiffness."""
    given = {"mass": 0.1} | given
    return flexible.beam(1.0, BENDING, degrees or {"k_y": 1}, **given)


SECTIONS = {
    "radius is 0.0, expected a number above zero": lambda: flexible.circle(0.0, **ROUND),
    "width is -0.1": lambda: flexible.rectangle(-0.1, 0.1, **ROUND),
    "density is 0.0": lambda: flexible.circle(0.1, E=1e8, nu=0.3, density=0.0),
    "inner is 0.02 and outer 0.01": lambda: flexible.tube(0.01, 0.02, **ROUND),
    "expected a ratio above -1 and up to 1/2": lambda: flexible.circle(
        0.1, E=1e8, nu=0.7, density=1e3
    ),
    "width is 0.0": lambda: flexible.rectangle(0.0, 0.1, **ROUND),
    "inner is 0.01 and outer 0.01": lambda: flexible.tube(0.01, 0.01, **ROUND),
    "radius is [0.01, 0.0]": lambda: flexible.circle(np.array([0.01, 0.0]), **ROUND),
    "stiffness is zero, expected at least one entry above zero": lambda: flexible.section(
        [0.0] * 6, 1.0, (0.0, 0.0, 0.0)
    ),
    "E is nan": lambda: flexible.circle(0.1, E=np.nan, nu=0.3, density=1e3),
}
BEAMS = {
    "length is 0.0": lambda: round_beam(length=0.0),
    "length is -1.0, expected a number above zero": lambda: round_beam(length=-1.0),
    "length is nan": lambda: round_beam(length=np.nan),
    "length has the shape (2,), expected one number": lambda: round_beam(length=np.ones(2)),
    "the section have the shape (3,), expected () for a uniform beam or (4,)": lambda: (
        flexible.beam(1.0, flexible.circle(np.full(3, 0.01), **ROUND), {"k_y": 1}, points=4)
    ),
    "stiffness[1] is nan": lambda: flexible.beam(1.0, [0, np.nan, 1, 0, 0, 0], mass=0.1),
    "stiffness[1, 1] is nan": lambda: flexible.beam(
        1.0, np.diag([1, np.nan, 1, 1, 1, 1]), mass=0.1
    ),
    "stiffness has the shape (5,)": lambda: flexible.beam(1.0, np.ones(5), mass=0.1),
    "stiffness is not symmetric": lambda: flexible.beam(1.0, np.eye(6) + np.eye(6, k=1), mass=0.1),
    "stiffness has a negative eigenvalue": lambda: flexible.beam(
        1.0, np.eye(6) + 2 * np.eye(6)[::-1], mass=0.1
    ),
    "mass is nan": lambda: planar(mass=np.nan),
    "inertia[0] is nan": lambda: planar(inertia=(np.nan, 0.0, 0.0)),
    "expected x = y + z for a section, which is flat": lambda: planar(inertia=(1e-3, 0.0, 0.0)),
    "damping is nan": lambda: planar(damping=np.nan),
    "the degree of k_y in degrees is None": lambda: planar({"k_y": None}),
    "length[] is inf": lambda: round_beam(length=np.inf),
    "a beam without a strain, which is a rigid body": lambda: flexible.beam(
        1.0, BENDING, {}, mass=0.1
    ),
    "the degree of k_y in degrees is -1": lambda: planar({"k_y": -1}),
    "the degree of k_y in degrees is 1.5": lambda: planar({"k_y": 1.5}),
    "use several beams in series": lambda: planar({"k_y": 99}),
    "the strain k_x is a coordinate, and its stiffness is 0.0": lambda: planar({"k_x": 1}),
    "so mass (kg/m) is needed": lambda: planar(mass=None),
    "mass is 0.0": lambda: planar(mass=0.0),
    "damping is -1.0": lambda: planar(damping=-1.0),
    "damping has the shape (3,)": lambda: planar(damping=np.ones(3)),
    "points is 2, expected an integer from 6": lambda: planar({"k_y": 5}, points=2),
    "natural['k_y'] is [nan]": lambda: planar(natural={"k_y": [np.nan]}),
    "natural['k_y'] has the shape (2, 2)": lambda: planar(natural={"k_y": np.ones((2, 2))}),
    "natural is out of range: a part of the beam": lambda: planar(natural={"k_y": [100.0]}),
    "degrees is list, expected a mapping": lambda: planar([1, 2]),
    "snapshots has the shape (3, 3), expected (k, 2)": lambda: planar().reduced(np.ones((3, 3))),
    "snapshots[0, 1] is nan": lambda: planar().reduced([[1.0, np.nan]]),
    "snapshots is 'modes', expected coordinates of the beam": lambda: planar().reduced("modes"),
    "count is 2 for all strains, and the snapshots have 1 independent": lambda: planar().reduced(
        [[1.0, 2.0], [2.0, 4.0]], 2
    ),
    "count is 1 for all strains, and the snapshots have 0 independent": lambda: planar().reduced(
        [[0.0, 0.0]], 1
    ),
    "the number of coordinates is 0, expected an integer": lambda: planar().reduced(np.eye(2), 0),
    "count is empty": lambda: planar().reduced(np.eye(2), {}),
    "count is 3, expected an integer from 1 to 2": lambda: planar().vibration_modes(3),
    "section.stiffness is": lambda: jax.jit(
        lambda EI: planar().replace(section=planar().section.replace(stiffness=EI)).static_modes()
    )(np.diag(BENDING)),
    "basis has the shape (3, 1), expected (2, n)": lambda: flexible.strain.strain_beam(
        {"k_y": 1}, basis=np.ones((3, 1))
    ),
    "the 2 columns of basis are linearly dependent, of rank 1": lambda: flexible.strain.strain_beam(
        {"k_y": 1}, basis=np.ones((2, 2))
    ),
    "basis[0, 0] is nan": lambda: flexible.strain.strain_beam({"k_y": 1}, basis=[[np.nan], [1.0]]),
}
MODELS = {
    "got the name 'a', expected a new name of a body": lambda: two("a"),
    "got the name 'world'": lambda: WORLD.with_beam("world", planar()),
    "got the name 3": lambda: WORLD.with_beam(3, planar()),
    "got the name 'b', expected a new name": lambda: WORLD.with_beam(
        "b", planar(), frames={"b": 0.5}
    ),
    "a frame is at s / L = 0.0": lambda: WORLD.with_beam("b", planar(), frames={"c": 0.0}),
    "a frame is at s / L = 1.5": lambda: WORLD.with_beam("b", planar(), frames={"c": 1.5}),
    "a frame is at s / L = nan": lambda: WORLD.with_beam("b", planar(), frames={"c": np.nan}),
    "a frame is at s / L = 'end'": lambda: WORLD.with_beam("b", planar(), frames={"c": "end"}),
    "free is 'yes', expected True or False": lambda: WORLD.with_beam("b", planar(), free="yes"),
    "position=...): got nan at [0]": lambda: WORLD.with_beam(
        "b", planar(), position=(np.nan, 0, 0)
    ),
    "the plane 'g' is on 'mid', expected a fixed body": lambda: geom("mid", "plane", [1, 1, 1]),
    "contact.with_geom(position=...): got nan at [0]": lambda: geom(
        "mid", "sphere", 0.1, position=(np.nan, 0, 0)
    ),
    "frames is list, expected a mapping": lambda: WORLD.with_beam("b", planar(), frames=["c"]),
    "the base of a free beam is in the world": lambda: two("b", free=True),
    "got shape (2,), expected (3,)": lambda: WORLD.with_beam("b", planar(), position=(0, 0)),
    "got zero, expected a unit quaternion": lambda: WORLD.with_beam(
        "b", planar(), orientation=np.zeros(4)
    ),
    "beam is str, expected a beam of rbjax.flexible.beam": lambda: WORLD.with_beam("b", "rod"),
    "expected a beam (Model.with_beam)": lambda: forces(planar().elasticity("hinge")),
}


def two(name: str, **given):
    return WORLD.with_beam("a", planar()).with_beam(name, planar(), "a", **given)


def geom(body: str, kind: str, size, **given):
    model = WORLD.with_beam("rod", planar(), frames={"mid": 0.5})
    return rb.contact.with_geom(model, "g", body, kind, size, **given)


def forces(element):
    model = rb.load("pendulum").with_forces(element)
    return rb.applied_forces(model, model.default_state())


@pytest.mark.parametrize("sentence", [*SECTIONS, *BEAMS, *MODELS])
def test_sentence(sentence: str) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)):
        (SECTIONS | BEAMS | MODELS)[sentence]()


@pytest.mark.parametrize(
    "call",
    [
        lambda: planar({"kappa": 1}),
        lambda: planar().reduced(np.eye(2), {"k_z": 1}),
        lambda: planar(natural={"e_x": [1.0]}),
        lambda: WORLD.with_beam("a", planar(), "nobody"),
        lambda: planar().replace_joint(rb.load("pendulum"), "x"),
        lambda: forces(planar().elasticity("hing")),
        lambda: geom("middle", "sphere", 0.1),
        lambda: geom("mid", "cone", 0.1),
    ],
)
def test_names_that_do_not_exist(call) -> None:
    with pytest.raises(UnknownName, match="known names"):
        call()


def test_a_part_of_a_beam_that_turns_by_more_than_pi() -> None:
    """The kinematics would be wrong: an error for values, also in a batch."""
    model = WORLD.with_beam("rod", round_beam())
    q = jnp.array([300.0, 0.0, 0.0, 0.0])
    sentence = "q is out of range for the link 'rod': a part of the beam"
    with pytest.raises(InputError, match=sentence):
        rb.mass_matrix(model, q)
    both = jnp.stack([jnp.zeros(4), q])
    with pytest.raises(InputError, match=sentence):
        rb.rollout(model, rb.State(both, jnp.zeros((2, 4))), None, 1e-3, steps=2)


def test_functions_that_do_not_suit_beams() -> None:
    model = WORLD.with_beam("rod", planar())
    q = jnp.zeros(2)
    with pytest.raises(UnsupportedFeature, match="MJCF has no such joints: rod"):
        rb.write_mjcf(model)
    with pytest.raises(RbjaxError, match="ten inertial parameters do not describe"):
        rb.inertial_regressor(model, q, q, q)
