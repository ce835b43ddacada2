"""Touching geoms against MuJoCo's contacts and distances."""

import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.geometry.shapes import Shape
from rbjax.envs.terms.frames import actuator_forces
from rbjax.envs.terms.touch import box_separation, touching_at
from rbjax.forces import Context
from rbjax.lanes import Mat3, Vec3

XML = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="0 0 1" pos="0 0 0.1" euler="10 20 0"/>
  <body><freejoint/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
    <geom name="ball" type="sphere" size="0.2" pos="0 0 1"/>
    <geom name="pill" type="capsule" size="0.1 0.3" pos="1 0 1" euler="30 40 0"/>
    <geom name="block" type="box" size="0.1 0.2 0.3" pos="2 0 1" euler="20 50 10"/></body>
  <body><freejoint/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
    <geom name="other_pill" type="capsule" size="0.1 0.3" pos="1 0 1"/>
    <geom name="other_block" type="box" size="0.3 0.2 0.1" pos="2 0 1"/>
    <geom name="brick" type="box" size="0.2 0.2 0.1" pos="0 0 1.2"/></body>
</worldbody></mujoco>"""
PAIRS = (
    ("ball", "floor"), ("floor", "pill"), ("block", "floor"), ("block", "other_block"),
    ("pill", "other_pill"), ("ball", "brick"),
)  # fmt: skip
COUNT = 200


@pytest.fixture(scope="module")
def places():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(COUNT, 14)) * np.repeat([0.3, 0.3, 0.1, 0.1], [3, 4, 3, 4])
    q[:, [2, 3]] += [-0.7, 1]
    q[:, 7:] += q[:, :7]  # the second body is near the first
    for k in (3, 10):
        q[:, k : k + 4] /= np.linalg.norm(q[:, k : k + 4], axis=1, keepdims=True)
    return q


def test_touch_is_a_negative_distance(places):
    model, due = mujoco.MjModel.from_xml_string(XML), []
    data, ours = mujoco.MjData(model), rb.load(XML)
    for q in places:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        ids = [[model.geom(name).id for name in pair] for pair in PAIRS]
        due.append([mujoco.mj_geomDistance(model, data, *pair, 10.0, None) for pair in ids])
    due = np.array(due)

    @jax.jit
    @jax.vmap
    def found(q):
        state = rb.State(q, jax.numpy.zeros(12))
        return touching_at(Context.of(ours, 0.0, state, None), PAIRS)

    clear = abs(due) > 1e-5  # MuJoCo's distances of boxes are iterative
    touch = np.asarray(found(places))
    assert (touch == (due < 0))[clear].all()
    assert (touch.mean(0) > 0.05).all() and (touch.mean(0) < 0.95).all()


def test_touch_within_a_reach():
    model = rb.load(XML)
    q = np.array([0, 0, 0, 1.0, 0, 0, 0] * 2)
    context = Context.of(model, 0.0, rb.State(q, np.zeros(12)), None)
    assert not touching_at(context, [("ball", "floor")])[0]
    assert touching_at(context, [("ball", "floor")], 1.0)[0]


def test_separation_of_parallel_boxes():
    size = Vec3(0.1, 0.2, 0.3)
    one = Shape(Vec3(0.0, 0.0, 0.0), Mat3.identity(), size)
    other = Shape(Vec3(0.5, 0.1, 0.2), Mat3.identity(), size)
    assert np.isclose(box_separation(one, other), 0.3, atol=1e-15)


def test_pairs_that_are_not_there():
    model = rb.load(XML)
    context = Context.of(model, 0.0, model.default_state(), None)
    with pytest.raises(rb.errors.UnknownName, match="wall"):
        touching_at(context, [("ball", "wall")])
    with pytest.raises(rb.InputError, match="pairs is empty, expected"):
        touching_at(context, [])


def test_forces_of_a_robot_without_actuators():
    model = rb.load(XML)
    with pytest.raises(rb.InputError, match="the robot has no actuators"):
        actuator_forces(Context.of(model, 0.0, model.default_state(), None))
