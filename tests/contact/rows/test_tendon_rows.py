"""Rows of limits and friction loss of tendons against those of MuJoCo's constraint problem."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from rbjax.contact.rows.options import Options
from rbjax.contact.rows.tendon_rows import tendon_rows
from rbjax.forces.context import Context
from rbjax.forces.tendons.tendon_weights import tendon_weights
from tests.forces.against_mujoco import states
from tests.oracles.random_tendons import random_tendons
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, relative_error

KINDS = mujoco.mjtConstraint
STATES = 10


def robot() -> mujoco.MjModel:
    """A random robot whose tendons all have limits, of which one or two act, and friction loss."""
    spec = random_tendons(0)
    for k, tendon in enumerate(spec.tendons):
        tendon.limited, tendon.range[:], tendon.margin = True, [0.3, 0.4 + k], 0.2
        tendon.frictionloss = 0.5 * k
    m = spec.compile()
    m.jnt_limited[:], m.dof_frictionloss[:] = 0, 0
    return m


def rows(model: rb.Model, q, v):
    """J, inverse regularization and reference of all rows, by tendon_weights of the model."""
    context = Context.of(model, 0.0, rb.State(q, v), None)
    options = Options(False, 1.0, model.timestep, True)
    found = tendon_rows(context, tendon_weights(model), options)

    def array(x):
        return jnp.stack([jnp.asarray(one, float) for one in x])

    J = array([array([x.J.get(n, 0.0) for n in range(model.nv)]) for x in found])
    return J, array(x.D for x in found), array(x.reference for x in found)


def test_rows_and_weights() -> None:
    m = robot()
    model, data = load_quietly(m), mujoco.MjData(m)
    assert model.tendons.limited == (0, 1, 2) and model.tendons.rubbing == (1, 2)
    loss = [0.5, 1.0]
    context = Context.of(model, 0.0, model.default_state(), None)
    found = tendon_rows(context, tendon_weights(model), Options(False, 1.0, 0.002, True))
    assert [x.source for x in found] == [("tendon", k) for k in (1, 2, 0, 0, 1, 1, 2, 2)]
    assert [float(x.floss) for x in found[:2]] == loss
    q, v, _ = states(m, STATES)
    found = jax.jit(jax.vmap(lambda q, v: rows(model, q, v)))(q, v)
    active = set()
    for k in range(STATES):
        data.qpos, data.qvel = q[k], v[k]
        mujoco.mj_forward(m, data)
        kinds = data.efc_type[: data.nefc]
        friction = kinds == KINDS.mjCNSTR_FRICTION_TENDON
        limits = kinds == KINDS.mjCNSTR_LIMIT_TENDON
        J = np.zeros((data.nefc, m.nv))
        if mujoco.mj_isSparse(m):
            mujoco.mju_sparse2dense(
                J, data.efc_J.ravel(), data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind
            )
        else:
            J = data.efc_J.reshape(-1, m.nv)[: data.nefc]
        ours = [np.asarray(x[k]) for x in found]
        acts = ours[1] > 0
        active |= {tuple(acts)}
        theirs = (J, data.efc_D, data.efc_aref)
        for a, b in zip(ours, theirs, strict=True):
            assert relative_error(a[acts], b[friction | limits]) < F64_PARITY
        assert data.efc_frictionloss[: data.nefc][friction].tolist() == loss
    assert len(active) > 2  # other limits act at other states
    weights = jax.jit(tendon_weights)(model)
    assert relative_error(weights, m.tendon_invweight0) < F64_PARITY


def test_weights_follow_the_masses() -> None:
    m = robot()
    model = load_quietly(m)
    heavy = model.replace(
        bodies=model.bodies.replace(mass=2 * model.bodies.mass, inertia=2 * model.bodies.inertia),
        joints=model.joints.replace(armature=2 * model.joints.armature),
    )
    np.testing.assert_allclose(2 * tendon_weights(heavy), tendon_weights(model), rtol=1e-12)


def test_no_tendons() -> None:
    model = rb.load("cart_pole")
    context = Context.of(model, 0.0, model.default_state(), None)
    assert tendon_rows(context, tendon_weights(model), Options(False, 1.0, 0.002, True)) == []
    assert tendon_weights(model).shape == (0,)
