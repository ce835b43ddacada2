"""Cables of MJCF files, which MuJoCo 4 cannot read, against the models that MuJoCo 3 compiled."""

import json
import warnings
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.loading import compile_model
from rbjax.loading.loader import from_compiled
from rbjax.validation.contacts import with_contacts
from rbjax.validation.reference import smooth
from tests.robots import load_quietly
from tests.tolerances import relative_error

ORACLE = Path(__file__).parents[1] / "oracles" / "mujoco_cables.json"
CASES = json.loads(ORACLE.read_text())["cases"]
OBJ = mujoco.mjtObj
PLUGIN = '<extension><plugin plugin="mujoco.elasticity.cable"/></extension>'


def cable(attributes, inside='<geom type="capsule" size=".01"/>', before=PLUGIN, config=""):
    return (
        f'<mujoco>{before}<worldbody><composite type="cable" {attributes}>'
        f'<plugin plugin="mujoco.elasticity.cable">{config}</plugin>'
        f"{inside}</composite></worldbody></mujoco>"
    )


def names(m, kind, count):
    return [mujoco.mj_id2name(m, kind, i) or "" for i in range(count)]


def turns(x):
    x = np.array(x)
    return x[:, :, None] * x[:, None, :]


@pytest.mark.parametrize("case", CASES)
def test_the_bodies_of_a_cable_are_those_of_mujoco(case):
    want, m = CASES[case], compile_model(CASES[case]["xml"])
    found = {
        "body_pos": m.body_pos[1:],
        "body_mass": m.body_mass[1:],
        "body_inertia": m.body_inertia[1:],
        "armature": m.dof_armature,
        "damping": m.dof_damping,
        "geom_solref": m.geom_solref,
        "geom_friction": m.geom_friction,
        "geom_group": m.geom_group,
        "geom_size": m.geom_size,
        "site_pos": m.site_pos,
        "nexclude": m.nexclude,
    }
    for name, x in found.items():
        np.testing.assert_allclose(x, np.reshape(want[name], np.shape(x)), atol=1e-15, rtol=1e-13)
    np.testing.assert_allclose(turns(m.body_quat[1:]), turns(want["body_quat"]), atol=1e-14)
    assert names(m, OBJ.mjOBJ_JOINT, m.njnt) == want["joints"]
    assert names(m, OBJ.mjOBJ_SITE, m.nsite) == want["sites"]
    assert names(m, OBJ.mjOBJ_GEOM, m.ngeom) == want["geoms"]
    bodies = zip(names(m, OBJ.mjOBJ_BODY, m.nbody)[1:], want["bodies"], strict=True)
    assert all(a == b for a, b in bodies if b)  # bodies without a name get one


@pytest.mark.parametrize("case", ["helix_flat_true", "bodies"])
def test_written_and_read_again(case):
    model = load_quietly(CASES[case]["xml"])
    softer = model.forces[0].replace(bend=model.forces[0].bend / 3, law="gradient")
    model = model.replace(forces=(softer, *model.forces[1:]))
    again = rb.load(rb.write_mjcf(model, strict=True))
    assert [x.law for x in again.forces] == ["gradient", "mujoco"]
    q = jnp.array(CASES[case]["states"][2]["q"])
    state = rb.State(q, jnp.zeros(model.nv))
    assert relative_error(rb.applied_forces(again, state), rb.applied_forces(model, state)) < 1e-13


def test_an_included_file_and_its_meshes(tmp_path):
    parts, meshes = tmp_path / "parts", tmp_path / "meshes"
    parts.mkdir(), meshes.mkdir()
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (meshes / "corner.obj").write_text(corners)
    (parts / "cable.xml").write_text(CASES["straight"]["xml"])
    main = tmp_path / "main.xml"
    main.write_text(
        '<mujoco><include file="parts/cable.xml"/><compiler meshdir="meshes"/><asset>'
        '<mesh name="c" file="corner.obj"/></asset><worldbody><body pos="3 0 0"><freejoint/>'
        '<geom type="mesh" mesh="c"/></body></worldbody></mujoco>'
    )
    model = load_quietly(main, contacts=False)
    assert model.nv == 12 + 6
    (own,) = model.forces
    assert own.section.shape == (4, 3)


