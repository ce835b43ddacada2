"""The two systems of the scenes, as models and as equations written by hand.

    arm   two links on two hinges, with springs, dampers and position servos: a `Model`
    body  a rigid body about a fixed point in gravity: `rb.solvers.RigidBody`, or the same equations
          for a quaternion and an angular velocity, for solvers without groups
Arms and bodies differ only in their numbers, so one compiled program of a solver runs them all.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.loading import load
from rbjax.model import Model
from rbjax.rotations import quaternion
from rbjax.solvers import RigidBody

GRAVITY = 9.81

_ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="upper">
      <inertial pos="0 0 -0.5" mass="1" diaginertia="0.1 0.1 0.1"/>
      <joint name="shoulder" type="hinge" axis="0 -1 0"/>
      <body name="lower" pos="0 0 -1">
        <inertial pos="0 0 -0.5" mass="1" diaginertia="0.1 0.1 0.1"/>
        <joint name="elbow" type="hinge" axis="0 -1 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="1" kv="1"/>
    <position name="elbow" joint="elbow" kp="1" kv="1"/>
  </actuator>
</mujoco>
"""


@dataclass(frozen=True)
class Arm:
    """Two links of 1 m, hanging along -z at q = 0.

    mass, kg; com, m from the hinge; inertia about the com, kg m^2 (a rod's if None); stiffness and
    damping of the joints, kp and kv of servos with target 0. gimbal: the first link is only a
    vertical axis, and the second a point on a massless rod.
    """

    mass: tuple[float, float] = (1.0, 1.0)
    com: tuple[float, float] = (0.5, 0.5)
    inertia: tuple[float, float] | None = None
    stiffness: tuple[float, float] = (0.0, 0.0)
    damping: tuple[float, float] = (0.0, 0.0)
    kp: tuple[float, float] = (0.0, 0.0)
    kv: tuple[float, float] = (0.0, 0.0)
    gimbal: bool = False

    @property
    def about_com(self) -> np.ndarray:
        rods = np.array(self.mass) / 12
        return rods if self.inertia is None else np.array(self.inertia)

    def model(self) -> Model:
        """The robot. Arms differ only in their numbers."""
        base = _base()
        about = np.zeros((2, 3, 3))
        about[:, 0, 0] = about[:, 1, 1] = self.about_com
        along = np.array([[0.0, -1.0, 0.0], [0.0, -1.0, 0.0]])
        if self.gimbal:
            along[0] = [0.0, 0.0, 1.0]
        down = np.array([[0.0, 0.0, -1.0]])
        bodies = base.bodies.replace(
            mass=np.array(self.mass),
            com=np.array(self.com)[:, None] * down,
            inertia=about,
            position=np.array([[0.0], [0.0 if self.gimbal else 1.0]]) * down,
        )
        stiffness, damping = np.array(self.stiffness), np.array(self.damping)
        joints = base.joints.replace(axis=along, stiffness=stiffness, damping=damping)
        kp, kv, none = np.array(self.kp), np.array(self.kv), np.zeros(2)
        actuators = base.actuators.replace(
            gain=np.stack([kp, none, none], 1), bias=np.stack([none, -kp, -kv], 1)
        )
        return base.replace(bodies=bodies, joints=joints, actuators=actuators)

    def coefficients(self) -> np.ndarray:
        """a, b, c of the mass matrix [[a, c cos], [c cos, b]]; weights; springs; dampers."""
        (m1, m2), (c1, c2), (i1, i2) = self.mass, self.com, self.about_com
        spring = np.array(self.stiffness) + self.kp
        damper = np.array(self.damping) + self.kv
        a, b, c = i1 + m1 * c1**2 + m2, i2 + m2 * c2**2, m2 * c2
        return np.array([a, b, c, (m1 * c1 + m2) * GRAVITY, c * GRAVITY, *spring, *damper])

    def energy(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Energy in J, of series (T, 2)."""
        a, b, c, g1, g2, k1, k2, *_ = self.coefficients()
        (q1, q2), (v1, v2) = q.T, v.T
        elastic = (k1 * q1**2 + k2 * q2**2) / 2
        if self.gimbal:
            return b * (v2**2 + (np.sin(q2) * v1) ** 2) / 2 - g2 * np.cos(q2) + elastic
        w = v1 + v2
        kinetic = a * v1**2 / 2 + b * w**2 / 2 + c * np.cos(q2) * v1 * w
        return kinetic - g1 * np.cos(q1) - g2 * np.cos(q1 + q2) + elastic


@cache
def _base() -> Model:
    return load(_ARM)


def planar(t: Any, y: Any, numbers: jax.Array) -> Any:
    """Lagrange's equations of the arm in absolute angles, y = (angles (2,), rates (2,))."""
    (t1, t2), (w1, w2) = y
    a, b, c, g1, g2, k1, k2, d1, d2 = numbers
    first = -k1 * t1 - d1 * w1
    second = -k2 * (t2 - t1) - d2 * (w2 - w1)
    sine, cosine = c * jnp.sin(t1 - t2), c * jnp.cos(t1 - t2)
    f1 = first - second - sine * w2**2 - g1 * jnp.sin(t1)
    f2 = second + sine * w1**2 - g2 * jnp.sin(t2)
    determinant = a * b - cosine**2
    return y[1], jnp.stack([b * f1 - cosine * f2, a * f2 - cosine * f1]) / determinant


def spherical(t: Any, y: Any, numbers: Any) -> Any:
    """A point on a rod of 1 m, y = (position (3,), velocity (3,))."""
    r, v = y
    down = jnp.array([0.0, 0.0, -GRAVITY])
    return v, down - ((v * v).sum() + (down * r).sum()) * r


@dataclass(frozen=True)
class Body:
    """A body about a fixed point: principal moments (3,), kg m^2, and the moment of its weight,
    N m, for a centre of mass on its third axis."""

    inertia: tuple[float, float, float]
    weight: float = 0.0

    def term(self, dtype: Any = float) -> RigidBody:
        """The term for solvers on groups; args is the weight."""
        return RigidBody(np.array(self.inertia, dtype), _tipping)

    def energy(self, turn: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Energy in J, of series (T, 4) and (T, 3)."""
        unit = unit_rows(turn)
        height = 1 - 2 * (unit[:, 1] ** 2 + unit[:, 2] ** 2)
        return (np.array(self.inertia) * w**2).sum(1) / 2 + self.weight * height


def _tipping(t: Any, turn: jax.Array, weight: Any) -> jax.Array:
    w, x, y, z = turn
    up = jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x)])  # the vertical in body axes
    return weight / (turn * turn).sum() * jnp.stack([up[1], -up[0], jnp.zeros_like(w)])


def tumbling(t: Any, y: Any, numbers: Any) -> Any:
    """Euler's equations and the quaternion's rate, y = (turn (4,), w (3,))."""
    inertia, weight = numbers
    turn, w = y
    rate = quaternion.multiply(turn, jnp.concatenate([jnp.zeros(1, w.dtype), w])) / 2
    moment = jnp.cross(inertia * w, w) + _tipping(t, turn, weight)
    return rate, moment / inertia


def bob(q: np.ndarray) -> np.ndarray:
    """The position (T, 3) of the bob."""
    q1, q2 = q.T
    return np.stack([np.sin(q2) * np.cos(q1), np.sin(q2) * np.sin(q1), -np.cos(q2)], 1)


def unit_rows(q: np.ndarray) -> np.ndarray:
    """The rows scaled to length 1, from any nonzero length, however large."""
    q = q / np.abs(q).max(1, keepdims=True)
    return q / np.linalg.norm(q, axis=1, keepdims=True)
