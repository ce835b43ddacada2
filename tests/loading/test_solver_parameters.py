"""Parameters of MuJoCo's constraint problem: read from a file, replaced, batched, kept."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.loading import compile_model
from tests.loading.test_load import load_quietly

pytestmark = pytest.mark.filterwarnings("ignore:.*left out of the model")

ROBOT = """<mujoco><option cone="elliptic" impratio="3"><flag {}/></option><worldbody>
  <geom name="floor" type="plane" size="0 0 1" solmix="2"/>
  <body pos="0 0 1"><freejoint/><geom name="trunk" size=".1" friction=".5 .1 .2" gap=".1"/>
    <body><joint name="hip" axis="0 1 0" range="-30 40" margin=".1" frictionloss=".3"
        solreflimit=".05 .7" solimplimit=".1 .2 .3 .4 3"/><geom size=".1"/>
      <body><joint name="ankle" type="ball" range="0 30" frictionloss=".2" solreffriction="-3 -2"
        solimpfriction=".5 .6 .1 .3 1"/><geom name="foot" size=".1"/>
        <body><joint name="toe" axis="0 1 0"/><geom name="tip" size=".05"/></body></body></body>
    <body><joint name="wrong" axis="0 1 0" range="-30 40"/><geom size=".1"/></body>
  </body></worldbody>
  <contact><pair geom1="foot" geom2="floor" condim="4" friction="1 2 3 4 5" margin=".2" gap=".3"
    solref="-10 -2" solreffriction=".1 2" solimp=".3 .4 .5 .6 2"/></contact></mujoco>"""


def robot(flag: str = "") -> tuple[mujoco.MjModel, rb.Model]:
    m = mujoco.MjModel.from_xml_string(ROBOT.format(flag).replace("<flag />", ""))
    m.joint("wrong").range[:] = 0.5, -0.5
    return m, load_quietly(m)


def test_a_file_keeps_the_parameters_of_its_constraints() -> None:
    m, model = robot()
    solver, geoms = model.solver, model.geoms
    assert (solver.cone, solver.refsafe, float(solver.impratio)) == ("elliptic", True, 3.0)
    for ours, theirs in {
        "limit_solref": "jnt_solref", "limit_solimp": "jnt_solimp", "limit_margin": "jnt_margin",
        "frictionloss": "dof_frictionloss", "friction_solref": "dof_solref",
        "friction_solimp": "dof_solimp",
    }.items():  # fmt: skip
        np.testing.assert_array_equal(getattr(solver, ours), getattr(m, theirs))
    assert solver.limited == (1, 2)  # the limits of `wrong` are inverted
    assert solver.rubbing == (6, 7, 8, 9)
    assert geoms.pairs[0] == (0, model.geom("foot")) and geoms.pair_condim == (4,)
    for name in ("friction", "solref", "solreffriction", "solimp", "margin", "gap"):
        np.testing.assert_array_equal(getattr(geoms, f"pair_{name}"), getattr(m, f"pair_{name}"))
    np.testing.assert_array_equal(geoms.solmix, m.geom_solmix)


@pytest.mark.parametrize("scene", ["arm7", "gripper", "humanoid"])
def test_scenes(scene: str) -> None:
    m, solver = compile_model(scene), load_quietly(scene).solver
    assert solver.cone == "pyramidal" and solver.refsafe
    assert set(solver.rubbing) == set(np.flatnonzero(m.dof_frictionloss).tolist())
    off = m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    expected = () if off else tuple(np.flatnonzero(m.jnt_limited).tolist())
    assert solver.limited == expected


@pytest.mark.parametrize(
    ("flag", "limited", "rubbing", "pairs"),
    [
        ("limit", False, True, True),
        ("frictionloss", True, False, True),
        ("contact", True, True, False),
        ("constraint", False, False, False),
        ("refsafe", True, True, True),
    ],
)
def test_features_that_a_file_disables(
    flag: str, limited: bool, rubbing: bool, pairs: bool
) -> None:
    _, model = robot(f'{flag}="disable"')
    solver, geoms = model.solver, model.geoms
    assert solver.limited == ((1, 2) if limited else ())
    assert solver.rubbing == ((6, 7, 8, 9) if rubbing else ())
    assert bool(geoms.pairs) == pairs and len(geoms.pair_condim) == pairs
    assert geoms.pair_friction.shape == (int(pairs), 5)
    assert solver.refsafe == (flag != "refsafe")


def test_parameters_are_replaced_cast_and_batched() -> None:
    _, model = robot()
    solver = model.solver.replace(frictionloss=2 * model.solver.frictionloss)
    changed = model.replace(solver=solver)
    assert float(changed.solver.frictionloss[6]) == 0.6
    assert jax.tree.structure(changed) == jax.tree.structure(model)  # compiles nothing anew
    with pytest.raises(rb.InputError, match=r"SolverParameters.replace\(impratio"):
        model.solver.replace(impratio=jnp.ones(2))
    with pytest.raises(rb.UnknownName, match="field of SolverParameters"):
        model.solver.replace(friction=0.0)
    single = model.astype(jnp.float32)
    assert {x.dtype for x in jax.tree.leaves((single.solver, single.geoms))} == {
        np.dtype("float32")
    }
    scale = jnp.array([1.0, 2.0, 3.0])
    solver = model.solver
    batch = jax.vmap(
        lambda k: model.replace(solver=solver.replace(frictionloss=k * solver.frictionloss))
    )(scale)
    assert batch.solver.frictionloss.shape == (3, model.nv)
    assert batch.solver.rubbing == model.solver.rubbing


def test_a_joint_of_another_kind() -> None:
    _, model = robot()
    old = model.solver
    new = model.with_joint("ankle", "hinge").solver  # of three dofs, one remains
    assert new.limited == (1,) and new.rubbing == (6,)
    assert new.frictionloss.shape == (model.nv - 2,) and new.friction_solimp.shape == (10, 5)
    np.testing.assert_array_equal(new.frictionloss[6:], [0.3, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(new.friction_solref[7], [0.02, 1.0])
    np.testing.assert_array_equal(new.limit_solimp, old.limit_solimp)
    new = model.with_joint("hip", "slide").solver
    assert (new.limited, new.rubbing) == (old.limited, old.rubbing)
    new = model.with_joint("hip", "ball").solver
    assert new.limited == (2,) and new.rubbing == (9, 10, 11)
    bare = dataclasses.replace(model, solver=None)
    assert bare.with_joint("hip", "slide").solver is None
