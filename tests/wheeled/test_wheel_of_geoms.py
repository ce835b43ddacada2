"""Wheels made of geoms under the contact laws, against rolling and sliding wheels.

The oracle is the wheeled room, in which no contact is solved, or a closed form of a rigid robot.
"""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax import wheeled
from rbjax.errors import UnknownName

KINDS = wheeled.kinds()
LAWS = ("mujoco", "coulomb", "impulse")
DT, SECONDS = 1e-3, 0.5
STEPS = round(SECONDS / DT)
#: m, distance from rolling after 0.2 m, with solref of two steps of 1 ms
NEAR = {"mujoco": 1e-4, "coulomb": 1e-4, "impulse": 1e-5}


def loaded(robot, dt=DT, **given):
    """The robot of a file, with contacts as stiff as the step allows."""
    stiff = {"solref": (2 * dt, 1.0), "solimp": (0.95, 0.95, 0.001), "impratio": 100.0}
    return rb.load(wheeled.write_mjcf(robot, timestep=dt, **stiff | given))


def torques(turn):
    """Torques (2,) of both wheels at a time."""

    def at(t):
        push = 0.15 * jnp.sin(np.pi * t / SECONDS)
        turns = turn * jnp.sin(2 * np.pi * t / SECONDS)
        return jnp.stack([push - turns, push + turns], -1)

    return at


def off(law, shape, turn, dt=DT, width=0.25):
    """The largest distance from the chassis that rolls, and the last state."""
    robot = KINDS["differential_drive"].make()
    rolling, u = wheeled.at(robot, "reduced"), torques(turn)
    start = wheeled.start(rolling, twist=[0.4, 0.0, 0.0])
    ours = wheeled.simulate(
        rolling, start, jnp.linspace(0, SECONDS, 11), lambda t, s: u(t), tolerance=1e-10
    )
    full = wheeled.full_model_state(rolling, start, base="free")
    count = round(SECONDS / dt)
    path = rb.rollout(
        loaded(robot, dt, wheel=shape, width=width), rb.State(full.q, full.v),
        u((jnp.arange(count) + 0.5) * dt), dt, contact=law, save_every=count // 10,
    )  # fmt: skip
    apart = np.asarray(path.q)[:, :2] - np.asarray(ours.q)[:, :2]
    return float(np.hypot(*apart.T).max()), path


@pytest.mark.slow
def test_a_wheel_of_one_point_rolls_and_turns():
    far, path = off("impulse", "ellipsoid", 0.05)
    assert far < NEAR["impulse"]
    assert abs(float(path.q[-1, 6])) > 1e-3  # it turned


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["ellipsoid", "sphere"])
@pytest.mark.parametrize("law", LAWS)
def test_wheels_of_one_point_converge_to_rolling(law, shape):
    near, far = (off(law, shape, 0.05, dt)[0] for dt in (DT, 2 * DT))
    assert near < NEAR[law]
    assert near < 0.7 * far


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["capsule", "cylinder"])
@pytest.mark.parametrize("law", ["mujoco", "coulomb"])
def test_wheels_of_a_line_roll_ahead_and_resist_turning(law, shape):
    """Ahead they roll. A turn with less torque than mu N h of each wheel does not begin."""
    far, path = off(law, shape, 0.0, width=0.05)
    assert far < NEAR[law]
    width = 0.25
    held = wheeled.at(KINDS["differential_drive"].make(), "constrained")
    load = float(wheeled.contacts(held, wheeled.start(held), jnp.zeros(2)).loads[0])
    most = 2 * 1.0 * load * width * 0.08 / 2  # N m: mu N h of two wheels
    assert most > 2 * 0.05 * 0.2 / 0.08  # the drives give less
    far, path = off(law, shape, 0.05, width=width)
    assert np.abs(np.asarray(path.q[:, 6])).max() < 1e-5


def locked(model):
    """The model with wheels that cannot turn: an armature of 10^9 kg m^2."""
    armature = model.joints.armature.at[6:].set(1e9)
    return model.replace(joints=model.joints.replace(armature=armature))


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_locked_wheels_brake(law):
    """A robot slides v^2 / (2 mu g), and turns w^2 I / (2 mu m g R) on the spot."""
    mu, v, w, dt = 0.5, 2.0, 3.0, 1e-3
    robot = KINDS["skid_steer"].make()
    model = locked(loaded(robot, dt, friction=mu))
    q, nv = model.default_state().q, model.nv
    distance = v**2 / (2 * mu * 9.81)
    # the moment about the vertical is mu m g R: all wheels are at the distance R
    slipping = wheeled.at(robot, "slipping", tyre=wheeled.Coulomb(mu, width=1e-6))
    spinning = wheeled.start(slipping, twist=[0.0, 0.0, w])
    spinning = spinning.replace(v=spinning.v.at[3:].set(0.0))
    slowing = float(wheeled.rates(slipping, spinning, jnp.zeros(2)).v[2])
    angle = w**2 / (2 * -slowing)

    def end(k, speed):
        start = rb.State(q, jnp.zeros(nv).at[k].set(speed))
        path = rb.rollout(model, start, jnp.zeros((600, 2)), dt, contact=law, save_every=600)
        assert np.abs(np.asarray(path.v[-1, :6])).max() < 1e-3  # it stands
        return np.asarray(path.q[-1])

    # to the length of a step
    np.testing.assert_allclose(end(0, v)[0], distance, atol=v * dt)
    np.testing.assert_allclose(2 * np.arctan2(*end(5, w)[[6, 3]]), angle, atol=w * dt)


