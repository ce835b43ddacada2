"""The file of a wheeled robot against its full model, its motors, and the equations of rolling."""

import re
import warnings
import xml.etree.ElementTree as ET

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax import wheeled
from rbjax.errors import InputError, UnknownName, UnsupportedFeature
from rbjax.wheeled.models.robot_model import with_twist
from rbjax.wheeled.multibody.full_model import BASES, full_model
from rbjax.wheeled.robot.motors import limited
from tests.tolerances import relative_error

KINDS = wheeled.kinds()
ROLLERS = {"unicycle", "omni_3", "omni_4", "mecanum"}
ROLLING = [k for k in KINDS if k not in ROLLERS]
TIPPING = {"bicycle"}  # falls over in time
QUICK = ("differential_drive", "tricycle")
every_kind = pytest.mark.parametrize(
    "name", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in ROLLING]
)


def opened(robot, *off: str, **given):
    """The compiled file, without what `off` names of mjtDisableBit."""
    m = mujoco.MjModel.from_xml_string(wheeled.write_mjcf(robot, **given))
    for name in off:
        m.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    return m


@every_kind
def test_free_flight_is_that_of_the_full_model(name):
    robot = KINDS[name].make().replace(slope=jnp.array([0.1, -0.05]))
    model = full_model(robot, "free")
    m = opened(robot, "CONTACT", "EQUALITY", "LIMIT", "ACTUATION")
    m.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    d, M = mujoco.MjData(m), np.zeros((m.nv, m.nv))

    def ours(q, v, tau):
        energies = rb.potential_energy(model, q), rb.kinetic_energy(model, q, v)
        return rb.mass_matrix(model, q), rb.forward_dynamics(model, q, v, tau), jnp.stack(energies)

    run, rng = jax.jit(ours), np.random.default_rng(0)
    assert (model.nq, model.nv) == (m.nq, m.nv)
    np.testing.assert_allclose(m.body_mass.sum(), model.bodies.mass.sum(), rtol=1e-12)
    for _ in range(3):
        q, v, tau = rng.normal(size=m.nq), rng.normal(size=m.nv), rng.normal(size=m.nv)
        q[3:7] /= np.linalg.norm(q[3:7])
        d.qpos[:], d.qvel[:], d.qfrc_applied[:] = q, v, tau
        mujoco.mj_forward(m, d)
        mujoco.mj_fullM(m, d, M)
        mass, a, energies = run(q, v, tau)
        assert relative_error(mass, M) < 1e-12
        assert relative_error(a, d.qacc) < 1e-10
        np.testing.assert_allclose(energies, d.energy, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "shape"),
    [*((k, "ellipsoid") for k in ROLLING), ("car", "cylinder"), ("differential_drive", "sphere")],
)
def test_wheels_touch_and_it_stands(name, shape):
    robot = KINDS[name].make()
    m = opened(robot, wheel=shape)
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    touched = {m.geom(max(c.geom)).name for c in d.contact}
    assert touched == {f"wheel_{i}" for i in range(len(robot.wheels))}
    np.testing.assert_allclose([c.dist for c in d.contact], 0.0, atol=1e-12)
    for i, wheel in enumerate(robot.wheels):
        body = d.body(f"wheel_{i}").xpos
        np.testing.assert_allclose(body[2], wheel.radius, rtol=1e-12)
    if name in TIPPING:
        return
    mujoco.mj_step(m, d, 500)
    # sinks by g (1 - d) T^2 and by what MuJoCo's diagonal leaves out, at a light caster most
    assert all(-0.004 < c.dist < 0 for c in d.contact)
    assert len(d.contact) >= len(robot.wheels)
    assert np.abs(d.qvel[:6]).max() < 1e-3
    assert np.abs(d.qpos[:3]).max() < 2e-3


MOTORS = {
    "TorqueSource": wheeled.TorqueSource(),
    "SpeedServo": wheeled.SpeedServo(0.5),
    "DCMotor": wheeled.DCMotor(2.0, 0.05, gear=20.0, friction=0.01, rotor_inertia=1e-4),
}


