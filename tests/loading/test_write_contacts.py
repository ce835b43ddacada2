"""Geoms, pairs and parameters of constraints in a file that is written, and in the user's own."""

from __future__ import annotations

import dataclasses
import warnings

import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.loading.test_contacts import MESH, SCENE, quiet
from tests.loading.test_load import joint, link, urdf
from tests.loading.test_solver_parameters import ROBOT

FILTERED = """<mujoco>{flag}<worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body name="a" pos="0 0 1"><freejoint/><geom name="a" size=".1"/>
    <body name="b"><joint axis="0 1 0"/><geom name="b" size=".1" contype="3"/>
      <body name="c"><joint axis="0 1 0"/><geom name="c" size=".1" conaffinity="2"/>
        <geom name="shown" type="box" size=".1 .2 .3" contype="0" conaffinity="0" group="2"
          rgba=".1 .2 .3 .4" quat="1 2 3 4" pos="1 2 3"/></body></body></body>
  <body name="d" pos="0 0 3"><freejoint/><geom name="d" size=".1" friction=".3 .2 .1"/></body>
  </worldbody><contact><exclude body1="a" body2="d"/><exclude body1="c" body2="world"/></contact>
  </mujoco>"""
OVERRIDE = (
    '<option o_margin=".3" o_solref=".04 .6" o_friction=".2 .3 0 .4 .5"><flag override="enable"/>'
    "</option>"
)
TEXTS = {
    "robot": ROBOT.format(""), "filtered": FILTERED.format(flag=""),
    "parents": FILTERED.format(flag='<option><flag filterparent="disable"/></option>'),
    "without contacts": FILTERED.format(flag='<option><flag contact="disable"/></option>'),
    "without limits": ROBOT.format('limit="disable" frictionloss="disable" refsafe="disable"'),
    "override": FILTERED.format(flag=OVERRIDE),
}  # fmt: skip


