"""Gravity compensation against MuJoCo C: passive, by the actuators, and both in one model."""

import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.forces.against_mujoco import (
    DRIVERS,
    SEEDS,
    costs_nothing,
    energy_slope,
    error_of,
    mujoco_forces,
    slopes,
    states,
    tree,
    worst_error,
)
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, GRADIENT

LEG = """
<mujoco><compiler angle="radian"/><option gravity="1 2 -9"/>
<default><geom contype="0" conaffinity="0" size="0.1" pos="0.1 0 0.05"/></default>
<worldbody>
  <body gravcomp="0.5">
    <joint name="hip" axis="0 1 0" actuatorgravcomp="true" actuatorfrcrange="-9 9"/><geom/>
    <body pos="0.2 0 0" gravcomp="1"><joint name="knee" axis="0 1 1"/><geom/>
      <body pos="0.2 0 0" gravcomp="2"><joint name="foot" type="ball" actuatorgravcomp="true"/>
        <geom/><body pos="0 0.1 0" gravcomp="1"><geom/></body></body></body></body>
  <body gravcomp="1"><geom/></body>
</worldbody>
<actuator><motor name="m" joint="hip"/></actuator></mujoco>
"""


def random_model(seed: int, driven: bool) -> mujoco.MjModel:
    spec, rng = tree(seed), np.random.default_rng(seed)
    for body in spec.bodies[1:]:
        body.gravcomp = rng.uniform(-0.5, 2.0) * rng.integers(0, 2)
    spec.bodies[1].gravcomp = 0.8
    for joint in spec.joints if driven else ():
        joint.actgravcomp = rng.integers(0, 2)
        if joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            joint.actfrclimited, joint.actfrcrange = True, [-3.0, 4.0]
    return spec.compile()


@pytest.mark.parametrize("driven", [False, True], ids=["passive", "some by actuators"])
@pytest.mark.parametrize("seed", SEEDS)
def test_random_trees(seed: int, driven: bool) -> None:
    assert worst_error(random_model(seed, driven)) < F64_PARITY


@pytest.mark.parametrize("driver", DRIVERS)
def test_both_kinds_on_every_driver(driver: str) -> None:
    m = mujoco.MjModel.from_xml_string(LEG)
    passive, actuated = load_quietly(m).forces
    assert not passive.actuates and actuated.actuates
    forces = mujoco_forces(m, *states(m))[:, 0]
    assert (np.abs(forces) == 9).any() and (np.abs(forces) < 9).any()  # the range is met
    assert worst_error(m, driver) < F64_PARITY


def test_without_controls_the_actuators_share_is_gone() -> None:
    model = rb.load(LEG)
    f = jax.jit(lambda state: rb.applied_forces(model, state))
    tau = f(model.default_state())
    assert tau[1] != 0 and not np.any(tau[np.array([0, 2, 3, 4])])


@pytest.mark.parametrize("flag", ["actuation", "gravity", "spring", "damper"])
def test_disabled(flag: str) -> None:
    text = LEG.replace('9"/>', f'9"><flag {flag}="disable"/></option>', 1)
    m = mujoco.MjModel.from_xml_string(text)
    assert error_of(load_quietly(m), m, 2) < F64_PARITY


def test_quirks_of_mujoco() -> None:
    """No passive forces without springs and dampers; no share for actuators without actuators."""
    both = LEG.replace('9"/>', '9"><flag spring="disable" damper="disable"/></option>', 1)
    assert all(element.actuates for element in rb.load(both).forces)
    alone = LEG[: LEG.index("<actuator>")] + "</mujoco>"
    assert not any(element.actuates for element in rb.load(alone).forces)
    for text in (both, alone):
        m = mujoco.MjModel.from_xml_string(text)
        assert error_of(load_quietly(m), m, 2) < F64_PARITY


def test_slopes_and_energy() -> None:
    text = LEG.replace('actuatorgravcomp="true"', "")
    model = rb.load(text)
    state = model.random_state(jax.random.key(0))

    def f(at):
        forces, masses, gravity, q = at
        bodies = model.bodies.replace(mass=masses)
        changed = model.replace(forces=forces, bodies=bodies, gravity=gravity)
        return rb.applied_forces(changed, rb.State(q, state.v))

    at = (model.forces, model.bodies.mass, model.gravity, state.q)
    assert slopes(f, at) < GRADIENT
    force, slope = energy_slope(model, state.q)
    np.testing.assert_allclose(force, slope, atol=1e-11)
    (all_joints,) = (x for x in model.forces if isinstance(x, rb.forces.GravityCompensation))
    some = model.replace(forces=(all_joints.replace(joints=(0,)),))
    assert rb.forces.elastic_energy(some, state.q) == 0.0  # no energy has these forces


def test_zeros_cost_nothing_and_other_models_have_none() -> None:
    model = rb.load("double_pendulum")
    assert model.forces == ()
    n = np.zeros(model.nb)
    assert costs_nothing(rb.forces.GravityCompensation(n, model.body_names), model)
    weightless = model.replace(gravity=np.zeros(3))
    assert costs_nothing(rb.forces.GravityCompensation(n + 1, model.body_names), weightless)
