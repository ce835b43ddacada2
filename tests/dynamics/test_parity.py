"""rbjax against MuJoCo C: positions, M, bias, forces and accelerations.

One compiled program a robot, over random states, against a loop over `mj_forward`. Forces are all
that MuJoCo has and calls no constraint: springs, dampers, actuators, fluids, gravity compensation.
"""

import functools

import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.models import MODELS, SINGULAR
from tests.robots import AS_USERS, QUICK, Robot, at, mass_matrix, robot
from tests.tolerances import F32_MAX, F32_MEDIAN, F64_PARITY, relative_error

STATES = 100

FAST = [  # (robot, driver, whether the model is an argument of the program: no structural zeros)
    ("pendulum", "unrolled", False),
    ("cart_pole", "unrolled", True),
    ("small", "unrolled", True),
    ("spinning_top", "unrolled", False),
    ("gyroscope", "rolled", False),
    pytest.param("quadrotor", "rolled", True, marks=pytest.mark.slow),
    ("satellite", "rolled", False),
    ("arm7", "rolled", False),
    pytest.param("tree:0", "rolled", False, marks=pytest.mark.slow),
    ("tree:1", "rolled", True),
    pytest.param("tree:2", "rolled", False, marks=pytest.mark.slow),
    pytest.param("tree:3", "rolled", False, marks=pytest.mark.slow),
    pytest.param("tree:4", "rolled", True, marks=pytest.mark.slow),
    pytest.param("tree:5", "rolled", False, marks=pytest.mark.slow),
    pytest.param("gymnasium/half_cheetah.xml", "unrolled", False, marks=pytest.mark.slow),
    ("gymnasium/swimmer.xml", "rolled", False),  # in a fluid
    ("frax/franka_panda/panda.urdf", "rolled", False),
    ("frax/unitree_g1/g1_29dof_rev_1_0.urdf+free", "rolled", False),
]
FAST_F32 = ["quadrotor"]
SLOW_F32 = ["tree:0", "tree:5", "gymnasium/half_cheetah.xml", "frax/franka_panda/panda.urdf"]
SLOW_F32 += ["arm7", "frax/unitree_g1/g1_29dof_rev_1_0.urdf+free"]
SLOW = [*MODELS, *(f"tree:{seed}" for seed in range(50))]
IMMERSED = [f"{name} in water" for name in (*rb.scenes(), *MODELS)]


def inputs(sample: Robot, dtype: type) -> dict[str, np.ndarray]:
    """States, controls, extra generalized forces and wrenches [moment; force] at body origins."""
    m, rng = sample.reference, np.random.default_rng(0)
    q, v = sample.states(STATES)
    out = {"q": q, "v": v, "x": sample.element_states(STATES)}
    out |= {"ctrl": rng.normal(size=(STATES, m.nu))}
    out |= {"tau": rng.normal(size=(STATES, m.nv)), "w": rng.normal(size=(STATES, m.nbody - 1, 6))}
    return {name: x.astype(dtype) for name, x in out.items()}


