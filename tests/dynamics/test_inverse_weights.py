"""Inverse inertias of bodies and dofs against MuJoCo's, their derivatives, forms of the model."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.inverse_weights import inverse_weights
from rbjax.loading import compile_model
from rbjax.model import with_constants
from tests.loading.test_load import load_quietly
from tests.robots import QUICK

PARITY = 1e-12  # relative
BALL = '<geom size=".1" mass="2" pos="{}"/>'
CASES = {
    "hinge through the centre": f'<body><joint axis="0 1 0"/>{BALL.format("0 0 0")}</body>',
    "slide along an axis": f'<body><joint type="slide" armature="3"/>{BALL.format("0 0 0")}</body>',
    "slide across the axes": '<body><joint type="slide" axis="1 1 0" armature="3"/>'
    f"{BALL.format('0 0 0')}</body>",
    "a body on a slide": f'<body><joint type="slide"/>{BALL.format("0 0 0")}<body pos=".3 0 0">'
    f'<joint axis="0 1 0"/>{BALL.format("1 0 0")}</body></body>',
    "weld to a body that moves": f'<body><joint axis="0 1 0"/>{BALL.format("1 0 0")}'
    f'<body pos="0 1 2" quat="1 2 3 4">{BALL.format("0 0 .3")}</body><body pos="1 1 1"/></body>',
    "weld to the world": f'<body pos="0 0 1">{BALL.format("0 0 0")}<body><joint axis="0 1 0"/>'
    f"{BALL.format('1 0 0')}</body></body>",
    "ball": '<body pos="0 0 1"><joint type="ball" pos=".1 .2 .3" armature=".2"/>'
    '<geom type="box" size=".1 .2 .3" pos="1 0 0"/></body>',
    "two free bodies": '<body quat="1 2 3 4"><joint type="free" armature=".3"/><geom type="box" '
    f'size=".1 .2 .3" pos=".1 0 0"/><body><joint axis="1 1 0"/>{BALL.format("0 1 0")}</body></body>'
    '<body pos="0 0 2"><freejoint/><geom type="box" size=".1 .2 .3"/></body>',
    "references": f'<body><joint axis="0 1 0" ref="30"/>{BALL.format("1 0 0")}<body pos="1 0 0">'
    f'<joint type="slide" ref=".3" pos="1 1 1"/><joint axis="1 0 0"/>{BALL.format("0 1 0")}</body>'
    "</body>",
    "no dofs": f"<body>{BALL.format('0 0 0')}</body>",
}


def check(m: mujoco.MjModel, model: rb.Model) -> None:
    for ours, theirs in zip(
        inverse_weights(model), (m.body_invweight0[1:], m.dof_invweight0), strict=True
    ):
        assert isinstance(ours, np.ndarray)  # constants: literals of a program
        np.testing.assert_allclose(ours, theirs, rtol=PARITY, atol=1e-15)


@pytest.mark.parametrize("name", CASES)
def test_weights_are_those_of_mujoco(name: str) -> None:
    m = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{CASES[name]}</worldbody></mujoco>")
    check(m, load_quietly(m))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_precomputed_constants_leave_the_weights_constant(dtype) -> None:
    """So the contact parameters are constants of a rollout's program."""
    m = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{CASES['two free bodies']}</worldbody></mujoco>"
    )
    check(m, with_constants(load_quietly(m), dtype))


@pytest.mark.parametrize(
    "scene",
    [
        x if x in ("gripper", "quadruped", "satellite") else pytest.param(x, marks=pytest.mark.slow)
        for x in rb.scenes()
    ],
)
def test_scenes(scene: str) -> None:
    check(compile_model(scene), load_quietly(scene))


@functools.cache
def quadruped() -> rb.Model:
    return load_quietly("quadruped")


def test_changed_masses_give_the_weights_of_mj_setConst() -> None:
    m, model = compile_model("quadruped"), quadruped()
    scale = np.linspace(0.5, 3.0, model.nb)
    m.body_mass[1:] *= scale
    m.body_inertia[1:] *= scale[:, None]
    mujoco.mj_setConst(m, mujoco.MjData(m))
    own = model.bodies
    heavier = own.replace(mass=own.mass * scale, inertia=own.inertia * scale[:, None, None])
    check(m, model.replace(bodies=heavier))

    @functools.partial(jax.jit, compiler_options=QUICK)
    def traced(mass, inertia):
        return inverse_weights(model.replace(bodies=own.replace(mass=mass, inertia=inertia)))

    for ours, theirs in zip(
        traced(heavier.mass, heavier.inertia),
        (m.body_invweight0[1:], m.dof_invweight0),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, rtol=PARITY, atol=1e-15)


@pytest.mark.parametrize("driver", ["unrolled", pytest.param("rolled", marks=pytest.mark.slow)])
def test_a_batch_of_models_on_every_driver(driver: str) -> None:
    model = load_quietly("double_pendulum")
    scales = jnp.array([1.0, 2.0, 0.5])
    models = jax.vmap(
        lambda k: model.replace(bodies=model.bodies.replace(mass=k * model.bodies.mass))
    )(scales)
    found = jax.jit(jax.vmap(lambda x: inverse_weights(x.replace(driver=driver))))(models)
    for i in range(3):
        one = jax.tree.map(lambda x, i=i: x[i], models)
        for ours, expected in zip(found, inverse_weights(one), strict=True):
            np.testing.assert_allclose(ours[i], expected, rtol=PARITY, atol=1e-15)
    single = jax.jit(lambda x: inverse_weights(x, jnp.float32))(one.astype(jnp.float32))
    for ours, expected in zip(single, inverse_weights(one), strict=True):
        assert ours.dtype == jnp.float32
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-5)


def test_derivatives_by_masses_are_those_of_differences() -> None:
    text = f"<mujoco><worldbody>{CASES['references']}{CASES['slide along an axis']}"
    model = load_quietly(f"{text}</worldbody></mujoco>")
    assert model.solver.translating == (2,)

    def weights(mass):
        body, dof = inverse_weights(model.replace(bodies=model.bodies.replace(mass=mass)))
        return jnp.concatenate([jnp.ravel(body), dof])

    mass, step = model.bodies.mass, 1e-3
    exact = jax.jit(jax.jacrev(weights), compiler_options=QUICK)(mass)
    for b in range(model.nb):
        h = step * jnp.eye(model.nb)[b]
        difference = (weights(mass + h) - weights(mass - h)) / (2 * step)
        np.testing.assert_allclose(exact[:, b], difference, rtol=1e-6, atol=1e-6)


def test_a_program_of_a_constant_model_has_no_arithmetic() -> None:
    model = quadruped()
    program = jax.make_jaxpr(lambda x: x * float(inverse_weights(model)[0][0, 0]))(1.0)
    assert [str(e.primitive) for e in program.eqns] == ["mul"]
