"""Force, torque and touch sensors with constraints, given wrenches and contacts, as MuJoCo's."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from rbjax.sensors import ContactForces, Context, MotionSolution
from tests.sensors.equipped import loaded, random_motion, rich, sensed_by_mujoco
from tests.tolerances import F64_PARITY, relative_error

LOOP = """<mujoco><option timestep="0.002"/><worldbody>
<body name="a" pos="0 0 1"><joint name="p" axis="0 1 0.1"/>
 <joint name="s" type="slide" axis="1 0 0.2"/><geom type="box" size="0.1 0.05 0.05" pos="0.1 0 0"/>
 <site name="root" pos="0.05 0 0" quat="1 0.2 0.3 0.1"/>
 <body name="b" pos="0.3 0 0"><geom type="box" size="0.1 0.04 0.03" pos="0.1 0 0"/>
  <site name="mid" pos="0.02 0.01 0" quat="0.3 0.2 0.5 0.1"/>
  <body name="c" pos="0.2 0.1 0"><joint type="ball"/><geom type="box" size="0.05 0.05 0.1"/>
   <site name="end" pos="0.01 0 0.1"/></body></body></body>
<body name="d" pos="0.6 0.1 0.9"><freejoint/><geom type="box" size="0.1 0.1 0.05"/>
 <site name="free" pos="0.02 0 0"/></body>
</worldbody>
<equality><connect body1="c" body2="d" anchor="0 0 0.12"/><weld body1="b" body2="d"/>
 <joint joint1="p" joint2="s" polycoef="0.1 0.5 0 0 0"/></equality>
<sensor>%s</sensor></mujoco>"""
SITES = ("root", "mid", "end", "free")
SENSORS = "".join(
    f'<force site="{s}"/><torque site="{s}"/><accelerometer site="{s}"/>' for s in SITES
)


def test_forces_of_connects_and_welds():
    """The constraints are compliant, as MuJoCo's; given wrenches act too."""
    m = mujoco.MjModel.from_xml_string(LOOP % SENSORS)
    model = loaded(m, compliant=True, contacts=False)
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    m.opt.tolerance, m.opt.iterations = 0.0, 100
    m.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    d, rng = mujoco.MjData(m), np.random.default_rng(2)
    read = jax.jit(lambda s, w: rb.sense(model, s, wrenches=w))
    for _ in range(3):
        mujoco.mj_resetData(m, d)
        mujoco.mj_integratePos(m, d.qpos, 0.03 * rng.normal(size=m.nv), 1.0)
        d.qvel[:] = rng.normal(size=m.nv)
        given = rng.normal(size=(model.nb, 6))  # force and torque at the center of mass
        d.xfrc_applied[1:] = given
        mujoco.mj_forward(m, d)
        arm = d.xipos[1:] - d.xpos[1:]
        moment = given[:, 3:] + np.cross(arm, given[:, :3])
        wrenches = jnp.asarray(np.concatenate([moment, given[:, :3]], 1))
        found = read(rb.State(jnp.asarray(d.qpos), jnp.asarray(d.qvel)), wrenches)
        assert relative_error(found, d.sensordata) < F64_PARITY


def test_forces_of_spatial_tendons():
    """Those of actuators, springs and dampers; sites on the world are left out, where MuJoCo adds
    torques about different points."""
    m = rich("FORCE", "TORQUE")
    model = loaded(m, contacts=False)
    model = model.replace(
        sensors=tuple(x for x in model.sensors if x.sensor.frame.site != "ground")
    )
    off = mujoco.mjtDisableBit
    m.opt.disableflags |= int(off.mjDSBL_LIMIT) | int(off.mjDSBL_CONTACT)
    for seed in range(3):
        state, ctrl = random_motion(model, seed, m.nu)
        found = rb.sense(model, state, ctrl, named=True)
        want, d = sensed_by_mujoco(m, state, ctrl)
        assert abs(d.cfrc_ext).max() > 0.01
        for name, value in found.items():
            assert relative_error(value, want[name]) < F64_PARITY


STAND = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
<body name="trunk" pos="0 0 0.5"><freejoint/><geom name="top" type="box" size="0.1 0.1 0.1"/>
 <body name="leg" pos="0 0 -0.2"><joint name="knee" axis="0 1 0"/>
  <geom name="shin" type="capsule" size="0.03 0.1"/>
  <body name="foot" pos="0.05 0 -0.15"><geom name="sole" type="box" size="0.1 0.06 0.02"/>
   <site name="ankle" pos="0 0 0.02" quat="1 0.1 0.2 0.3"/>
   <site name="heel" type="sphere" size="0.1" pos="-0.1 0 -0.02"/>
   <site name="pad" type="box" size="0.2 0.1 0.03" pos="0.05 0 -0.02"/></body></body></body>
</worldbody><sensor><force site="ankle"/><torque site="ankle"/><touch site="heel"/>
<touch site="pad"/><accelerometer site="ankle"/></sensor></mujoco>"""


def contacts_of(m, d) -> ContactForces:
    """The contacts of MuJoCo with their forces, as a contact law gives them, and one without."""
    rows = []
    for i in range(d.ncon):
        force = np.zeros(6)
        mujoco.mj_contactForce(m, d, i, force)
        c = d.contact[i]
        rows.append((True, c.dist, c.pos, c.frame.reshape(3, 3), force, tuple(map(int, c.geom))))
    rows.append((False, 1.0, np.zeros(3), np.eye(3), np.zeros(6), rows[0][5]))
    *arrays, geoms = zip(*rows, strict=True)
    return ContactForces(*(jnp.asarray(np.array(x)) for x in arrays), geoms)


def test_contact_forces_are_felt():
    m = mujoco.MjModel.from_xml_string(STAND)
    model, d = loaded(m), mujoco.MjData(m)
    d.qpos[2], d.qpos[3:7] = 0.365, [1.0, 0.01, 0.02, 0.0]
    d.qvel[:] = np.random.default_rng(0).normal(size=m.nv) * 0.3
    mujoco.mj_forward(m, d)
    assert d.ncon > 2
    state = rb.State(jnp.asarray(d.qpos), jnp.asarray(d.qvel))
    context = Context.of(model, 0.0, state, None)
    solution = MotionSolution(context, contacts=contacts_of(m, d), acceleration=jnp.asarray(d.qacc))
    context = dataclasses.replace(context, solution=solution)
    with jax.disable_jit():
        found = np.concatenate([sensor(context) for sensor in model.sensors])
    assert relative_error(found, d.sensordata) < F64_PARITY
    touches = found[6:8]
    assert 0 < touches[0] < touches[1]  # the heel feels some of the contacts of the pad
    none = rb.sense(model.replace(contact=None), state)[
        6:8
    ]  # without a contact law nothing is touched
    np.testing.assert_array_equal(none, 0.0)
