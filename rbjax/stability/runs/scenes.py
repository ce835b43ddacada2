"""Scenes built to break solvers, with two kinds of systems and the true motion of each scene.

    arm   two links on two hinges, with springs, dampers and position servos: a `Model`
    body  a rigid body about a fixed point in gravity: `rb.solvers.RigidBody`, or the same equations
          for a quaternion and an angular velocity, for solvers without groups
One compiled program of a solver runs all arms, and one all bodies.

The reference for an arm are Lagrange's equations in absolute angles, written by hand. Near gimbal
lock it is the pendulum in Cartesian coordinates, which have no gimbal lock. The reference for a
body uses a quaternion. The difference of two small steps of Dormand-Prince 8 bounds the error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.display import displayed
from rbjax.loading import load
from rbjax.model import Model, State
from rbjax.rotations import quaternion
from rbjax.solvers import RigidBody
from rbjax.stability.runs.drift import long_run

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
    """An arm of two links of 1 m that hang along -z at q = 0.

    Fields:
        mass, com: kg, and distance of the centre of mass from the hinge, m.
        inertia: about the centre of mass, kg m^2; None for a rod.
        stiffness, damping: of the joints.
        kp, kv: gains of servos with target 0.
        gimbal: the first link is only a vertical axis, the second a point on a massless rod.
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
        """Return the robot. The models of all arms differ only in their parameters."""
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
        """Return a, b, c of the mass matrix [[a, c cos], [c cos, b]]; weights; springs; dampers."""
        (m1, m2), (c1, c2), (i1, i2) = self.mass, self.com, self.about_com
        spring = np.array(self.stiffness) + self.kp
        damper = np.array(self.damping) + self.kv
        a, b, c = i1 + m1 * c1**2 + m2, i2 + m2 * c2**2, m2 * c2
        return np.array([a, b, c, (m1 * c1 + m2) * GRAVITY, c * GRAVITY, *spring, *damper])

    def energy(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the energy (T,), J, of series q, v (T, 2)."""
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
    """Return the rates of an arm by Lagrange's equations, y = (absolute angles (2,), rates)."""
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
    """Return the rates of a point on a rod of 1 m, y = (position (3,), velocity (3,))."""
    r, v = y
    down = jnp.array([0.0, 0.0, -GRAVITY])
    return v, down - ((v * v).sum() + (down * r).sum()) * r


@dataclass(frozen=True)
class Top:
    """A rigid body about a fixed point, with its centre of mass on its third axis.

    Fields:
        inertia: (3,) principal moments, kg m^2.
        weight: weight times distance from the fixed point, N m.
    """

    inertia: tuple[float, float, float]
    weight: float = 0.0

    def term(self, dtype: Any = float) -> RigidBody:
        """Return the term for solvers on groups. The weight is its `args`."""
        return RigidBody(np.array(self.inertia, dtype), _tipping)

    def energy(self, turn: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the energy (T,), J, of quaternions (T, 4) and angular velocities (T, 3)."""
        unit = unit_rows(turn)
        height = 1 - 2 * (unit[:, 1] ** 2 + unit[:, 2] ** 2)
        return (np.array(self.inertia) * w**2).sum(1) / 2 + self.weight * height


def _tipping(t: Any, turn: jax.Array, weight: Any) -> jax.Array:
    w, x, y, z = turn
    up = jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x)])  # vertical in body axes: x, y
    return weight / (turn * turn).sum() * jnp.stack([up[1], -up[0], jnp.zeros_like(w)])


def tumbling(t: Any, y: Any, numbers: Any) -> Any:
    """Return the rates of a body by Euler's equations, y = (quaternion (4,), w (3,))."""
    inertia, weight = numbers
    turn, w = y
    rate = quaternion.multiply(turn, jnp.concatenate([jnp.zeros(1, w.dtype), w])) / 2
    moment = jnp.cross(inertia * w, w) + _tipping(t, turn, weight)
    return rate, moment / inertia


def bob(q: np.ndarray) -> np.ndarray:
    """Return the positions (T, 3), m, of the pendulum bob."""
    q1, q2 = q.T
    return np.stack([np.sin(q2) * np.cos(q1), np.sin(q2) * np.sin(q1), -np.cos(q2)], 1)


def unit_rows(q: np.ndarray) -> np.ndarray:
    """Scale the rows to length 1, from any nonzero length, however large."""
    q = q / np.abs(q).max(1, keepdims=True)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


# -------------------------------------------------------------------- scenes

SAMPLES = 200


@dataclass(frozen=True)
class Scene:
    """A system, its initial state, and 200 samples of `every` equal steps each.

    Fields:
        title, system: description, and `Arm` or `Top`.
        start: (q, v) of an arm, or (quaternion, w) of a body.
        dt, every: step, s, and number of steps between samples.
        refine: number of steps of the reference in one dt.
        scale, speed: energy unit, J (0: energy is not conserved), and typical speed, rad/s.
        adaptive: whether a controller chooses the steps (tolerance 1e-6, at most 10,000 steps).
        single: whether f32 is compared with the same steps in f64.
    """

    title: str
    system: Arm | Top
    start: tuple[tuple[float, ...], tuple[float, ...]]
    dt: float = 1e-3
    every: int = 5
    refine: int = 16
    scale: float = 0.0
    adaptive: bool = False
    single: bool = False
    speed: float = 10.0

    @property
    def ts(self) -> np.ndarray:
        """Times of the samples (201,), s."""
        return self.dt * self.every * np.arange(SAMPLES + 1)

    @property
    def state(self) -> Any:
        first, second = (jnp.array(x) for x in self.start)
        return State(first, second) if isinstance(self.system, Arm) else (first, second)


@displayed
class Truth(NamedTuple):
    """True motion of a scene: observed (201, n), and the bound of its error."""

    observed: np.ndarray
    error: float


def truth(scene: Scene) -> Truth:
    """Compute the true motion of a scene, and the bound max_k |r_k(h) - r_k(h / 2)| of its error.

    The reference r is by Dormand-Prince 8 at h = dt / refine.

    Args:
        scene: one of `rb.stability.scenes()`, or a user-defined one.

    Returns:
        `Truth`: error, and observed: (201, 2) joint angles, rad; (201, 3) positions of the bob near
        gimbal lock, m; or (201, 4) quaternions.

    Source: Hairer, Norsett & Wanner, *Solving ODEs I*, II.10.

    Example:
        >>> import rbjax as rb
        >>> rb.stability.truth(rb.stability.scenes()["spring_1e2"]).error < 1e-11
        True
    """
    coarse, fine = (_reference(scene, k * scene.refine) for k in (1, 2))
    return Truth(fine, float(np.abs(fine - coarse).max()))


def _reference(scene: Scene, refine: int) -> np.ndarray:
    first, second = (np.array(x) for x in scene.start)
    system, equations = scene.system, planar
    args: Any = None
    if isinstance(system, Top):
        equations, args = tumbling, (np.array(system.inertia), np.asarray(system.weight))
    elif system.gimbal:
        equations = spherical
        (q1, q2), (v1, v2) = first, second
        first = bob(first[None])[0]
        c, s = np.cos(q1), np.sin(q1)
        second = np.array([v2 * np.cos(q2) * c - v1 * np.sin(q2) * s,
                           v2 * np.cos(q2) * s + v1 * np.sin(q2) * c, v2 * np.sin(q2)])  # fmt: skip
    else:
        args, first, second = system.coefficients(), first.cumsum(), second.cumsum()
    run = long_run(
        diffrax.ODETerm(equations), diffrax.Dopri8(), (first, second), scene.dt / refine, kept,
        every=scene.every * refine, samples=SAMPLES, args=args,
    )  # fmt: skip
    q, _ = (np.asarray(x) for x in run.kept)
    if isinstance(system, Arm) and not system.gimbal:
        q = np.diff(q, axis=1, prepend=0.0)
    return q


def kept(t: Any, y: Any, args: Any) -> Any:
    """Return the state unchanged."""
    return y


def deviation(scene: Scene, q: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Return the error (T, n) of configurations q (T, nq): angles in rad, or the bob in m."""
    if isinstance(scene.system, Top):
        unit, real = unit_rows(q), unit_rows(observed)
        gap = np.minimum(np.linalg.norm(unit - real, axis=1), np.linalg.norm(unit + real, axis=1))
        return 4 * np.arcsin(np.minimum(gap / 2, 1.0))[:, None]
    return (bob(q) if scene.system.gimbal else q) - observed


_ROD = Arm()
_SPRING = ((0.0, 1.0), (0.0, 0.0))


@cache
def scenes() -> dict[str, Scene]:
    """Return the scenes by name, in a fixed order.

    Example:
        >>> import rbjax as rb
        >>> rb.stability.scenes()["spring_1e9"].title
        'joint spring of 1e9 N m/rad'
    """
    out = {
        f"spring_1e{k}": Scene(
            f"joint spring of 1e{k} N m/rad",
            Arm(stiffness=(10.0**k, 0.0)),
            _SPRING,
            refine=refine,
            scale=GRAVITY,
        )
        for k, refine in ((2, 4), (4, 16), (6, 64), (9, 256))
    }
    out["servo"] = Scene(
        "servo gains far above the step's limit", Arm(kp=(1e5, 1e5), kv=(1e3, 1e3)),
        ((0.5, -0.5), (0.0, 0.0)), refine=64,
    )  # fmt: skip
    out["damping"] = Scene(
        "joint damping of 1e3 N m s/rad", Arm(damping=(1e3, 1e3)), ((1.0, 0.5), (0.0, 0.0)),
        refine=64,
    )  # fmt: skip
    out["tiny_body"] = Scene(
        "1e-6 kg, damped, on an arm of 10 kg",
        Arm(mass=(10.0, 1e-6), damping=(0.0, 1e-2)),
        ((1.0, 0.5), (0.0, 0.0)),
        refine=128,
    )
    out["mass_ratio"] = Scene(
        "1 kg at the end of a link of 1e-6 kg",
        Arm(mass=(1e-6, 1.0), com=(0.5, 1.0), inertia=(1e-6 / 12, 0.0)),
        ((0.5, 0.0), (0.0, 0.0)),
        refine=256,
        scale=GRAVITY,
    )
    gimbal = Arm(mass=(0.0, 1.0), com=(0.0, 1.0), inertia=(0.0, 0.0), gimbal=True)
    past = ((0.0, 1.0), (0.1, 0.0))
    out["gimbal"] = Scene(
        "1.3 deg past gimbal lock", gimbal, past, every=10, refine=8, scale=GRAVITY
    )
    out["fast_top"] = Scene(
        "top at 1,000 rad/s, 1 rad a step",
        Top((0.0215, 0.0215, 0.0012), 0.981),
        ((np.cos(0.15), np.sin(0.15), 0.0, 0.0), (0.0, 0.0, 1000.0)),
        refine=32,
        scale=0.981,
        speed=1000.0,
    )
    out["dzhanibekov"] = Scene(
        "Dzhanibekov's flips over 1,000 s",
        Top((1.0, 2.0, 3.5)),
        ((1.0, 0.0, 0.0, 0.0), (0.01, 1.0, 0.01)),
        dt=0.02,
        every=250,
        refine=4,
        scale=1.0,
    )
    out["double_pendulum"] = Scene(
        "chaotic double pendulum, 5 s",
        _ROD,
        ((2.0, 0.5), (0.0, 0.0)),
        every=25,
        refine=8,
        scale=GRAVITY,
    )
    out["f32"] = Scene(
        "a top in f32 against f64, 500 s",
        Top((1.0, 1.0, 0.5), 2.0),
        ((np.cos(0.25), np.sin(0.25), 0.0, 0.0), (0.0, 0.3, 6.0)),
        dt=2.0**-7,
        every=320,
        scale=2.0,
        single=True,
    )
    out["spring_adaptive"] = replace(
        out["spring_1e9"], title="joint spring of 1e9, adaptive", adaptive=True
    )
    out["gimbal_adaptive"] = replace(
        out["gimbal"], title="past gimbal lock, adaptive", adaptive=True
    )
    return out