@pytest.mark.parametrize("written", [False, True])
def test_attached_with_a_prefix(written):
    text = CASES["straight"]["xml"]
    source = rb.write_mjcf(load_quietly(text)) if written else text
    builder = rb.ModelBuilder()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MuJoCo names the options that it keeps
        builder.attach(source, prefix="left_")
        builder.attach(source, prefix="right_", position=[0, 1, 0])
        model = builder.build(contacts=False)
    tau = np.array(CASES["straight"]["states"][1]["tau"])
    q = jnp.array(CASES["straight"]["states"][1]["q"])
    state = rb.State(jnp.concatenate([q, q]), jnp.zeros(model.nv))
    assert relative_error(rb.applied_forces(model, state), np.concatenate([tau, tau])) < 1e-12


def test_a_file_without_cables_is_read_by_mujoco_alone():
    text = '<mujoco><include file="no such file.xml"/></mujoco>'
    with pytest.raises(rb.ModelError, match="no such file"):
        rb.load(text)
    assert rb.load("<mujoco><!-- composite --><worldbody/></mujoco>").nv == 0


def test_a_composite_without_a_plugin_has_no_force():
    text = cable('count="4 1 1" curve="s" size="1"').replace(PLUGIN, "")
    start = text.index("<plugin")
    end = text.index("</plugin>") + len("</plugin>")
    model = load_quietly(text[:start] + text[end:])
    assert (model.nv, model.forces) == (9, ())


def test_no_forces_where_springs_and_dampers_are_disabled():
    off = '<option><flag spring="disable" damper="disable"/></option>'
    model = load_quietly(cable('count="4 1 1" curve="s" size="1"', before=off + PLUGIN))
    assert model.forces == ()


def test_comparisons_with_mujoco_4_switch_the_cables_off():
    text = CASES["straight"]["xml"]
    m, off = smooth(text)
    assert off[0] == "elasticity of cables, which MuJoCo 4 does not have"
    assert from_compiled(m).forces == ()
    _, model, off = with_contacts(text)
    assert off[0].startswith("elasticity of cables") and model.forces == ()
    assert smooth("pendulum")[1][0] != off[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (cable('count="4 1 1" curve="t" size="1"'), r"curve 't'.*expected at most three of s, cos"),
        (cable('count="4 4 1" curve="s" size="1"'), "a count in one dimension"),
        (cable('count="1 1 1" curve="s" size="1"'), "1 vertices; expected two or more"),
        (cable('vertex="0 0 0 0 0 0"'), "two of which coincide"),
        (cable('vertex="0 0 0 1 0"'), "5 numbers in vertex"),
        (cable('vertex="0 0 zero"'), "vertex='0 0 zero', expected numbers"),
        (cable('count="4" curve="s"', "<geom size='.1'/>"), "'sphere', expected one of capsule"),
        (
            cable('count="4" curve="s"', config='<config key="bend" value="1 is not a number"/>'),
            "bend='1 is not a number', expected a number in Pa",
        ),
        (
            cable('count="4" curve="s"', config='<config key="young" value="1"/>'),
            "has no 'young', expected one of",
        ),
    ],
)
def test_bad_cables(text, message):
    with pytest.raises(rb.ModelError, match=message):
        rb.load(text)


def test_bad_chains():
    text = CASES["bodies"]["xml"]
    hinge = text.replace('<joint type="ball" damping=".01"/>', '<joint type="hinge"/>')
    with pytest.raises(rb.ModelError, match="other joints than one ball"):
        load_quietly(hinge)
    fork = text.replace(
        "<worldbody>", '<worldbody><body name="x"><geom size="1"/><plugin instance="one"/></body>'
    )
    with pytest.raises(rb.ModelError, match="are not a chain"):
        load_quietly(fork)
    sphere = text.replace('type="box" size=".1 .01 .02"', 'type="sphere" size=".1"')
    with pytest.raises(rb.ModelError, match="gives no section"):
        load_quietly(sphere)
