"""Widths over which a step is smooth are above zero, and vectors of the wrong length are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import InputError
from rbjax.lanes import Mat3, Sym3, Vec3

F = rb.forces
MODEL = rb.load("double_pendulum")
JOINTS = MODEL.joint_names
ONE = jnp.ones(2)
ELEMENTS = {
    "JointFriction.smoothing": lambda x: F.JointFriction.of(MODEL, JOINTS, 1.0, smoothing=x),
    "JointFriction.stribeck": lambda x: F.JointFriction.of(MODEL, JOINTS, 1.0, stribeck=x),
    "GearLoss.smoothing": lambda x: F.GearLoss.of(MODEL, JOINTS, 0.1, smoothing=x),
    "JointCurves.smoothing": lambda x: F.JointCurves.of(
        MODEL, JOINTS, [-1.0, 1.0], coulomb=1.0, smoothing=x),
    "JointCurves.stribeck": lambda x: F.JointCurves.of(
        MODEL, JOINTS, [-1.0, 1.0], coulomb=1.0, stribeck=x),
    "JointLimits.width": lambda x: F.JointLimits(ONE, ONE, 0 * ONE, x * ONE, JOINTS),
}  # fmt: skip


@pytest.mark.parametrize("name", ELEMENTS)
def test_a_width_is_above_zero(name):
    element, field = name.split(".")
    for x in (0.0, -1e-3):
        with pytest.raises(InputError, match=rf"{element}\({field}=...\): got .* above zero"):
            ELEMENTS[name](x)
    made = ELEMENTS[name](1e-3)
    with pytest.raises(InputError, match="above zero"):
        made.replace(**{field: 0 * ONE})
    ranged = MODEL.replace(joints=MODEL.joints.replace(range=[[0.0, 1.0], [-1.0, 1.0]]))
    still = ranged.with_forces(made).default_state()
    slope = jax.jacobian(lambda v: rb.applied_forces(ranged.with_forces(made), still.replace(v=v)))
    assert np.isfinite(slope(still.v)).all()


def test_traced_widths_are_not_looked_at():
    def force(x):
        model = MODEL.with_forces(F.JointFriction.of(MODEL, JOINTS, 1.0, smoothing=x))
        return rb.applied_forces(model, MODEL.default_state().replace(v=ONE)).sum()

    assert np.isfinite(jax.grad(force)(0.5))


@pytest.mark.parametrize("kind", [Vec3, Mat3, Sym3])
def test_sums_of_lanes_have_equal_lengths(kind):
    n = {Vec3: 3, Mat3: 9, Sym3: 6}[kind]
    v = kind(*map(float, range(n)))
    assert [float(x) for x in v + jnp.ones(n)] == [k + 1.0 for k in range(n)]
    for wrong in (jnp.ones(n - 1), jnp.ones(n + 1)):
        for call in (lambda w=wrong: v + w, lambda w=wrong: v - w, lambda w=wrong: w + v):
            with pytest.raises((ValueError, TypeError)):
                call()


def test_a_product_of_two_vectors_is_not_a_scaled_one():
    v = Vec3(1.0, 2.0, 3.0)
    with pytest.raises(TypeError, match="use dot or cross"):
        v * jnp.ones(3)
    assert [x.shape for x in Vec3(*jnp.ones((3, 3))) * jnp.ones(3)] == [(3,)] * 3  # a batch of 3

    class Wrong(F.Element):
        gains: jax.Array

        def loads(self, context):
            body = context.body("lower")
            return body.push(body.velocity * self.gains)

    def push(gains):
        model = MODEL.with_forces(Wrong(gains))
        return rb.applied_forces(model, MODEL.default_state().replace(v=ONE))

    with pytest.raises((InputError, TypeError), match="dot"):
        push(jnp.ones(3))
    with pytest.raises((InputError, TypeError), match="dot"):
        jax.jit(push)(jnp.ones(3))
