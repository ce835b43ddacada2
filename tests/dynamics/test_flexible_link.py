"""A flexible link in one file: the tip of a cantilever that bends in one assumed mode."""

from __future__ import annotations

import numpy as np

import rbjax as rb
from rbjax.lanes import Mat3, Vec3, sincos
from rbjax.spatial import Transform
from tests.tolerances import F64_ROUNDING

LENGTH, STIFFNESS, MASS, INERTIA, GRAVITY = 2.0, 30.0, 1.5, 0.2, 9.81
TIP = f"""
<mujoco>
  <option gravity="0 -{GRAVITY} 0"/>
  <worldbody>
    <body name="tip" pos="0 0 {LENGTH}">
      <joint name="bend" axis="0 0 1" stiffness="{STIFFNESS}"/>
      <inertial pos="0 0 0" mass="{MASS}" diaginertia="{INERTIA} 0.1 0.1"/>
    </body>
  </worldbody>
</mujoco>
"""


class Cantilever(rb.joints.Node):
    """Static deflection under a force at the tip: y = q at a slope of 3 q / (2 L)."""

    name, coordinates = "cantilever", 1
    params = {"length": 1.0}  # noqa: RUF012

    def pose(self, q, params):
        c, s = sincos(-1.5 * q[0] / params[0])
        R = Mat3(1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c)
        return Transform(R, Vec3(0.0, q[0], 0.0))


def test_a_cantilever_with_a_tip_mass() -> None:
    """The modal mass m + J (3 / 2 L)^2, the load m g and the stiffness, by hand."""
    rb.joints.register(Cantilever())
    model = rb.load(TIP).with_joint("bend", "cantilever", length=LENGTH)
    q, v = np.array([0.3]), np.array([0.7])
    modal_mass = MASS + INERTIA * (1.5 / LENGTH) ** 2
    load = -MASS * GRAVITY
    springs = rb.applied_forces(model, rb.State(q, v), np.zeros(0))
    np.testing.assert_allclose(rb.mass_matrix(model, q), [[modal_mass]], rtol=F64_ROUNDING)
    np.testing.assert_allclose(springs, -STIFFNESS * q, rtol=F64_ROUNDING)
    a = rb.forward_dynamics(model, q, v, springs)
    np.testing.assert_allclose(a, (load + springs) / modal_mass, rtol=1e-12)
