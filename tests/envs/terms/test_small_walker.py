"""Terms on a small robot with two feet, against NumPy and MuJoCo."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs import terms
from rbjax.envs.terms.frames import actuator_forces
from rbjax.forces import Context
from rbjax.sensors.solution import MotionSolution

XML = """<mujoco><option timestep="0.002" tolerance="0" iterations="100"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="1"/>
  <body name="base" pos="0 0 0.5"><freejoint/><geom type="box" size="0.1 0.2 0.05" contype="0"/>
    <site name="imu" pos="0.02 0.01 0.03" euler="0 10 0"/>
    <body name="left" pos="0 0.2 0"><joint name="l" axis="0 1 0" range="-0.6 0.5" limited="true"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.45" size="0.02" contype="0"/>
      <geom name="left" type="sphere" pos="0 0 -0.45" size="0.05"/>
      <site name="left" pos="0 0 -0.45"/></body>
    <body name="right" pos="0 -0.2 0"><joint name="r" axis="0 1 0" range="-0.6 0.5" limited="true"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.45" size="0.02" contype="0"/>
      <geom name="right" type="sphere" pos="0 0 -0.45" size="0.05"/>
      <site name="right" pos="0 0 -0.45"/></body></body>
  </worldbody><actuator><position joint="l" kp="20" forcerange="-3 3"/>
    <position joint="r" kp="20" forcerange="-3 3"/></actuator></mujoco>"""
HOME, FEET = (0.1, -0.2), terms.Feet(("left", "right"), (("left", "floor"), ("right", "floor")))
TERMS = {
    "track_velocity": terms.track_velocity("imu"),
    "track_yaw_rate": terms.track_yaw_rate("imu", width=0.5),
    "vertical_velocity": terms.vertical_velocity("imu", "base"),
    "roll_and_pitch_rate": terms.roll_and_pitch_rate("base"),
    "gravity_direction": terms.gravity_direction("imu"),
    "tilt": terms.tilt("imu"),
    "axis_error": terms.axis_error("imu", (0.1, 0.2, 0.9)),
    "fallen": terms.fallen("imu", 0.985),
    "joint_offsets": terms.joint_offsets(HOME),
    "joint_velocities": terms.joint_velocities(2),
    "pose_error": terms.pose_error(HOME, (1.0, 2.0)),
    "pose_similarity": terms.pose_similarity(HOME),
    "joint_deviation": terms.joint_deviation(HOME, lambda t: t.variables["command"][:2]),
    "stand_still": terms.stand_still(HOME),
    "joint_limit_violation": terms.joint_limit_violation((-0.3, -0.3), (0.2, 0.2)),
    "forces": terms.forces,
    "force_norms": terms.force_norms,
    "absolute_forces": terms.absolute_forces,
    "squared_forces": terms.squared_forces,
    "power": terms.power,
    "action_rate": terms.action_rate,
    "joint_acceleration": terms.joint_acceleration(2),
    "contact": FEET.contact,
    "heights": FEET.heights,
    "velocities": FEET.velocities,
    "landing": FEET.landing,
    "slip": FEET.slip,
    "clearance": FEET.clearance(0.1),
    "swing_height": FEET.swing_height(0.1),
    "air_time_reward": FEET.air_time_reward(0.1, 0.2),
    "base_slip": FEET.base_slip("base"),
    "any_touching": terms.any_touching(FEET.pairs),
    "terminated": terms.terminated,
    "loads": lambda t: terms.two_foot_loads(t.after, FEET),
    "excess_load": terms.excess_load(FEET, 10.0),
}
COUNT = 40


@pytest.fixture(scope="module")
def cases():
    """States with MuJoCo's data, the other arguments of the terms, and the values of the terms."""
    mj, model, rng = mujoco.MjModel.from_xml_string(XML), rb.load(XML), np.random.default_rng(0)
    data, rows = [], []
    for k in range(COUNT):
        d = mujoco.MjData(mj)
        d.qpos[:] = [
            *rng.normal(size=2),
            0.48 + 0.03 * rng.normal(),
            1,
            *0.05 * rng.normal(size=3),
            0,
            0,
        ]
        d.qpos[3:7] /= np.linalg.norm(d.qpos[3:7])
        d.qpos[7:], d.qvel[:] = rng.normal(size=2) * 0.3, rng.normal(size=8)
        d.ctrl[:] = rng.normal(size=2)
        mujoco.mj_forward(mj, d)
        data.append(d)
        rows.append({
            "q": d.qpos, "v": d.qvel, "a": d.qacc, "ctrl": d.ctrl,
            "command": rng.normal(size=3) * (k % 5 > 0), "action": rng.normal(size=2),
            "last": rng.normal(size=2), "air_time": rng.choice([0.02, 0.15, 0.3], 2),
            "swing_peak": rng.uniform(0, 0.2, 2), "last_contact": 1.0 * (rng.random(2) < 0.3),
        })  # fmt: skip

    @jax.jit
    @jax.vmap
    def values(r):
        context = Context.of(model, 0.0, rb.State(r["q"], r["v"]), r["ctrl"])
        solution = MotionSolution(context, acceleration=r["a"])
        after = Context.of(model, 0.0, rb.State(r["q"], r["v"]), r["ctrl"])
        object.__setattr__(after, "solution", solution)
        t = SimpleNamespace(after=after, variables=r, action=r["action"], last_action=r["last"],
                            dt=0.02, terminated=r["q"][2] < 0.5)  # fmt: skip
        return {name: read(t) for name, read in TERMS.items()}

    stacked = {name: jnp.stack([jnp.asarray(r[name]) for r in rows]) for name in rows[0]}
    return mj, data, rows, jax.tree.map(np.asarray, values(stacked))


