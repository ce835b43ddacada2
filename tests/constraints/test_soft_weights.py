"""Inverse inertias of soft constraints, against MuJoCo C and closed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.equations.soft_weights import soft_weights, with_weights
from tests.loading.test_constraints import EQUALITIES, TREE
from tests.tolerances import relative_error

HEAVIER = 1.7


def loaded() -> tuple[mujoco.MjModel, rb.Model]:
    m = mujoco.MjModel.from_xml_string(TREE.format("".join(EQUALITIES)))
    return m, rb.load(m, compliant=True, contacts=False)


def of_mujoco(m: mujoco.MjModel, i: int, rows: int) -> np.ndarray:
    """MuJoCo's inverse inertias of the rows of equality i."""
    ends = np.array([m.eq_obj1id[i], m.eq_obj2id[i]])
    kind = mujoco.mjtEq(m.eq_type[i])
    if kind == mujoco.mjtEq.mjEQ_JOINT:
        return m.dof_invweight0[m.jnt_dofadr[ends[ends >= 0]]].sum(keepdims=True)
    if kind == mujoco.mjtEq.mjEQ_TENDON:
        return m.tendon_invweight0[ends[ends >= 0]].sum(keepdims=True)
    if m.eq_objtype[i] == mujoco.mjtObj.mjOBJ_SITE:
        ends = m.site_bodyid[ends]
    along, about = m.body_invweight0[ends].sum(0)
    return np.array([along] * 3 + [about] * (rows - 3))


def check(m: mujoco.MjModel, model: rb.Model) -> None:
    found = soft_weights(model)
    active = np.flatnonzero(m.eq_active0).tolist()
    assert len(found) == len(active)
    for i, soft, weight in zip(active, model.constraints, found, strict=True):
        np.testing.assert_allclose(weight, of_mujoco(m, i, soft.size), rtol=1e-10)


def test_weights_of_a_file_are_those_of_mujoco() -> None:
    check(*loaded())


def test_they_follow_the_masses() -> None:
    """As mj_setConst does, also after they have been precomputed."""
    m, model = loaded()
    scale = np.linspace(1.0, HEAVIER, m.nbody - 1)
    m.body_mass[1:] *= scale
    m.body_inertia[1:] *= scale[:, None]
    mujoco.mj_setConst(m, mujoco.MjData(m))
    bodies = with_weights(model).bodies
    heavier = bodies.replace(
        mass=bodies.mass * scale, inertia=bodies.inertia * scale[:, None, None]
    )
    check(m, with_weights(model).replace(bodies=heavier))


def test_precomputed_weights_belong_to_the_constraints() -> None:
    _, model = loaded()
    short = with_weights(model).replace(constraints=model.constraints[:1])
    assert len(soft_weights(short)) == 1
    np.testing.assert_allclose(soft_weights(short)[0], soft_weights(model)[0])


def test_derivative_by_masses() -> None:
    """The weights of a slider of mass m are 1 / m, at the configuration of `at` or of the file."""
    joint = '<joint name="j" type="slide" axis="1 0 0"/>'
    text = f'<body name="a">{joint}<geom size=".1" mass="2" contype="0"/></body>'
    model = rb.load(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    coupled = rc.Soft(rc.JointPolynomial("j", None, [0.3]), [0.02, 1.0], [0.9, 0.95, 1e-3, 0.5, 2])
    exact = rc.Soft.on(model, coupled.of)
    model = model.with_constraints(coupled, exact)

    def weights(mass: jax.Array) -> jax.Array:
        bodies = model.bodies.replace(mass=mass[None])
        return jnp.concatenate([jnp.asarray(x) for x in soft_weights(model.replace(bodies=bodies))])

    mass = jnp.array(2.0)
    np.testing.assert_allclose(jax.jit(weights)(mass), [0.5, 0.5], rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(weights)(mass), [-0.25, -0.25], rtol=1e-10)
    np.testing.assert_allclose(jax.jacrev(weights)(mass), [-0.25, -0.25], rtol=1e-10)


@pytest.mark.parametrize("compliant", [True, False])
def test_a_gradient_by_a_mass_through_a_soft_row(compliant: bool) -> None:
    """A weld to the world under gravity: the acceleration of the first step by the mass."""
    geom = '<geom size=".1" mass="2" contype="0"/>'
    body = f'<body name="a" pos="0 0 1"><joint type="slide" axis="0 0 1"/>{geom}</body>'
    weld = '<equality><weld body1="a"/></equality>'
    text = f"<mujoco><worldbody>{body}</worldbody>{weld}</mujoco>"
    model = rb.load(text, compliant=True, contacts=not compliant)
    model = model.replace(contact=None if compliant else "mujoco")
    state = model.default_state().replace(q=jnp.array([0.01]))

    def accelerated(mass: jax.Array) -> jax.Array:
        bodies = model.bodies.replace(mass=mass[None])
        return rb.acceleration(model.replace(bodies=bodies), state)[0]

    mass, h = jnp.array(2.0), 1e-5
    rate = jax.jit(jax.grad(accelerated))(mass)
    run = jax.jit(accelerated)
    quotient = (run(mass + h) - run(mass - h)) / (2 * h)
    assert abs(rate - quotient) < 1e-6
    # w = 1 / m for one dof, so the row does not depend on the mass at all
    assert relative_error(run(mass), run(2 * mass)) < 1e-9