@pytest.mark.parametrize("motor", MOTORS)
@pytest.mark.parametrize("name", ["differential_drive", "car"])
def test_drives_are_the_motors(name, motor):
    """The power of the actuators is torque(u, W) W of each motor, at its own cage's speed."""
    robot = KINDS[name].make(motor=MOTORS[motor])
    m = opened(robot)
    d, rng = mujoco.MjData(m), np.random.default_rng(1)
    d.qvel[:], d.ctrl[:] = rng.normal(size=m.nv), rng.normal(size=m.nu)
    mujoco.mj_forward(m, d)
    for j, drive in enumerate(robot.drives):
        rates = np.array([d.joint(f"wheel_{i}").qvel[0] for i in drive.wheels])
        cage = float(np.asarray(drive.split) @ rates)
        torque = float(drive.motor.torque(d.ctrl[j], cage))
        np.testing.assert_allclose(d.actuator(f"drive_{j}").force, torque, rtol=1e-12)
        for i, share in zip(drive.wheels, np.asarray(drive.split), strict=True):
            got = d.qfrc_actuator[m.joint(f"wheel_{i}").dofadr[0]]
            np.testing.assert_allclose(got, share * torque, rtol=1e-12)


def test_a_rotor_turns_with_its_differential():
    robot = KINDS["car"].make(motor=wheeled.DCMotor(1.0, 0.1, gear=8.0, rotor_inertia=0.05))
    m = opened(robot, timestep=1e-3)
    d = mujoco.MjData(m)
    d.ctrl[0] = 30.0
    mujoco.mj_step(m, d, 1000)
    cage = (d.joint("wheel_0").qvel + d.joint("wheel_1").qvel) / 2
    assert d.joint("motor_0").qvel[0] > 0.1
    np.testing.assert_allclose(d.joint("motor_0").qvel, cage, rtol=2e-3)


def test_limits_of_motors_are_corners_and_named():
    motors = wheeled.SpeedServo(0.5, 2.0), wheeled.DCMotor(1.0, 0.1, battery=12.0)
    robot = KINDS["differential_drive"].make()
    drives = [drive.replace(motor=x) for drive, x in zip(robot.drives, motors, strict=True)]
    with pytest.warns(UserWarning, match=r"motor of drive_0: it saturates.*motor of drive_1"):
        m = opened(robot.replace(drives=tuple(drives)))
    d = mujoco.MjData(m)
    d.ctrl[:] = 1e4
    mujoco.mj_forward(m, d)
    ends = [limited(1e4, x) for x in (motors[0].limit, motors[1].battery)]
    np.testing.assert_allclose(d.actuator_force, [ends[0], 0.1 * ends[1]], rtol=1e-12)


@pytest.mark.parametrize("lag", [None, 0.2])
@pytest.mark.parametrize("name", ["car", "tricycle"])
def test_steerings_follow_as_ours_do(name, lag):
    """The rate, or the angle behind its lag; with Ackermann's geometry to the fit's error."""
    robot = KINDS[name].make(lag=lag)
    m = opened(robot, timestep=1e-3, steering_time=2e-3)
    d = mujoco.MjData(m)
    u = d.ctrl[-1] = 0.3
    mujoco.mj_step(m, d, 1000)
    due = u if lag is None else u * (1 - np.exp(-1.0 / lag))
    # its rate takes `steering_time` to begin
    np.testing.assert_allclose(d.joint("steering_0").qpos, due, atol=0.3 * 3e-3)
    if name == "car":
        b, (L, w) = d.joint("steering_0").qpos[0], (2.6, 1.5)
        for i, side in ((2, 1), (3, -1)):
            angle = np.arctan2(np.tan(b), 1 - side * w / (2 * L) * np.tan(b))
            np.testing.assert_allclose(d.joint(f"knuckle_{i}").qpos, angle, atol=5e-4)


def test_rolling_resistance_brakes():
    resistance = wheeled.RollingResistance(0.02)
    robot = KINDS["differential_drive"].make().replace(resistance=resistance)
    m = opened(robot, impratio=100.0)
    vehicle = wheeled.at(robot, "reduced")
    start = wheeled.start(vehicle, twist=[0.5, 0.0, 0.0])
    full = wheeled.full_model_state(vehicle, start, base="free")
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = full.q, full.v
    mujoco.mj_step(m, d, 500)
    slowing = float(wheeled.rates(vehicle, start, jnp.zeros(2)).v[0])
    # half of a percent: the soft ground, on which the caster's light fork sinks most
    np.testing.assert_allclose(d.qvel[0] - 0.5, slowing, rtol=0.05)


