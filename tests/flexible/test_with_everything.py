"""Sensors, integrators, solvers, drivers and copies of models with beams."""

import functools
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sensors
from tests.flexible.beams import ARM, on_a_hinge, round_beam
from tests.tolerances import F64_TRANSFORM

MASS, COM = 0.2, (0.02, 0.0, 0.01)
#: an arm whose tip has a site; a beam replaces the joint "rod"
FILE = f"""
<mujoco><option gravity="0 0 -9.81"/><worldbody>
  <body name="upper"><joint name="hip" axis="0 1 0"/>
    <inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.01 0.01 0.001"/><site name="start"/>
    <body name="tip" pos="0 0 -0.4" euler="0 90 0"><joint name="rod"/>
      <inertial pos="{" ".join(map(str, COM))}" mass="{MASS}" diaginertia="1e-3 2e-3 1e-3"/>
      <site name="end" pos="0.01 0.02 0.03" euler="10 20 30"/></body></body>
  </worldbody>
  <actuator><general site="end" refsite="start" gear="1 0 0 0 0 0"/></actuator>
  <keyframe><key name="bent" qpos="0.2 0.1"/></keyframe></mujoco>"""
STATE = rb.State(jnp.array([0.3, 0.1, 0.2, -0.3]), jnp.array([0.1, 0.2, 0.3, 0.4]))
G = jnp.array([0.0, 0.0, -9.81])


@functools.cache
def arm() -> rb.Model:
    return round_beam({"k_y": 1, "k_z": 0}).replace_joint(rb.load(FILE), "rod")


@functools.cache
def truth():
    """Pose, velocity and acceleration of the site and of the tip's center of mass, from poses."""
    model, (q, v) = arm(), (STATE.q, STATE.v)
    a = rb.acceleration(model, STATE)

    @jax.jit
    def motion(q, v, a):
        def points(q):
            R, site = rb.frame_pose(model, q, site="end")
            return R, site, rb.frame_pose(model, q, "tip", point=jnp.array(COM))[1]

        speed = lambda q, v: jax.jvp(points, (q,), (v,))[1]  # noqa: E731
        return points(q), speed(q, v), jax.jvp(speed, (q, v), (v, a))[1]

    return motion(q, v, a)


def reading(sensor) -> np.ndarray:
    model = arm().replace(sensors=(sensors.NamedSensor("s", sensor),))
    return np.asarray(rb.sense(model, STATE, jnp.zeros(1)))


def test_inertial_and_force_sensors_at_a_tip() -> None:
    """By second derivatives of poses; the force at the tip accelerates the tip's body."""
    (R, _, _), (_, v, _), (_, a, c) = truth()
    for sensor, want in (
        (sensors.Accelerometer("end"), R.T @ (a - G)),
        (sensors.Velocimeter("end"), R.T @ v),
        (sensors.ForceSensor("end"), R.T @ (MASS * (c - G))),
    ):
        np.testing.assert_allclose(reading(sensor), want, atol=F64_TRANSFORM)


def test_sensors_of_a_subtree_include_its_beams() -> None:
    model, (q, v) = arm(), (STATE.q, STATE.v)
    mass = 0.5 + MASS + 1000 * np.pi * 0.01**2
    h = np.asarray(rb.centroidal_momentum(model, q, v))
    center = reading(sensors.SubtreeCenter("upper"))
    np.testing.assert_allclose(center, rb.center_of_mass(model, q), atol=F64_TRANSFORM)
    velocity = reading(sensors.SubtreeVelocity("upper"))
    np.testing.assert_allclose(mass * velocity, h[3:], atol=F64_TRANSFORM)
    spin = reading(sensors.SubtreeAngularMomentum("world"))
    np.testing.assert_allclose(spin, h[:3], atol=F64_TRANSFORM)


def test_an_actuator_between_sites_across_a_beam() -> None:
    """The moment arm is the gradient of the coordinate of one site in the axes of the other."""
    model, q = arm(), STATE.q

    def along(q):
        R, base = rb.frame_pose(model, q, site="start")
        return (R.T @ (rb.frame_pose(model, q, site="end")[1] - base))[0]

    bare = rb.applied_forces(model, STATE)
    got = rb.applied_forces(model, STATE, jnp.ones(1)) - bare
    np.testing.assert_allclose(got, jax.jit(jax.grad(along))(q), atol=F64_TRANSFORM)


def test_copies_of_a_model() -> None:
    """Pickled, with fixed zeros, other drivers, f32; a keyframe of the file."""
    model = arm()
    want = np.asarray(rb.acceleration(model, STATE))
    size = np.abs(want).max()
    copies = [pickle.loads(pickle.dumps(model)), model.fix_zeros()]
    copies += [model.replace(driver=name) for name in ("unrolled", "rolled", "limbs")]
    for copy in copies:
        np.testing.assert_allclose(rb.acceleration(copy, STATE), want, atol=1e-13 * size)
    single = rb.State(*(jnp.asarray(x, jnp.float32) for x in (STATE.q, STATE.v)))
    found = rb.acceleration(model.astype(jnp.float32), single)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, want, atol=1e-4 * size)


