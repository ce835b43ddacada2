"""The virtual power of inertial forces, and the reverse derivative of inverse dynamics from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.algorithms.rnea import wrenches_to_links
from rbjax.dynamics.algorithms.virtual_power import virtual_power
from rbjax.dynamics.drivers.choice import driver
from tests.dynamics.test_flexible_trees import moving

#: relative error of two orders of summation, at values of a few hundred
CLOSE = 1e-11


def curved_chain():
    """Four equal eccentric beams with natural curvature, which the driver by limbs loops over."""
    section = rb.flexible.rectangle(0.02, 0.01, E=1e7, nu=0.3, density=1e3)
    one = rb.flexible.beam(
        0.3, section, {"k_y": 1, "k_z": 1, "e_x": 0}, natural={"k_z": [0.4]}, points=3
    )
    model, parent = rb.load("<mujoco/>"), "world"
    for k in range(4):
        model, parent = model.with_beam(f"beam{k}", one, parent), f"beam{k}"
    keys = jax.random.split(jax.random.key(2), 4)
    q, v, a = (0.4 * jax.random.normal(k, (model.nv,)) for k in keys[:3])
    return model, q, v, a, jax.random.normal(keys[3], (model.nb, 6))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "by"), [("hinge 1", "limbs"), ("free 2", "unrolled"), ("chain", "limbs")]
)
def test_power_is_the_product_with_inverse_dynamics_and_its_gradient_the_reverse_derivative(
    name: str, by: str
) -> None:
    """l.ID, and l.(dID/dx dx) by forward differentiation of RNEA, along random l and dx."""
    model, *at = curved_chain() if name == "chain" else moving(name)
    model = model.replace(driver=by)
    rates = jax.random.normal(jax.random.key(7), (model.nv,))
    along = [jax.random.normal(jax.random.key(8 + i), x.shape) for i, x in enumerate(at)]

    def power(q, v, a, wrenches):
        d = driver(model, q.dtype)
        f_ext = wrenches_to_links(d, d.joints(q, None), wrenches)
        lanes = d.lanes(a), d.lanes(rates)
        return virtual_power(d, d.joints(q, v, a, rates), *lanes, d.prepared.gravity, f_ext)

    def forces(q, v, a, wrenches):
        return rb.inverse_dynamics(model, q, v, a, wrenches)

    @jax.jit
    def everything(at, along):
        tau, change = jax.jvp(forces, at, along)
        back = jax.vjp(forces, *at)[1](rates)
        each = [(x * dx).sum() for x, dx in zip(back, along, strict=True)]
        return power(*at), rates @ tau, sum(each), rates @ change

    found, want, slope, want_slope = everything(at, along)
    np.testing.assert_allclose(found, want, rtol=CLOSE)
    np.testing.assert_allclose(slope, want_slope, rtol=CLOSE)


@pytest.mark.slow
def test_the_reverse_derivative_needs_fewer_operations_than_three_evaluations() -> None:
    """Counted on a spatial beam of 8 coordinates with 7 Gauss points."""
    one = rb.flexible.beam(1.0, [0, 2.0, 2.0, 0, 0, 0], {"k_y": 3, "k_z": 3}, mass=0.5)
    model = rb.load("<mujoco/>").with_beam("rod", one)
    x = jnp.ones(model.nv)

    def forward(q, v, tau):
        return rb.forward_dynamics(model, q, v, tau)

    def back(q, v, tau, w):
        return jax.vjp(forward, q, v, tau)[1](w)

    count = rb.dynamics.tracing.operations.operation_count
    assert count(back, x, x, x, x).total < 3 * count(forward, x, x, x).total