def site(mj, d, kind, name):
    i, six = mj.__getattribute__(kind)(name).id, np.zeros(6)
    code = {"site": mujoco.mjtObj.mjOBJ_SITE, "body": mujoco.mjtObj.mjOBJ_XBODY}[kind]
    mujoco.mj_objectVelocity(mj, d, code, i, six, 0)
    R = (d.site_xmat if kind == "site" else d.xmat)[i].reshape(3, 3)
    return (d.site_xpos if kind == "site" else d.xpos)[i], R, six[3:], six[:3]


def by_numpy(mj, d, r):
    _, R, v, w = site(mj, d, "site", "imu")
    _, _, base_v, base_w = site(mj, d, "body", "base")
    c, e, f = r["command"], d.qpos[7:] - HOME, d.actuator_force
    moving = np.linalg.norm(c) > 0.01
    feet = [site(mj, d, "site", name) for name in ("left", "right")]
    z, speed = np.array([x[0][2] for x in feet]), np.array([np.hypot(*x[2][:2]) for x in feet])
    touch = z < 0.05
    landing = (r["air_time"] > 0.03) & touch
    q = d.qpos[7:]
    return {
        "track_velocity": np.exp(-np.sum((c[:2] - (R.T @ v)[:2]) ** 2) / 0.25),
        "track_yaw_rate": np.exp(-((c[2] - (R.T @ w)[2]) ** 2) / 0.5),
        "vertical_velocity": v[2] ** 2 + base_v[2] ** 2,
        "roll_and_pitch_rate": base_w[0] ** 2 + base_w[1] ** 2,
        "gravity_direction": R.T @ [0, 0, -1],
        "tilt": np.sum(R[:2, 2] ** 2),
        "axis_error": np.sum((R[:, 2] - [0.1, 0.2, 0.9]) ** 2),
        "fallen": R[2, 2] < 0.985,
        "joint_offsets": e,
        "joint_velocities": d.qvel[6:],
        "pose_error": e[0] ** 2 + 2 * e[1] ** 2,
        "pose_similarity": np.exp(-np.sum(e**2)),
        "joint_deviation": np.sum(c[:2] * abs(e)),
        "stand_still": abs(e).sum() * (not moving),
        "joint_limit_violation": (np.maximum(-0.3 - q, 0) + np.maximum(q - 0.2, 0)).sum(),
        "forces": f,
        "force_norms": np.linalg.norm(f) + abs(f).sum(),
        "absolute_forces": abs(f).sum(),
        "squared_forces": f @ f,
        "power": np.sum(abs(d.qvel[6:] * f)),
        "action_rate": np.sum((r["action"] - r["last"]) ** 2),
        "joint_acceleration": np.sum(d.qacc[6:] ** 2),
        "contact": touch,
        "heights": z,
        "velocities": np.concatenate([x[2] for x in feet]),
        "landing": landing,
        "slip": np.sum(speed**2 * touch) * moving,
        "clearance": np.sum(abs(z - 0.1) * np.sqrt(speed)),
        "swing_height": np.sum((r["swing_peak"] / 0.1 - 1) ** 2 * landing) * moving,
        "air_time_reward": np.sum((np.minimum(r["air_time"], 0.2) - 0.1) * landing) * moving,
        "base_slip": np.hypot(*base_v[:2]) * touch.sum(),
        "any_touching": touch.any(),
        "terminated": d.qpos[2] < 0.5,
    }


def test_terms(cases):
    mj, data, rows, values = cases
    for i, (d, r) in enumerate(zip(data, rows, strict=True)):
        for name, due in by_numpy(mj, d, r).items():
            np.testing.assert_allclose(values[name][i], due, rtol=1e-11, atol=1e-11, err_msg=name)
    for name, found in values.items():
        assert np.ptp(found.astype(float)) > 0, f"{name} is the same in all states"


def test_loads_of_two_feet_are_the_contact_forces(cases):
    mj, data, _, values = cases
    both = 0
    for i, d in enumerate(data):
        due, force = np.zeros(2), np.zeros(6)
        for k, contact in enumerate(d.contact):
            mujoco.mj_contactForce(mj, d, k, force)
            names = {mj.geom(g).name for g in contact.geom}
            due[int("right" in names)] += force[0]
        found = values["loads"][i]
        np.testing.assert_allclose(found.sum(), due.sum(), atol=1e-8)  # forces of 1e3
        # friction (coefficient 1) at a contact up to 3 cm deep, of feet 0.4 m apart
        np.testing.assert_allclose(found, due, rtol=0, atol=0.03 / 0.4 * due.sum() + 1e-8)
        np.testing.assert_allclose(
            values["excess_load"][i], np.maximum(found - 10, 0).sum(), atol=1e-9
        )
        both += (due > 0).all()
    assert both >= 5


def test_actuator_forces_are_computed_once():
    model = rb.load(XML)
    context = Context.of(model, 0.0, model.default_state(), jnp.ones(2))
    assert actuator_forces(context) is actuator_forces(context)


def test_loads_need_a_floating_base():
    model = rb.load("double_pendulum")
    context = Context.of(model, 0.0, model.default_state(), None)
    with pytest.raises(rb.InputError, match="free joint"):
        terms.two_foot_loads(context, FEET)
