"""Polynomial springs and dampers against MuJoCo C, their derivatives, and what zeros cost."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.forces.against_mujoco import (
    AT_A_JUMP,
    DRIVERS,
    SEEDS,
    costs_nothing,
    energy_slope,
    slopes,
    tree,
    worst_error,
)
from tests.tolerances import F64_PARITY, GRADIENT

JOINTS = """
<mujoco><compiler angle="radian"/><option {option}/>
<default><geom contype="0" conaffinity="0" size="0.1"/>
  <joint stiffness="2 0.3 0.5" damping="1 0.7 0.4"/></default>
<worldbody>
  <body><joint name="hinge" springref="0.1"/><geom pos="0.1 0.2 0"/>
    <body pos="0.3 0 0"><joint name="slide" type="slide" springref="-0.2"/><geom/>
      <body pos="0 0.3 0"><joint name="ball" type="ball"/><geom pos="0 0.1 0.1"/></body></body>
  </body>
  <body><joint name="free" type="free"/><geom pos="0.1 0 0"/></body>
</worldbody></mujoco>
"""


def random_model(seed: int) -> mujoco.MjModel:
    spec, rng = tree(seed), np.random.default_rng(seed)
    for joint in spec.joints:
        joint.stiffness[:] = rng.uniform(-0.5, 3.0, 3) * rng.integers(0, 2, 3)
        joint.damping[:] = rng.uniform(0.0, 2.0, 3) * rng.integers(0, 2, 3)
    spec.joints[0].stiffness[1:] = 0.7, 0.3
    return spec.compile()


@pytest.mark.parametrize("seed", SEEDS)
def test_random_trees(seed: int) -> None:
    assert worst_error(random_model(seed)) < F64_PARITY


@pytest.mark.parametrize("driver", DRIVERS)
def test_every_kind_of_joint_on_every_driver(driver: str) -> None:
    m = mujoco.MjModel.from_xml_string(JOINTS.format(option=""))
    assert worst_error(m, driver) < F64_PARITY


def test_disabled() -> None:
    both = rb.load(JOINTS.format(option="")).forces[0]
    for flag, kept in (("spring", "damping"), ("damper", "stiffness")):
        off = f"<option><flag {flag}='disable'/></option>"
        text = JOINTS.format(option="").replace("<option />", off)
        (element,) = rb.load(text).forces
        gone = ({"damping", "stiffness"} - {kept}).pop()
        np.testing.assert_array_equal(getattr(element, kept), getattr(both, kept))
        assert not np.any(getattr(element, gone))
        assert worst_error(mujoco.MjModel.from_xml_string(text)) < F64_PARITY


def test_slopes_where_springs_rest_and_nothing_moves() -> None:
    model = rb.load(JOINTS.format(option=""))
    rest = model.joints.springref

    def f(at):
        element, q, v = at
        return rb.applied_forces(model.replace(forces=(element,)), rb.State(q, v))

    assert slopes(f, (model.forces[0], rest, jnp.zeros(model.nv))) < AT_A_JUMP
    moving = model.random_state(jax.random.key(1))
    assert slopes(f, (model.forces[0], moving.q, moving.v)) < GRADIENT


def test_the_spring_is_the_gradient_of_its_energy() -> None:
    model = rb.load(JOINTS.format(option=""))
    force, slope = energy_slope(model, model.random_state(jax.random.key(2)).q)
    np.testing.assert_allclose(force, slope, atol=1e-12)


def test_zeros_cost_nothing_and_other_models_have_none() -> None:
    model = rb.load("double_pendulum")
    assert model.forces == ()
    none = rb.forces.JointPolynomials(jnp.zeros((2, 2)), jnp.zeros((2, 2)), model.joint_names)
    assert costs_nothing(none, model)
