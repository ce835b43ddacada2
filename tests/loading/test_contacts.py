"""`load(contacts=True)`: pairs with a closed form, what is left out, checks of geoms."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.loading.test_load import joint, link, urdf
from tests.loading.test_solver_parameters import ROBOT

MESH = '<asset><mesh name="tent" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>'
SCENE = """<mujoco>{asset}<worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body pos="0 0 1"><freejoint/><geom name="ball" size=".1"/></body>
  <body pos="0 0 2"><freejoint/><geom name="can" type="cylinder" size=".1 .2"/></body>
  <body pos="0 0 3"><freejoint/><geom name="tent" type="mesh" mesh="tent"/></body>
  <body pos="0 0 4"><freejoint/><geom name="egg" type="ellipsoid" size=".1 .2 .3"/></body>
  </worldbody>{more}</mujoco>"""


def quiet(source: object, **options: bool) -> rb.Model:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return rb.load(source, **options)


def test_pairs_without_a_closed_form_are_named() -> None:
    pair = '<contact><pair geom1="can" geom2="egg"/><pair geom1="can" geom2="floor" gap=".3"/>'
    text = SCENE.format(asset=MESH, more=f"{pair}</contact>")
    model = quiet(text, contacts=True)
    kinds = model.geoms.types
    assert all((kinds[a], kinds[b]) in rb.contact.pairs() for a, b in model.geoms.pairs)
    every = quiet(text, contacts=False).geoms.pairs
    missing: dict[str, int] = {}
    for a, b in every:
        if (kinds[a], kinds[b]) not in rb.contact.pairs():
            name = f"contact pairs of {kinds[a]} and {kinds[b]}"
            missing[name] = missing.get(name, 0) + 1
    assert {f"{name} ({n})" for name, n in missing.items()} == set(model.dropped)
    assert "contact pairs of ellipsoid and cylinder (1)" in model.dropped
    assert len(model.geoms.pairs) + sum(missing.values()) == len(every)
    # of both explicit pairs the second remains, with its own gap
    assert model.geoms.pair_gap.tolist() == [0.3] and model.geoms.pair_condim == (3,)
    assert {model.geoms.names[i] for i in model.geoms.pairs[0]} == {"floor", "can"}
    q = model.default_state().q
    assert rb.contact.detect(model, q).distance.shape[0] > 0


def test_limits_and_friction_loss_are_in_the_problem_and_not_elements() -> None:
    text = ROBOT.format("")
    model = quiet(text)
    assert (model.contact, model.forces) == ("mujoco", ())
    assert model.solver.limited and model.solver.rubbing
    assert not [x for x in model.dropped if x.startswith(("joint", "contacts"))]
    free = quiet(text, contacts=False)
    assert free.contact is None
    assert [x.split(" (")[0] for x in free.dropped] == [
        "contacts", "joint limits", "joint friction loss"
    ]  # fmt: skip
    for contacts in (False, True):
        model = quiet(text, limits=True, friction=True, contacts=contacts)
        elements = [type(x).__name__ for x in model.forces]
        assert elements == ["JointLimits", "JointFriction"]
        assert not model.solver.limited and not model.solver.rubbing
        assert not [x for x in model.dropped if x.startswith("joint")]


def test_a_robot_without_contacts_limits_and_friction_loss_has_no_law() -> None:
    loop = (
        '<mujoco><worldbody><body name="a" pos="0 0 1"><joint name="j"/><geom size=".1"/>'
        '</body></worldbody><equality><connect body1="a" anchor="0 0 .1"/></equality></mujoco>'
    )
    model = rb.load(loop, strict=True)  # fmt: skip
    assert model.contact is None
    assert not isinstance(model.constraints[0], rb.constraints.Soft)
    limited = rb.load(loop.replace('name="j"', 'name="j" range="-1 1"'), strict=True)
    assert limited.contact == "mujoco"
    assert isinstance(limited.constraints[0], rb.constraints.Soft)


def test_a_file_without_open_questions_loads_strictly() -> None:
    model = rb.load(ROBOT.format(""), contacts=True, strict=True)
    assert model.dropped == ()


@pytest.mark.parametrize(
    ("option", "entry"),
    [
        ('noslip_iterations="3">', "iterations without slip"),
        ('><flag diagexact="enable"/>', "the exact diagonal"),
    ],
)
def test_options_that_are_left_out(option: str, entry: str) -> None:
    text = f'<mujoco><option {option}</option><worldbody><geom size="1"/><body pos="0 0 3">'
    text += '<freejoint/><geom size="1"/></body></worldbody></mujoco>'
    (found,) = quiet(text, contacts=True).dropped
    assert found.startswith(entry)
    assert not [x for x in quiet(text, contacts=False).dropped if x.startswith(entry)]


def two_balls() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom name="ground" size="1"/><body pos="0 0 3"><joint name="lift" '
        'type="slide" range="0 1" frictionloss="1"/><geom name="ball" size="1"/></body></worldbody>'
        '<contact><pair geom1="ground" geom2="ball"/></contact></mujoco>'
    )


@pytest.mark.parametrize(
    ("field", "index", "value", "message"),
    [
        ("geom_size", (1, 0), 0.0, r"geom 'ball': the size of the sphere is \[0.0\], expected"),
        ("geom_friction", (0, 1), np.nan, "geoms .ground.: friction has nan, expected finite"),
        ("geom_solref", (1, 0), np.inf, "geoms .ball.: solref has inf, expected finite"),
        ("pair_friction", (0, 3), np.nan, "contact pairs .ground and ball.: friction has nan"),
    ],
)
def test_geoms_that_are_wrong(field: str, index: tuple, value: float, message: str) -> None:
    m = two_balls()
    getattr(m, field)[index] = value
    with pytest.raises(rb.ModelError, match=message):
        quiet(m, contacts=True)
    quiet(m, contacts=False)


def test_references_of_mixed_signs() -> None:
    m = two_balls()
    m.geom_solref[1] = [0.02, -1.0]
    m.jnt_solref[0] = [-3.0, 1.0]
    m.dof_solref[0] = [-3.0, 0.0]  # direct, without damping
    m.pair_solreffriction[0] = [0.0, 0.5]
    message = r"solref of mixed signs.*: geoms \(ball\); contact pairs \(ground and ball\); "
    with pytest.warns(UserWarning, match=message + r"joint limits \(lift\)"):
        rb.load(m, contacts=True)
    with pytest.raises(rb.UnsupportedFeature, match="mixed signs"):
        rb.load(m, contacts=True, strict=True)


ROPES = """<mujoco><worldbody><body><joint name="a" range="0 1" frictionloss="1"/>
  <geom size=".1"/><body pos="1 0 0"><joint name="b"/><geom size=".1"/></body></body></worldbody>
  <tendon><fixed name="belt" range="-1 1" frictionloss="2"><joint joint="a" coef="1"/>
  <joint joint="b" coef="2"/></fixed></tendon>
  <equality><joint name="gear" joint1="a" joint2="b"/></equality></mujoco>"""


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("jnt_margin", "joint limits .a.: margin has nan"),
        ("dof_solimp", "joint friction loss .a.: solimp has nan"),
        ("tendon_margin", "tendon limits .belt.: margin has nan"),
        ("tendon_solref_fri", "tendon friction loss .belt.: solref_fri has nan"),
        ("eq_solref", "equalities .gear.: solref has nan"),
    ],
)
def test_rows_that_are_wrong(field: str, message: str) -> None:
    m = mujoco.MjModel.from_xml_string(ROPES)
    getattr(m, field)[0] = np.nan
    with pytest.raises(rb.ModelError, match=message):
        quiet(m, contacts=True)


def test_mixed_signs_of_tendons_and_equalities() -> None:
    m = mujoco.MjModel.from_xml_string(ROPES)
    m.tendon_solref_lim[0] = m.tendon_solref_fri[0] = m.eq_solref[0] = [0.02, -1.0]
    message = r"tendon limits \(belt\); tendon friction loss \(belt\); equalities \(gear\)"
    with pytest.warns(UserWarning, match=message):
        model = rb.load(m, contacts=True)
    assert model.constraints[0].solref.tolist() == [0.02, 1.0]


def test_collision_shapes_of_a_urdf() -> None:
    shape = "<collision><geometry><{}/></geometry></collision></link>"
    text = urdf(link("base"), link("arm"), joint("turn", "base", "arm", "continuous"))
    for name, kind in (("base", 'sphere radius="1"'), ("arm", 'mesh filename="none.stl"')):
        at = text.index("</link>", text.index(f'"{name}"'))
        text = text[:at] + shape.format(kind) + text[at + len("</link>") :]
    found = quiet(text, contacts=True).dropped
    assert [x for x in found if x.startswith("coll")] == ["collision meshes of links (arm)"]
    found = quiet(text, contacts=False).dropped
    assert [x for x in found if x.startswith("coll")] == ["collision shapes of links (base, arm)"]


def test_contacts_is_true_or_false() -> None:
    with pytest.raises(rb.InputError, match="contacts"):
        rb.load("pendulum", contacts="mujoco")