def expected(m: mujoco.MjModel, given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """MuJoCo's results. A wrench there is [force; torque] at the centre of mass."""
    rows: list[dict[str, np.ndarray]] = []
    data = mujoco.MjData(m)
    for k in range(STATES):
        x = {name: value[k].astype(float) for name, value in given.items()}
        data.qpos, data.qvel, data.act = x["q"], x["v"], x["x"]
        data.ctrl, data.qfrc_applied = x["ctrl"], x["tau"]
        mujoco.mj_kinematics(m, data)
        moment, force = x["w"][:, :3], x["w"][:, 3:]
        about_com = moment - np.cross(data.xipos[1:] - data.xpos[1:], force)
        data.xfrc_applied[1:] = np.concatenate([force, about_com], -1)
        mujoco.mj_forward(m, data)
        rows.append(
            {
                "R": data.xmat[1:].reshape(-1, 3, 3).copy(),
                "p": data.xpos[1:].copy(),
                "M": mass_matrix(m, data),
                "bias": data.qfrc_bias.copy(),
                "applied": data.qfrc_passive + data.qfrc_actuator,
                "acceleration": data.qacc.copy(),
            }
        )
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def answer(model, q, v, x, ctrl, tau, w):
    R, p = rb.forward_kinematics(model, q)
    applied = rb.applied_forces(model, rb.State(q, v, x if model.nx else None), ctrl)
    return {
        "R": R,
        "p": p,
        "M": rb.mass_matrix(model, q),
        "bias": rb.bias_forces(model, q, v),
        "applied": applied,
        "acceleration": rb.forward_dynamics(model, q, v, applied + tau, w),
    }


def errors(name: str, driver: str, *, argument: bool = False, dtype: type = np.float64):
    sample = robot(name, driver)
    given = inputs(sample, dtype)
    want = expected(sample.reference, given)
    batch = [given[n] for n in ("q", "v", "x", "ctrl", "tau", "w")]
    jit = functools.partial(jax.jit, compiler_options=AS_USERS)
    if argument:
        got = jit(jax.vmap(answer, (None, 0, 0, 0, 0, 0, 0)))(sample.model, *batch)
    else:
        got = jit(jax.vmap(lambda *x: answer(sample.model, *x)))(*batch)
    assert all(x.dtype == dtype for x in got.values())
    if name in SINGULAR:
        del want["acceleration"]
    return {n: relative_error(got[n], want[n], batch_dims=1) for n in want}


@pytest.mark.parametrize(("name", "driver", "argument"), FAST)
def test_f64(name: str, driver: str, argument: bool) -> None:
    for quantity, error in errors(name, driver, argument=argument).items():
        assert error.max() <= F64_PARITY, quantity


@pytest.mark.parametrize(
    "name", [*FAST_F32, *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW_F32)]
)
def test_f32(name: str) -> None:
    for quantity, error in errors(name, "rolled", dtype=np.float32).items():
        assert np.median(error) <= F32_MEDIAN, quantity
        assert error.max() <= F32_MAX, quantity


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_f64_everywhere(name: str) -> None:
    for quantity, error in errors(name, "rolled").items():
        assert error.max() <= F64_PARITY, quantity


@pytest.mark.parametrize(
    "name", ["small in water", *(pytest.param(n, marks=pytest.mark.slow) for n in IMMERSED)]
)
def test_forces_in_water(name: str) -> None:
    """What few files have: a fluid that flows, and springs and dampers by powers."""
    assert forces_error(name) <= F64_PARITY


def forces_error(name: str) -> float:
    """Of the applied forces, over random states."""
    sample = robot(name, "rolled")
    m, given = sample.reference, inputs(sample, np.float64)
    if not m.nv:
        return 0.0

    @functools.partial(jax.jit, compiler_options=QUICK)
    def found(q, v, x, ctrl):
        states = rb.State(q, v, x if sample.model.nx else None)
        return jax.vmap(functools.partial(rb.applied_forces, sample.model))(states, ctrl)

    got = found(*(given[n] for n in ("q", "v", "x", "ctrl")))
    data, want = mujoco.MjData(m), []
    for q, v, x, ctrl in zip(*(given[n] for n in ("q", "v", "x", "ctrl")), strict=True):
        data.qpos, data.qvel, data.act, data.ctrl = q, v, x, ctrl
        mujoco.mj_forward(m, data)
        want.append(data.qfrc_passive + data.qfrc_actuator)
    return float(relative_error(got, np.stack(want), batch_dims=1).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in rb.scenes() if n not in ("humanoid", "quadruped")])
def test_both_drivers_on_scenes(name: str) -> None:
    for driver in ("rolled", "unrolled"):
        for quantity, error in errors(name, driver).items():
            assert error.max() <= F64_PARITY, (driver, quantity)


def test_velocities_of_objects() -> None:
    """`mj_objectVelocity` of a body's frame, in world axes."""
    sample = robot("tree:1", "rolled")
    q, v = sample.states(10)
    got = jax.jit(jax.vmap(lambda q, v: rb.body_velocities(sample.model, q, v)))(q, v)
    want = np.zeros_like(got)
    for k in range(len(q)):
        data = at(sample.reference, q[k], v[k])
        for b in range(sample.model.nb):
            kind, row = mujoco.mjtObj.mjOBJ_XBODY, np.zeros(6)
            mujoco.mj_objectVelocity(sample.reference, data, kind, b + 1, row, 0)
            want[k, b] = row
    assert relative_error(got, want, batch_dims=1).max() <= F64_PARITY
