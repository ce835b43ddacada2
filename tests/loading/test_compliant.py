"""Soft equalities beside MuJoCo: accelerations, forces, motions as solref stiffens."""

import jax
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.methods.soft import compliant_motion
from rbjax.forces.acting import applied
from rbjax.forces.inputs import Inputs
from rbjax.loading import compile_model
from tests.loading.test_constraints import EQUALITIES, TREE

SOFTNESS = [  # the default, standard and direct, steep, flat and far
    "",
    'solref="0.1 0.7" solimp="0.3 0.98 2.0 0.3 3"',
    'solref="-300 -20" solimp="0.6 0.9 5.0 0.8 1"',
    'solref="0.0001 1" solimp="0.5 0.99 0 0.5 2"',
    'solref="-1000 0" solimp="0.9 0.2 1.5 0.5 1.5"',
]


def softened(equalities: list[str]) -> str:
    return TREE.format(
        "".join(x.replace("/>", f" {SOFTNESS[k % 5]}/>") for k, x in enumerate(equalities))
    )


def exact(text: str) -> mujoco.MjModel:
    m = compile_model(text)
    m.opt.solver, m.opt.tolerance, m.opt.iterations = mujoco.mjtSolver.mjSOL_NEWTON, 0.0, 100
    return m


@pytest.mark.parametrize("shift", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_accelerations_are_those_of_mujoco(shift: int) -> None:
    order = [*EQUALITIES][shift:] + [*EQUALITIES][:shift]
    text = softened(order)
    m, model = exact(text), rb.load(text, compliant=True, strict=True)
    assert [type(x) for x in model.constraints] == [rc.Soft] * len(order)
    data = mujoco.MjData(m)

    @jax.jit
    def ours(state):
        tau, f_ext, _ = applied(model, 0.0, state, Inputs(None))
        return compliant_motion(model, 0.0, state, tau, f_ext)[0]

    for key in jax.random.split(jax.random.key(1), 3):
        state = model.random_state(key)
        data.qpos, data.qvel = state.q, state.v
        mujoco.mj_forward(m, data)
        a = ours(state)
        scale = np.abs(data.qacc).max()
        np.testing.assert_allclose(a, data.qacc, rtol=0, atol=1e-11 * scale)


BAR = '<joint axis="0 1 0" damping="0.1"/><geom size="0.05" pos="{}" mass="{}"/>'
FOUR_BAR = f"""<mujoco><option integrator="RK4" timestep="0.0005"><flag contact="disable"/></option>
  <worldbody><body>{BAR.format("0.1 0 0.2", 1)}
    <body pos="0.2 0 0.4">{BAR.format("0.4 0 0.1", 2)}
      <body name="rocker" pos="0.8 0 0.2">{BAR.format("0 0 -0.3", 1.5)}</body></body></body>
  </worldbody><equality><connect body1="rocker" anchor="0.1 0 -0.7" {{}}/></equality></mujoco>"""
SECONDS = 0.25


def motion_of_mujoco(solref: str) -> tuple[np.ndarray, float]:
    """The configuration that MuJoCo comes to, and how far the loop is open there."""
    m = exact(FOUR_BAR.format(f'solref="{solref}"'))
    data = mujoco.MjData(m)
    for _ in range(round(SECONDS / m.opt.timestep)):
        mujoco.mj_step(m, data)
    mujoco.mj_forward(m, data)
    return data.qpos.copy(), float(np.linalg.norm(data.efc_pos))


@pytest.mark.slow
def test_mujoco_comes_to_the_rigid_motion_as_solref_stiffens() -> None:
    """By the square of the time constant; by one over the stiffness."""
    model = rb.load(FOUR_BAR.format(""))
    rigid = np.array(
        rb.rollout(model, model.default_state(), None, 5e-4, steps=500, integrator="rk4").q[-1]
    )
    standard = [f"{0.02 / 2**k} 1" for k in range(5)]
    direct = [f"{-1e4 * 4**k} {-100 * 2**k}" for k in range(4)]  # half of critical damping
    for softness in (standard, direct):
        found = [motion_of_mujoco(x) for x in softness]
        off = np.array([np.abs(q - rigid).max() for q, _ in found])
        gaps = np.array([gap for _, gap in found])
        assert 1e-4 < off[0] < 1e-3 and gaps[0] < 1e-3
        for x in (off, gaps):
            np.testing.assert_allclose((x[:-1] / x[1:])[-2:], 4.0, rtol=0.05)


WELDED = FOUR_BAR.replace(
    "</body></body></body>",
    f'<body name="tip" pos="0.1 0 -0.7">{BAR.format("0.3 0 -0.1", 1)}</body></body></body></body>',
).replace('<connect body1="rocker" anchor="0.1 0 -0.7"', '<weld body1="tip"')


@pytest.mark.slow
@pytest.mark.parametrize("text", [FOUR_BAR, WELDED], ids=["connect", "weld"])
def test_mjx_comes_to_the_rigid_motion_as_solref_stiffens(text: str) -> None:
    """By the square of the time constant, as MuJoCo."""
    dt, constants = 1.25e-4, 2.5e-3 / 2.0 ** np.arange(4)
    model = rb.load(text.format(""))
    rigid = rb.rollout(model, model.default_state(), None, dt, steps=500, integrator="rk4").q[-1]
    m = exact(text.format(""))
    m.opt.timestep, m.opt.tolerance, m.opt.iterations, m.opt.ls_iterations = dt, 1e-14, 20, 20
    theirs = mjx.put_model(m)

    def end(solref: jax.Array) -> jax.Array:
        softened = theirs.replace(eq_solref=solref[None])
        data = mjx.make_data(softened)
        return jax.lax.fori_loop(0, 500, lambda _, d: mjx.step(softened, d), data).qpos

    found = jax.jit(jax.vmap(end))(np.stack([constants, np.ones(4)], 1))
    off = np.abs(found - rigid).max(1)
    assert 1e-6 < off[0] < 1e-2
    np.testing.assert_allclose((off[:-1] / off[1:])[-2:], 4.0, rtol=0.05)


@pytest.mark.slow
def test_the_motion_is_that_of_mujoco() -> None:
    solref = "0.005 1"
    model = rb.load(FOUR_BAR.format(f'solref="{solref}"'), compliant=True)
    path = rb.rollout(
        model, model.default_state(), None, 5e-4, steps=round(SECONDS / 5e-4), integrator="rk4"
    )
    np.testing.assert_allclose(path.q[-1], motion_of_mujoco(solref)[0], rtol=0, atol=1e-10)


def test_written_and_read_back_they_yield_alike() -> None:
    model = rb.load(softened([*EQUALITIES]), compliant=True)
    again = rb.load(rb.write_mjcf(model, strict=True), compliant=True, strict=True)
    for a, b in zip(model.constraints, again.constraints, strict=True):
        assert (type(a.of), a.bias) == (type(b.of), b.bias)
        assert a.weight is None and b.weight is None
        for name in ("solref", "solimp"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-12)
        if isinstance(a.of, rc.QuaternionWeld):
            assert a.of.scale == b.of.scale
