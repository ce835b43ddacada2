"""Inertia boxes in a fluid: against MuJoCo C, finite differences, power, thin plates."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.forces.immersed import (
    calm,
    drivers_agree,
    error,
    fluid,
    gradients_agree,
    run,
)
from tests.oracles.media import fluid_forces, immersed_tree, states
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, F64_TRANSFORM, relative_error

QUICK, ALL = range(3), range(20)
DRIVERS = ["unrolled", "rolled", "limbs"]


@pytest.mark.parametrize("seed", QUICK)
def test_mujoco(seed):
    assert error(immersed_tree(seed, ellipsoids=0), 100, "unrolled") < F64_PARITY


@pytest.mark.slow
@pytest.mark.parametrize("driver", DRIVERS)
def test_mujoco_on_many_models(driver):
    for seed in ALL:
        assert error(immersed_tree(seed, ellipsoids=0), 100, driver) < F64_PARITY


def in_air(name: str = "quadruped", **medium) -> rb.Model:
    model = rb.load(name)
    return calm(model).with_forces(rb.forces.InertiaBoxFluid.of(model, **medium))


def test_drivers():
    model = in_air(density=1.2, viscosity=0.1, wind=(3.0, -2.0, 1.0))
    drivers_agree(model)


@pytest.mark.parametrize(
    ("driver", "bodies"),
    [
        pytest.param("rolled", 1, marks=pytest.mark.slow),
        pytest.param("unrolled", 2, marks=pytest.mark.slow),
        pytest.param("rolled", 3, marks=pytest.mark.slow),
    ],
)
def test_gradients(driver, bodies):
    m = immersed_tree(1, ellipsoids=0, bodies=bodies)
    model = calm(rb.load(m)).replace(driver=driver)
    q, v = states(m, 1)
    gradients_agree(model, q[0], v[0], 1e-7)


def test_axes_found_here_are_those_of_the_file():
    m = immersed_tree(2, ellipsoids=0)
    model = calm(rb.load(m))
    (read,) = model.forces
    medium = {"density": m.opt.density, "viscosity": m.opt.viscosity, "wind": m.opt.wind}
    made = rb.forces.InertiaBoxFluid.of(model, **medium)
    assert made.bodies == read.bodies
    q, v = states(m, 1)
    found = run(lambda q, v: fluid(model.replace(forces=(made,)), q, v), q[0], v[0])
    assert relative_error(found, fluid_forces(m, q, v)[0]) < F64_PARITY


def test_still_fluid_takes_energy():
    model = in_air(density=50.0, viscosity=0.3)
    states = jax.vmap(model.random_state)(jax.random.split(jax.random.key(1), 50))
    assert (run(jax.vmap(lambda s: fluid(model, s.q, s.v) @ s.v), states) < 0).all()


def test_heavier_bodies_have_smaller_boxes():
    """d of a box is sqrt(6 I / m) wide: its derivative by the mass is -d / (2 m)."""
    ball = '<mujoco><worldbody><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'
    model = rb.load(ball)
    model = model.with_forces(rb.forces.InertiaBoxFluid.of(model, viscosity=1.0))

    def drag(mass):
        some = model.replace(bodies=model.bodies.replace(mass=mass))
        return fluid(some, model.default_state().q, jnp.array([1.0, 0, 0, 0, 0, 0]))[0]

    mass = model.bodies.mass
    width = jnp.sqrt(6 * model.bodies.inertia[0, 0, 0] / mass[0])
    value, slope = run(jax.value_and_grad(drag), mass)
    assert relative_error(value, -3 * jnp.pi * width) < F64_TRANSFORM
    assert relative_error(slope[0], 3 * jnp.pi * width / (2 * mass[0])) < F64_TRANSFORM


@pytest.mark.parametrize("driver", ["unrolled", "rolled"])
def test_a_plate_without_thickness(driver):
    plate = """<mujoco><option density="900" viscosity="0.3" wind="1 2 3"/><worldbody><body>
      <freejoint/><inertial pos="0.1 0 0" quat="0.3 0.5 -0.2 0.7" mass="20"
      diaginertia="11 23 34"/></body></worldbody></mujoco>"""
    assert error(mujoco.MjModel.from_xml_string(plate), 10, driver) < F64_PARITY


def test_no_medium_no_element():
    for name in rb.scenes():
        assert rb.load(name).forces == ()
    off = '<option density="1"><flag spring="disable" damper="disable"/></option>'
    body = '<body><freejoint/><geom size="1"/></body>'
    text = f"<mujoco>{off}<worldbody>{body}</worldbody></mujoco>"
    assert rb.load(text).forces == ()  # nothing passive acts there
    assert len(rb.load(text.replace(' damper="disable"', "")).forces) == 1


def test_welded_bodies_and_the_world():
    """A body that is fixed to another has a box of its own; one fixed to the world has none."""
    text = """<mujoco><option density="100" viscosity="1"/><worldbody>
      <body pos="0 0 9"><geom size="0.1"/></body>
      <body><joint axis="0 1 0"/><geom type="capsule" size="0.1 0.2"/>
      <body pos="0.3 0.1 0" euler="10 20 30"><geom type="box" size="0.1 0.2 0.3"/></body></body>
      </worldbody></mujoco>"""
    m = mujoco.MjModel.from_xml_string(text)
    model = load_quietly(m)
    assert model.forces[0].bodies == (1, 2)
    everywhere = rb.forces.InertiaBoxFluid.of(model, density=100, bodies=model.body_names[1:])
    assert everywhere.bodies == (1, 2)
    assert error(m, 10, "unrolled") < F64_PARITY and error(m, 10, "rolled") < F64_PARITY
    assert np.isfinite(error(m, 1, "limbs"))