@pytest.mark.parametrize(
    "name", ["differential_drive", pytest.param("car_trailer", marks=pytest.mark.slow)]
)
def test_states_of_the_full_model_agree(name):
    """One motion on all three bases: of one energy, on the rows."""
    robot = KINDS[name].make()
    vehicle = wheeled.at(robot, "reduced")
    state = wheeled.start(vehicle, pose=[0.3, -0.2, 0.7], twist=[2.0, 0.0, 0.1])
    state = state.replace(q=state.q.at[3 : robot.layout.casters.stop].set(0.2))
    u = jnp.zeros(2).at[len(robot.drives) :].set(0.15)
    energies = []
    for base in BASES:
        model = full_model(robot, base)
        full = wheeled.full_model_state(vehicle, state, u, base)
        assert (full.q.size, full.v.size) == (model.nq, model.nv)
        energies.append(float(jax.jit(rb.kinetic_energy)(model, full.q, full.v)))
        gaps = jax.jit(rb.constraints.residual)(model, full)[1]
        # the row of a steering's rate, of the model, is that of one at rest
        turning = 0.15 if robot.steerings else 0.0
        np.testing.assert_allclose(np.abs(gaps).max(), turning, atol=1e-12)
        np.testing.assert_allclose(np.sort(np.abs(gaps))[:-1], 0.0, atol=1e-12)
    np.testing.assert_allclose(energies, energies[0], rtol=1e-13)


def rolled(robot, u, seconds, time_constant, **given):
    """x, y at the end in MuJoCo, from 0.4 m/s ahead."""
    vehicle = wheeled.at(robot, "reduced")
    start = wheeled.start(vehicle, twist=[0.4, 0.0, 0.0])
    full = wheeled.full_model_state(vehicle, start, base="free")
    m = opened(robot, timestep=time_constant / 4, solref=(time_constant, 1.0), **given)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:], d.ctrl[:] = full.q, full.v, u
    mujoco.mj_step(m, d, round(seconds / m.opt.timestep))
    ours = wheeled.rollout(vehicle, start, lambda t, s: jnp.asarray(u), 0.01, steps=50)
    return float(np.hypot(*(d.qpos[:2] - np.asarray(ours.q[-1, :2]))))


def test_the_motion_becomes_ours_as_contacts_stiffen():
    robot = KINDS["differential_drive"].make()
    soft, stiff = (rolled(robot, [0.1, 0.16], 0.5, T, impratio=100.0) for T in (0.008, 0.002))
    # 0.2 m of way; the error falls at least in proportion to T
    assert soft < 2e-3
    assert stiff < soft / 4


def test_options_are_attributes_of_the_file():
    """Numbers with all digits, names as they are, and this module's own options otherwise."""
    step = 1 / 3000
    root = ET.fromstring(
        wheeled.write_mjcf(KINDS["differential_drive"].make(), integrator="Euler", timestep=step)
    )
    option = root.find("option").attrib
    assert (option["integrator"], option["cone"]) == ("Euler", "elliptic")
    assert float(option["timestep"]) == step and float(option["impratio"]) == 10.0


def test_the_file_names_the_error_of_its_linkage():
    """That of the polynomials of degree 4 against Ackermann's angles, within the stop."""
    L, track, reach = 2.0, 1.2, 0.5
    made = wheeled.write_mjcf(KINDS["car"].make(wheelbase=L, track=track), steering_range=reach)
    stated = float(re.search(r"linkage within (\S+) rad", made)[1])
    b = reach * np.cos(np.pi * (np.arange(33) + 0.5) / 33)
    worst = 0.0
    for element in ET.fromstring(made).iter("joint"):
        if element.get("polycoef") is None:
            continue
        side = 1.0 if element.get("joint1") == "knuckle_2" else -1.0
        angle = np.arctan2(L * np.sin(b), L * np.cos(b) - side * track / 2 * np.sin(b))
        terms = np.array(element.get("polycoef").split(), float)
        worst = max(worst, np.abs(np.polyval(terms[::-1], b) - angle).max())
    assert worst > 0 and stated == float(f"{worst:.1g}")


