"""Frames of geoms, centers of mass and turned axes, against MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, relative_error

ARM = """<mujoco><worldbody><body name="a"><joint name="p" axis="0 1 0.1"/>
<inertial pos="0.1 0.2 0.3" mass="1" diaginertia="0.1 0.1 0.1"/>
<body name="b" pos="0.3 0 0.1" quat="1 0.2 0 0"><joint name="r" type="ball"/>
<inertial pos="0.02 0.1 0.05" mass="2" diaginertia="0.1 0.2 0.15" quat="0.9 0.1 0.2 0.3"/>
<geom name="g" type="box" size="0.1 0.2 0.3" pos="0.1 0.05 0" quat="0.5 0.1 0.2 0.3"
 contype="0" conaffinity="0"/></body></body></worldbody></mujoco>"""


def test_pose_velocity_and_jacobian_of_geoms_and_centers_of_mass():
    m = mujoco.MjModel.from_xml_string(ARM)
    model, d = load_quietly(m), mujoco.MjData(m)
    state = model.random_state(jax.random.key(0))
    d.qpos[:], d.qvel[:] = state.q, state.v
    mujoco.mj_forward(m, d)
    turn = tuple(m.body_iquat[2])
    cases = [
        (rb.Frame(geom="g"), d.geom_xpos[0], d.geom_xmat[0], mujoco.mj_jacGeom, 0),
        (rb.Frame(center="b", orientation=turn), d.xipos[2], d.ximat[2], mujoco.mj_jacBodyCom, 2),
    ]
    for frame, p, R, jac, index in cases:
        found_R, found_p = rb.frame_pose(model, state.q, frame)
        assert relative_error(found_p, p) < F64_PARITY
        assert relative_error(found_R, R.reshape(3, 3)) < F64_PARITY
        J = np.zeros((2, 3, m.nv))
        jac(m, d, J[0], J[1], index)
        J = np.concatenate([J[1], J[0]])
        assert relative_error(rb.jacobian(model, state.q, frame), J) < F64_PARITY
        V = rb.frame_velocity(model, state.q, state.v, frame)
        assert relative_error(V, J @ d.qvel) < F64_PARITY
    at = rb.Frame(geom="g", point=jnp.array([0.1, 0.0, 0.0]))
    want = d.geom_xpos[0] + 0.1 * d.geom_xmat[0].reshape(3, 3)[:, 0]
    assert relative_error(rb.frame_pose(model, state.q, at)[1], want) < F64_PARITY


def test_bad_frames_are_named():
    model = load_quietly(ARM)
    q = model.default_state().q
    with pytest.raises(rb.UnknownName, match="geom 'h'"):
        rb.frame_pose(model, q, rb.Frame(geom="h"))
    with pytest.raises(rb.InputError, match="has geom and center, expected exactly one"):
        rb.frame_pose(model, q, rb.Frame(geom="g", center="b"))