def test_keyframes_and_replaced_leaves() -> None:
    text = ARM.replace("</mujoco>", '<keyframe><key name="k" qpos="0.2"/></keyframe></mujoco>')
    model = rb.load(text).with_beam("rod", round_beam({"k_y": 1}), "upper")
    np.testing.assert_array_equal(model.keyframe("k").q, [0.2, 0.0, 0.0])
    softer = model.forces[-1].replace(stiffness=model.forces[-1].stiffness / 2)
    changed = model.replace(forces=(*model.forces[:-1], softer))
    q = jnp.array([0.1, 0.2, 0.3])
    energies = [float(rb.forces.elastic_energy(m, q)) for m in (model, changed)]
    np.testing.assert_allclose(energies[0], 2 * energies[1], rtol=1e-14)


@functools.cache
def swing():
    """A swing of 0.1 s by RK4 steps of 0.1 ms."""
    model = on_a_hinge({"k_y": 1}, E=1e9)
    start = model.default_state().replace(v=jnp.array([1.0, 0.5, 0.0]))
    path = rb.rollout(
        model, start, jnp.zeros((1000, 1)), 1e-4, integrator="rk4", save_every=1000
    )  # fmt: skip
    return model, start, np.asarray(path.q[-1])


@pytest.mark.parametrize(
    ("integrator", "error"),
    [
        ("semi_implicit_euler", 2e-2), ("euler_implicit_damping", 2e-2), ("implicitfast", 2e-2),
        ("implicit", 2e-2), ("discrete", 2e-2), ("variational_midpoint", 1e-3), ("rk4", 1e-6),
        ("tsit5", 1e-6), ("dopri8", 1e-6),
    ],
)  # fmt: skip
def test_integrators(integrator: str, error: float) -> None:
    """Steps of 1 ms; the bound is relative to the motion, by the order of the method."""
    model, start, want = swing()
    path = rb.rollout(
        model, start, jnp.zeros((100, 1)), 1e-3, integrator=integrator, save_every=100
    )  # fmt: skip
    assert np.abs(path.q[-1] - want).max() < error * np.abs(want).max()


@pytest.mark.parametrize(
    "solver", ["radau_iia2", "kvaerno3", "ros34pw2", "bdf2", "generalized_alpha", "rkmk4"]
)
def test_solvers(solver: str) -> None:
    """Implicit and stiff solvers of `simulate` with steps of 1 ms."""
    model, start, want = swing()
    path = rb.simulate(
        model, start, np.linspace(0.0, 0.1, 2), jnp.zeros(1),
        solver=rb.solvers.all()[solver].make(), dt=1e-3,
    )  # fmt: skip
    assert np.abs(path.q[-1] - want).max() < 1e-3 * np.abs(want).max()


def test_linearised_frequencies_of_a_cantilever() -> None:
    """The first frequencies of a uniform beam, 1.8751^2 and 4.6941^2 sqrt(EI / mu L^4)."""
    rod = rb.flexible.beam(1.0, [0.0, 0.0, 2.0, 0.0, 0.0, 0.0], {"k_z": 4}, mass=0.5)
    model = rb.load("<mujoco><option gravity='0 0 0'/></mujoco>").with_beam("rod", rod)
    A = np.asarray(rb.linearise(model, model.default_state()).A)
    found = np.sort(np.abs(np.linalg.eigvals(A).imag))[::2]
    want = np.array([1.87510406871196, 4.69409113297417]) ** 2 * np.sqrt(2.0 / 0.5)
    # the error of a curvature of degree 4 (5 coefficients)
    np.testing.assert_allclose(found[0], want[0], rtol=1e-7)
    np.testing.assert_allclose(found[1], want[1], rtol=1e-4)


def test_the_wrench_on_a_body_that_carries_a_beam() -> None:
    """The rate of momentum of the whole robot less its weight, about the hinge of the arm."""
    model, (q, v) = arm(), (STATE.q, STATE.v)
    a = rb.acceleration(model, STATE)

    @jax.jit
    def rates(q, v, a):
        h = lambda q, v: rb.centroidal_momentum(model, q, v)  # noqa: E731
        return jax.jvp(h, (q, v), (v, a))[1]

    rate, (R, p) = rates(q, v, a), rb.frame_pose(model, q, site="start")
    force = rate[3:] - (0.5 + MASS + 1000 * np.pi * 0.01**2) * G
    torque = rate[:3] + jnp.cross(rb.center_of_mass(model, q) - p, force)
    np.testing.assert_allclose(
        reading(sensors.ForceSensor("start")), R.T @ force, atol=F64_TRANSFORM
    )
    np.testing.assert_allclose(
        reading(sensors.TorqueSensor("start")), R.T @ torque, atol=F64_TRANSFORM
    )