def test_what_is_refused(tmp_path):
    robot = KINDS["differential_drive"].make()
    for bad, error, words in (
        ({"wheel": "cube"}, UnknownName, "ellipsoid"),
        ({"friction": -1.0}, InputError, "friction"),
        ({"width": jnp.nan}, InputError, "width"),
        ({"steering_time": 0.0}, InputError, "steering_time"),
        ({"cone": "round"}, rb.ModelError, "round"),
    ):
        with pytest.raises(error, match=words):
            wheeled.write_mjcf(robot, **bad)
    with pytest.raises(UnsupportedFeature, match="rollers"):
        wheeled.write_mjcf(KINDS["omni_3"].make())
    with pytest.raises(InputError, match="expected a Robot"):
        wheeled.write_mjcf("car")
    with pytest.raises(InputError, match="traced"):
        jax.jit(lambda r: (wheeled.write_mjcf(r), 0)[1])(robot)

    class Spring(wheeled.Motor):
        def torque(self, u, speed):
            return u

        def free_speed(self, u):
            return u

    with pytest.raises(UnsupportedFeature, match="Spring"):
        wheeled.write_mjcf(KINDS["differential_drive"].make(motor=Spring()))
    path = tmp_path / "robot.xml"
    text = wheeled.write_mjcf(robot, path, friction=0.7)
    assert path.read_text() == text
    assert ET.fromstring(text).find(".//default[@class='wheel']/geom").get("friction") == "0.7"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # contacts are left out
        again = rb.load(path)
    assert again.joint_names == full_model(robot, "free").joint_names


@pytest.mark.parametrize(
    ("name", "roles"),
    [
        ("differential_drive", {"wheels": "wheel_*", "casters": ["caster_2"]}),
        ("car", {"wheels": "wheel_*", "steerings": [["knuckle_2", "knuckle_3"]]}),
    ],
)
def test_a_robot_read_from_its_own_file_is_that_robot(name, roles):
    robot = KINDS[name].make()
    damped = [
        w if w.kind == "caster" else w.replace(damping=jnp.asarray(0.1)) for w in robot.wheels
    ]
    robot = robot.replace(wheels=tuple(damped))
    again = wheeled.from_file(wheeled.write_mjcf(robot), **roles)
    names = ("radius", "inertia", "mass", "yaw_inertia", "damping", "trail", "position", "heading")
    for wheel, found in zip(robot.wheels, again.wheels, strict=True):
        for name in names:
            np.testing.assert_allclose(getattr(found, name), getattr(wheel, name), atol=1e-12)
    for name in ("mass", "inertia", "com", "height"):
        due = getattr(robot.bodies[0], name)
        np.testing.assert_allclose(getattr(again.bodies[0], name), due, atol=1e-12, rtol=1e-12)


@pytest.mark.slow
def test_in_a_curve_wheels_slide_outwards_at_the_rate_that_mujoco_leaves_out():
    """J v' = -b J v without J' v: across the rear axle, speed * turning rate * d T / 2."""
    robot, T, d_w = KINDS["car"].make(), 0.01, 0.95
    vehicle = wheeled.at(robot, "reduced")
    start = wheeled.start(vehicle)
    start = with_twist(vehicle, start.q.at[3].set(0.1), jnp.array([3.0, 0.0, 0.0]))
    full = wheeled.full_model_state(vehicle, start, base="free")
    m = opened(robot, timestep=T / 10, solref=(T, 1.0), solimp=(d_w, d_w, 0.001), impratio=1e3)
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = full.q, full.v
    mujoco.mj_step(m, d, 1000)
    turning = np.empty(3)
    mujoco.mju_rotVecQuat(turning, d.qvel[:3], d.qpos[3:7] * [1, -1, -1, -1])
    slides = -turning[0] * d.qvel[5] * d_w * T / 2
    assert abs(slides) > 1e-3
    np.testing.assert_allclose(turning[1], slides, rtol=0.01)
