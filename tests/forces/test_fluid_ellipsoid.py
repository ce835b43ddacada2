"""Ellipsoids in a fluid: against MuJoCo C, finite differences, power, a ball that sinks."""

import equinox as eqx
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
from tests.oracles.media import immersed_tree, states
from tests.tolerances import F64_PARITY, F64_TRANSFORM, relative_error

QUICK, ALL = range(3), range(20)
SWIMMER = """
<mujoco><option density="1000" viscosity="0.1" wind="0.1 -0.2 0.3"/>
<default><geom type="capsule" contype="0" conaffinity="0" fluidshape="ellipsoid"/></default>
<worldbody><body><freejoint/><geom type="ellipsoid" size="0.2 0.1 0.05" pos="0.01 0 0"/>
  <body pos="0.2 0.1 0"><joint axis="0 0 1"/><geom size="0.02" fromto="0 0 0 0.1 0.1 0"/>
    <body pos="0.1 0.1 0"><joint axis="0 1 0"/><geom size="0.02" fromto="0 0 0 0.1 0 0.1"/></body>
  </body>
  <body pos="0.2 -0.1 0"><joint axis="0 0 1"/><geom size="0.02" fromto="0 0 0 0.1 -0.1 0"/>
    <body pos="0.1 -0.1 0"><joint axis="0 1 0"/><geom size="0.02" fromto="0 0 0 0.1 0 0.1"/></body>
  </body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("seed", QUICK)
def test_mujoco(seed):
    """Bodies of both models, where the seed has them."""
    m = immersed_tree(seed, ellipsoids=0.7)
    assert m.geom_fluid[:, 0].any()
    assert error(m, 100, "unrolled") < F64_PARITY


@pytest.mark.slow
@pytest.mark.parametrize("driver", ["unrolled", "rolled", "limbs"])
def test_mujoco_on_many_models(driver):
    for seed in ALL:
        assert error(immersed_tree(seed, ellipsoids=0.7), 100, driver) < F64_PARITY


def test_limbs_and_small_things():
    """A swimmer with limbs, and the same as small as an insect."""
    m = mujoco.MjModel.from_xml_string(SWIMMER)
    assert error(m, 20, "limbs") < F64_PARITY and error(m, 20, "rolled") < F64_PARITY
    m.geom_size *= 0.02
    m.geom_fluid[:, 6:9] *= 0.02**3
    m.geom_fluid[:, 9:12] *= 0.02**5
    m.opt.viscosity = 1e-6
    assert error(m, 20, "unrolled") < F64_PARITY


def test_drivers():
    drivers_agree(calm(rb.load(SWIMMER)))


@pytest.mark.parametrize(
    ("driver", "bodies"),
    [
        ("rolled", 1),
        pytest.param("unrolled", 2, marks=pytest.mark.slow),
        pytest.param("rolled", 3, marks=pytest.mark.slow),
    ],
)
def test_gradients(driver, bodies):
    m = immersed_tree(1, ellipsoids=1, bodies=bodies)
    model = calm(rb.load(m)).replace(driver=driver)
    *others, fluid = model.forces
    axes = fluid.semi_axes * jnp.array([1.0, 1.1, 1.3])  # two that are alike have a kink
    model = model.replace(forces=(*others, fluid.replace(semi_axes=axes)))
    q, v = states(m, 1)
    gradients_agree(model, q[0], v[0], 1e-6)


def test_a_still_fluid_drags_and_turns():
    """Drag takes energy, lift does no work, and added mass gives back what it takes."""
    model = calm(rb.load(SWIMMER.replace('wind="0.1 -0.2 0.3"', "")))
    drawn = jax.vmap(model.random_state)(jax.random.split(jax.random.key(1), 50))

    (every,) = model.forces
    drags = ("viscosity", "blunt_drag", "slender_drag", "angular_drag")
    names = (*drags, "kutta_lift", "magnus_lift", "virtual_mass", "virtual_inertia")
    only = [every.replace(**{n: 0.0 * getattr(every, n) for n in names if n != k}) for k in names]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *only)

    def power(element, state):
        return fluid(model.replace(forces=(element,)), state.q, state.v) @ state.v

    found = run(jax.vmap(jax.vmap(power, (None, 0)), (0, None)), stacked, drawn)
    assert (found[:4] <= 0).all() and (found[:4] < 0).any(1).all()
    assert abs(found[4:]).max() < F64_TRANSFORM * abs(found[:4]).max()


@pytest.mark.parametrize("density", [0.0, 1000.0])
def test_a_ball_sinks_with_its_terminal_velocity(density):
    """m g = 6 pi mu r v + rho c pi r^2 v^2."""
    r, mu, mass, c = 0.05, 30.0, 3.0, 0.4
    text = f"""<mujoco><option density="{density}" viscosity="{mu}"/><worldbody><body><freejoint/>
      <geom size="{r}" mass="{mass}" fluidshape="ellipsoid" fluidcoef="{c} 0 1 1 1"/></body>
      </worldbody></mujoco>"""
    model = rb.load(text)
    end = rb.rollout(model, model.default_state(), steps=4000, dt=1e-3, save_every=4000).v[-1]
    linear, square = 6 * np.pi * mu * r, density * c * np.pi * r**2
    weight = mass * 9.81
    root = np.sqrt(linear**2 + 4 * square * weight)
    assert relative_error(end, [0, 0, -2 * weight / (linear + root), 0, 0, 0]) < 1e-9


def test_coefficients_of_no_fluid():
    """Density and viscosity of zero: no force, and derivatives by them that are those above."""
    model = calm(rb.load(SWIMMER))
    state = model.random_state(jax.random.key(2))

    def forces(density, viscosity):
        (fluid,) = model.forces
        fluid = fluid.replace(density=density, viscosity=viscosity)
        return rb.applied_forces(model.replace(forces=(fluid,)), state)

    none, one = jnp.zeros(()), jnp.ones(())
    by_density, by_viscosity = run(jax.jacfwd(forces, (0, 1)), none, none)
    pairs = jnp.array([(none, none), (one, none), (none, one)])
    nothing, dense, viscous = run(jax.vmap(lambda x: forces(*x)), pairs)
    assert abs(nothing).max() == 0
    assert relative_error(by_density, dense) < F64_TRANSFORM
    assert relative_error(by_viscosity, viscous) < F64_TRANSFORM


def test_ellipsoids_alone_where_a_body_has_one():
    """MuJoCo's rule: a body with any ellipsoid has no box, and its other geoms feel nothing."""
    m = immersed_tree(4, ellipsoids=0.5, bodies=6)
    model = rb.load(m)
    kinds = {type(e).__name__: set(e.bodies) for e in model.forces}
    assert set(kinds) == {"InertiaBoxFluid", "EllipsoidFluid"}
    assert not kinds["InertiaBoxFluid"] & kinds["EllipsoidFluid"]
    assert all(eqx.is_array(x) for e in model.forces for x in jax.tree.leaves(e))
