"""Robots with beams, for tests."""

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb

#: two links with a site and an actuator, to which beams are clamped
ARM = """
<mujoco><option gravity="0 0 -9.81"/><worldbody><body name="upper">
  <joint name="hip" axis="0 1 0" damping="0.1"/>
  <geom type="capsule" size="0.02 0.2" pos="0 0 -0.2" contype="0" conaffinity="0"/>
  <site name="elbow" pos="0 0 -0.4"/></body></worldbody>
  <actuator><motor name="m" joint="hip"/></actuator></mujoco>"""


def round_beam(degrees=None, *, E=1e8, radius=0.01, length=1.0, damping=0.01):
    """Return a beam of a round section: EI = 0.785 N m^2 and 0.314 kg/m by default."""
    section = rb.flexible.circle(radius, E=E, nu=0.3, density=1000.0)
    return rb.flexible.beam(length, section, degrees or {"k_y": 1, "k_z": 1}, damping=damping)


def with_mass(model: rb.Model, name: str, mass: float = 0.1) -> rb.Model:
    """Give a body a mass and an inertia."""
    i, bodies = model.body(name), model.bodies
    inertia = bodies.inertia.at[i].set(1e-3 * np.eye(3))
    return model.replace(bodies=bodies.replace(mass=bodies.mass.at[i].set(mass), inertia=inertia))


def on_a_hinge(degrees=None, **given) -> rb.Model:
    """Return a beam with a payload at its tip and a frame in its middle, on an arm."""
    down = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
    model = rb.load(ARM).with_beam(
        "rod", round_beam(degrees, **given), "upper", position=(0, 0, -0.4), orientation=down,
        frames={"middle": 0.5},
    )  # fmt: skip
    return with_mass(model, "rod")


def random_state(model: rb.Model, seed: int = 0) -> rb.State:
    """Return a state with strains that bend a beam visibly."""
    q = np.asarray(model.random_state(jax.random.key(seed)).q)
    v = np.random.default_rng(seed).normal(size=model.nv)
    return rb.State(jnp.asarray(q), jnp.asarray(v))