def same(a: rb.Model, b: rb.Model) -> None:
    """The file of a excludes bodies also because b does not have the pairs of their geoms."""
    assert {*b.geoms.excluded} <= {*a.geoms.excluded}
    b = dataclasses.replace(b, geoms=dataclasses.replace(b.geoms, excluded=a.geoms.excluded))
    assert jax.tree.structure((a.solver, a.geoms)) == jax.tree.structure((b.solver, b.geoms))
    for x, y in zip(*map(jax.tree.leaves, ((a.solver, a.geoms), (b.solver, b.geoms))), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("contacts", [False, True])
@pytest.mark.parametrize("name", TEXTS)
def test_a_written_file_is_read_as_the_same_model(name: str, contacts: bool) -> None:
    model = quiet(TEXTS[name], contacts=contacts)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = rb.write_mjcf(model, strict=True)
    same(quiet(text, contacts=contacts), model)
    assert 'friction="1' not in text.replace('friction="1 2 3 4 5"', "")  # defaults are not written


def test_changed_parameters_are_written() -> None:
    model = quiet(ROBOT.format(""))
    rng = np.random.default_rng(0)
    solver, geoms = (
        jax.tree.map(lambda x: x * rng.uniform(0.5, 1.5, x.shape), part)
        for part in (model.solver, model.geoms)
    )
    loss = solver.frictionloss.at[7:10].set(solver.frictionloss[7])  # one number a joint
    rows = [getattr(solver, f"friction_sol{k}") for k in ("ref", "imp")]
    rows = [x.at[:6].set(x[0]).at[7:10].set(x[7]) for x in rows]
    solver = solver.replace(frictionloss=loss, friction_solref=rows[0], friction_solimp=rows[1])
    changed = model.replace(solver=solver, geoms=geoms)
    again = quiet(rb.write_mjcf(changed, strict=True))
    turns = geoms.orientation / np.linalg.norm(geoms.orientation, axis=-1, keepdims=True)
    same(again, changed.replace(geoms=geoms.replace(orientation=turns)))


def test_parts_that_a_file_cannot_express_are_named() -> None:
    model = quiet(SCENE.format(asset=MESH, more=""))
    with pytest.warns(UserWarning, match=r"geoms of meshes and height fields, left out \(tent\)"):
        text = rb.write_mjcf(model)
    assert "tent" not in quiet(text).geoms.names
    model = quiet(ROBOT.format(""))
    uneven = model.solver.replace(frictionloss=model.solver.frictionloss.at[8].set(9.0))
    with pytest.warns(UserWarning, match="where axes of a joint differ.*ankle.*frictionloss"):
        rb.write_mjcf(model.replace(solver=uneven))


def test_the_ellipsoids_of_a_fluid_are_geoms_of_the_model() -> None:
    text = """<mujoco><option density="10"/><worldbody><body><freejoint/>
      <geom name="egg" type="ellipsoid" size=".1 .2 .3" fluidshape="ellipsoid"/>
      <geom name="can" type="cylinder" size=".1 .2" pos="1 0 0" fluidshape="ellipsoid"/></body>
      </worldbody></mujoco>"""
    model = quiet(text)
    again = quiet(rb.write_mjcf(model, strict=True))
    same(again, model)
    assert jax.tree.structure(again.forces) == jax.tree.structure(model.forces)


def test_a_builder_keeps_geoms_pairs_and_parameters() -> None:
    model = quiet(ROBOT.format("").replace('name="floor" type="plane" size="0 0 1"',
                                           'name="floor" size="1"'))  # fmt: skip
    builder = rb.ModelBuilder()
    builder.attach(model, prefix="one_")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        built = builder.build()
    assert built.geoms.names == tuple(f"one_{name}" for name in model.geoms.names)
    assert built.geoms.pair_condim == (4,) and built.geoms.pairs == model.geoms.pairs
    for key in ("frictionloss", "friction_solimp", "limit_solref", "limit_margin"):
        np.testing.assert_allclose(getattr(built.solver, key), getattr(model.solver, key))
    np.testing.assert_allclose(built.geoms.pair_friction, model.geoms.pair_friction)


def test_a_robot_is_attached_without_its_floor_and_the_pairs_of_it() -> None:
    builder = rb.ModelBuilder()
    builder.attach(mujoco.MjSpec.from_string(ROBOT.format("")), prefix="one_")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        built = builder.build()
    assert "one_floor" not in built.geoms.names and built.geoms.pair_condim == ()


@pytest.mark.parametrize("contacts", [False, True])
def test_the_users_own_file_gets_changed_values(contacts: bool) -> None:
    text = ROBOT.format("").replace("<mujoco>", "<mujoco><!-- by hand -->")
    model = quiet(text, contacts=contacts)
    solver, geoms = model.solver, model.geoms
    changed = model.replace(
        solver=solver.replace(
            impratio=5.0,
            frictionloss=solver.frictionloss.at[:6].set(0.25).at[7:10].set(0.5),
            friction_solref=solver.friction_solref.at[6].set(np.array([-4.0, -1.0])),
            limit_margin=solver.limit_margin.at[1].set(0.2),
            limit_solimp=solver.limit_solimp.at[2, 1].set(0.7),
        ),
        geoms=geoms.replace(
            friction=geoms.friction.at[1].set(np.array([0.3, 0.2, 0.1])),
            solmix=2 * geoms.solmix, pair_gap=geoms.pair_gap + 1,
            pair_friction=2 * geoms.pair_friction,
        ),
    )  # fmt: skip
    out = rb.write_back(changed, text)
    assert "<!-- by hand -->" in out and 'margin="0.2"' in out
    again = quiet(out, contacts=contacts)
    assert again.solver.rubbing == (*range(6), *solver.rubbing)  # of the free joint too
    fields = {"rubbing": again.solver.rubbing}
    same(again, dataclasses.replace(changed, solver=changed.solver.replace(**fields)))
    bigger = model.replace(geoms=geoms.replace(size=2 * geoms.size))
    with pytest.raises(rb.ModelError, match=r"geoms\.size"):
        rb.write_back(bigger, text)


def test_friction_loss_in_a_urdf() -> None:
    text = urdf(link("base"), link("arm"), joint("turn", "base", "arm", "continuous"))
    model = quiet(text)
    changed = model.replace(solver=model.solver.replace(frictionloss=np.array([0.4])))
    again = quiet(rb.write_back(changed, text))
    assert again.solver.frictionloss.tolist() == [0.4]
    softer = model.replace(solver=model.solver.replace(limit_margin=np.array([0.1])))
    with pytest.raises(rb.ModelError, match=r"solver\.limit_margin"):
        rb.write_back(softer, text)
