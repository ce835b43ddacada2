"""The inertial regressor of trees with beams."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import ModelError
from tests.dynamics.test_modal_link import moving as with_modal_link

HUB = """<mujoco><option gravity="0.3 -0.5 -9.81"/><worldbody><body name="hub" pos="0.1 0 0.3">
  <joint name="first" axis="0.1 0.2 0.9" pos="0.02 0 0" armature="0.3"/>
  <inertial pos="0.05 0.01 0" mass="1.3" fullinertia="0.03 0.02 0.04 0.002 0.001 -0.003"/>
</body></worldbody></mujoco>"""


def tree() -> rb.Model:
    """A hub, a tapered eccentric beam, a hinge with a body, and a planar beam."""
    width = np.linspace(0.05, 0.02, 4)
    tapered = rb.flexible.rectangle(width, 0.03, E=1e7, nu=0.3, density=900.0)
    one = rb.flexible.beam(0.7, tapered, {"k_x": 0, "k_y": 1, "e_x": 0}, points=4)
    off = {"first_moment": (0.004, -0.003), "product": 2e-4}
    eccentric = rb.flexible.section([1.0, 2.0, 3.0, 0, 0, 0], 0.6, (7e-3, 3e-3, 4e-3), **off)
    other = rb.flexible.beam(0.4, eccentric, {"k_z": 1})
    model = rb.load(HUB).with_beam("one", one, "hub", orientation=(0.5, 0.5, -0.5, 0.5))
    model = model.with_link("elbow", rb.joints.kind("hinge"), "one", position=(0.1, 0.2, 0.0))
    b = model.body("elbow")
    bodies = model.bodies.replace(
        mass=model.bodies.mass.at[b].set(0.8), com=model.bodies.com.at[b].set([0.1, -0.2, 0.05])
    )
    return model.replace(bodies=bodies).with_beam("other", other, "elbow")


@pytest.mark.slow
def test_regressor_times_parameters_is_inverse_dynamics() -> None:
    model = tree()
    q, v, a = (0.5 * jax.random.normal(jax.random.key(k), (model.nv,)) for k in range(3))
    Y = rb.flexible.section_regressor(model, q, v, a)
    sigma = rb.flexible.section_parameters(model)
    pi = jnp.concatenate([rb.inertial_parameters(model), sigma])
    want = rb.inverse_dynamics(model, q, v, a) - model.joints.armature * a
    np.testing.assert_allclose(Y @ pi, want, rtol=1e-12, atol=1e-12)
    names = rb.flexible.section_names(model)
    assert len(names) == sigma.size == 4 * 4 + 7
    assert names[0] == "one.mass_per_length[0]" and names[-1] == "other.product_of_inertia[0]"
    assert float(sigma[-7]) == 0.6


def test_density_of_a_beam_from_measured_forces() -> None:
    """Mass per length and rotary inertia about z of a planar beam, by least squares."""
    rod = rb.flexible.beam(0.8, [0, 0, 6.0, 0, 0, 0], {"k_z": 2}, mass=0.5, inertia=(4e-3, 0, 4e-3))
    model = rb.load("<mujoco/>").with_beam("rod", rod)
    at = [jax.random.normal(jax.random.key(k), (8, model.nv)) for k in range(3)]
    Y = jax.vmap(lambda *x: rb.flexible.section_regressor(model, *x))(*at)[:, :, 10:]
    tau = jax.vmap(lambda *x: rb.inverse_dynamics(model, *x))(*at)
    found = np.linalg.lstsq(Y.reshape(-1, 4), tau.reshape(-1), rcond=1e-12)[0]
    np.testing.assert_allclose(found[[0, 3]], [0.5, 4e-3], rtol=1e-10)


def test_other_flexible_links_are_rejected() -> None:
    model, q, v, a = with_modal_link()
    with pytest.raises(ModelError, match="flexible and not a beam"):
        rb.flexible.section_regressor(model, q, v, a)
    with pytest.raises(ModelError, match="section_regressor for beams"):
        rb.inertial_regressor(model, q, v, a)