@pytest.mark.slow
def test_loads_shift_as_it_brakes():
    """The impulses of a step are the loads and tractions of the tyres, on both axles."""
    mu = 0.5
    robot = KINDS["skid_steer"].make()
    model = locked(loaded(robot, friction=mu))
    slipping = wheeled.at(robot, "slipping", tyre=wheeled.Coulomb(mu, width=1e-6))
    start = wheeled.start(slipping, twist=[2.0, 0.0, 0.0])
    start = start.replace(v=start.v.at[3:].set(0.0))
    due = wheeled.contacts(slipping, start, jnp.zeros(2))
    moving = rb.State(model.default_state().q, jnp.zeros(model.nv).at[0].set(2.0))
    path = rb.rollout(model, moving, jnp.zeros((150, 2)), DT, contact="impulse", save_every=150)
    forces = np.asarray(path.memory[-1, :-1]).reshape(4, 3) / DT
    axles = forces.reshape(2, 2, 3).sum(0)  # left and right are not unique: the robot is rigid
    loads = np.asarray(due.loads).reshape(2, 2).sum(0)
    np.testing.assert_allclose(axles[:, 0], loads, rtol=1e-3)
    assert loads[0] > 2 * loads[1]  # it leans on its front
    np.testing.assert_allclose(np.hypot(*axles[:, 1:].T), mu * loads, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["coulomb", "impulse"])  # "mujoco" lifts wheels that spin
def test_wheels_spin_beyond_their_grip(law):
    """With more torque than mu N r the robot gains mu g, and wheels (tau - mu N r) / I."""
    mu, torque, dt, steps = 0.3, 25.0, 5e-4, 400
    robot = KINDS["skid_steer"].make()
    model = loaded(robot, dt, friction=mu)
    wheel, m = robot.wheels[0], float(model.bodies.mass.sum())
    grip = mu * m * 9.81 / 2 * float(wheel.radius)
    assert torque > 1.1 * grip
    slipping = wheeled.at(robot, "slipping", tyre=wheeled.Coulomb(mu, width=1e-6))
    start = wheeled.start(slipping)
    start = start.replace(v=start.v.at[3:].set(5.0))
    due = wheeled.rates(slipping, start, jnp.full(2, torque)).v
    np.testing.assert_allclose(due[0], mu * 9.81, rtol=1e-6)
    np.testing.assert_allclose(due[3:], (torque - grip) / (2 * float(wheel.inertia)), rtol=1e-6)
    q = model.default_state().q
    first = rb.State(q, jnp.zeros(model.nv).at[6:].set(5.0))
    path = rb.rollout(
        model, first, jnp.full((steps, 2), torque), dt, contact=law, save_every=steps // 2
    )
    gained = np.asarray(path.v[2] - path.v[1]) / (steps // 2 * dt)
    np.testing.assert_allclose(gained[0], due[0], rtol=2e-3)
    np.testing.assert_allclose(gained[6:], due[3], rtol=5e-3)


def resisting(c=0.02):
    return KINDS["differential_drive"].make().replace(resistance=wheeled.RollingResistance(c))


@pytest.mark.slow
@pytest.mark.parametrize("law", ["mujoco", "coulomb"])
def test_rolling_friction_of_contacts_is_rolling_resistance(law):
    """condim 6: the moment c r N on each wheel, as in the wheeled room.

    Under "mujoco" the light fork of the caster sinks in, and the robot leans.
    """
    robot = resisting()
    rolling = wheeled.at(robot, "reduced")
    start = wheeled.start(rolling, twist=[0.5, 0.0, 0.0])
    full = wheeled.full_model_state(rolling, start, base="free")
    model = loaded(robot, resistance="contacts")
    path = rb.rollout(
        model, rb.State(full.q, full.v), jnp.zeros((500, 2)), DT, contact=law, save_every=100
    )
    slowing = float(wheeled.rates(rolling, start, jnp.zeros(2)).v[0])
    found = float(path.v[5, 0] - path.v[1, 0]) / 0.4
    np.testing.assert_allclose(found, slowing, rtol={"mujoco": 0.05, "coulomb": 0.01}[law])


def test_rolling_resistance_in_a_file():
    """Of contacts it is c r in metres and condim 6; of axles the file has friction losses."""
    robot = resisting()
    m = mujoco.MjModel.from_xml_string(wheeled.write_mjcf(robot, resistance="contacts"))
    ids = [m.geom(f"wheel_{i}").id for i in range(3)]
    radii = [float(wheel.radius) for wheel in robot.wheels]
    np.testing.assert_allclose(m.geom_friction[ids, 2], 0.02 * np.array(radii), rtol=1e-12)
    np.testing.assert_allclose(m.geom_friction[ids, 0], 1.0)
    assert (m.geom_condim[ids] == 6).all() and not m.dof_frictionloss.any()
    m = mujoco.MjModel.from_xml_string(wheeled.write_mjcf(robot))
    assert (m.geom_condim[ids] == 3).all() and m.dof_frictionloss.any()
    with pytest.raises(UnknownName, match="axles"):
        wheeled.write_mjcf(robot, resistance="tyres")
