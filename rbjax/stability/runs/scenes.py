"""Scenes built to break solvers, each with the true motion.

The true motion of an arm comes from Lagrange's equations in absolute angles, written by hand. Near
gimbal lock it comes from the pendulum in Cartesian coordinates, which have no gimbal lock. That of
a body comes from a quaternion. Dormand-Prince 8 solves them at two small steps, and the difference
bounds its error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np

from rbjax.model import State
from rbjax.stability.runs.long_run import long_run
from rbjax.stability.runs.systems import (
    GRAVITY,
    Arm,
    Body,
    bob,
    planar,
    spherical,
    tumbling,
    unit_rows,
)

SAMPLES = 200


@dataclass(frozen=True)
class Scene:
    """A system, its start, and equal steps of dt, `every` steps for each of 200 samples.

    Fields: title; system; start, (q, v) or (quaternion, w); dt, s; every; refine, steps of the
    reference for one dt; scale, J, the unit of energy (0: it is not conserved); adaptive, whether a
    controller chooses the steps, with a tolerance of 1e-6 and at most 10,000 steps; single, whether
    f32 is compared with the same steps in f64; speed, rad/s, that of the motion.
    """

    title: str
    system: Arm | Body
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
        """(201,) s."""
        return self.dt * self.every * np.arange(SAMPLES + 1)

    @property
    def state(self) -> Any:
        first, second = (jnp.array(x) for x in self.start)
        return State(first, second) if isinstance(self.system, Arm) else (first, second)


class Truth(NamedTuple):
    """The true motion: observed (201, n), and the bound of its error."""

    observed: np.ndarray
    error: float


def truth(scene: Scene) -> Truth:
    """The motion of a scene, and the difference between two step sizes of the reference.

    max_k |r_k(h) - r_k(h / 2)|, of Dormand-Prince 8 at h = dt / refine.

    Args:
        scene: one of `rb.stability.scenes()`, or similar.

    Returns:
        `Truth`: observed (201, 2) joint angles, rad, or (201, 3) the bob near gimbal lock, m, or
        (201, 4) quaternions; error, its bound.

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
    if isinstance(system, Body):
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
    """The state itself."""
    return y


def deviation(scene: Scene, q: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """The error of configurations (T, nq), (T, n): angles in rad, or the bob in m.

    The error of an attitude is the angle to the true one.
    """
    if isinstance(scene.system, Body):
        unit, real = unit_rows(q), unit_rows(observed)
        gap = np.minimum(np.linalg.norm(unit - real, axis=1), np.linalg.norm(unit + real, axis=1))
        return 4 * np.arcsin(np.minimum(gap / 2, 1.0))[:, None]
    return (bob(q) if scene.system.gimbal else q) - observed


_ROD = Arm()
_SPRING = ((0.0, 1.0), (0.0, 0.0))


@cache
def scenes() -> dict[str, Scene]:
    """name -> `Scene`, in a fixed order.

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
        "servo gains far above the step's limit",
        Arm(kp=(1e5, 1e5), kv=(1e3, 1e3)),
        ((0.5, -0.5), (0.0, 0.0)),
        refine=64,
    )
    out["damping"] = Scene(
        "joint damping of 1e3 N m s/rad",
        Arm(damping=(1e3, 1e3)),
        ((1.0, 0.5), (0.0, 0.0)),
        refine=64,
    )
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
        Body((0.0215, 0.0215, 0.0012), 0.981),
        ((np.cos(0.15), np.sin(0.15), 0.0, 0.0), (0.0, 0.0, 1000.0)),
        refine=32,
        scale=0.981,
        speed=1000.0,
    )
    out["dzhanibekov"] = Scene(
        "Dzhanibekov's flips over 1,000 s",
        Body((1.0, 2.0, 3.5)),
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
        Body((1.0, 1.0, 0.5), 2.0),
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
