"""Standard problems of beams, the same for every formulation."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.flexible.cross_section import Section
from rbjax.flexible.cross_section import section as section_of
from rbjax.flexible.reference.dynamics import Motion, simulate
from rbjax.flexible.reference.mesh import Curve, Formulation, line
from rbjax.flexible.reference.statics import solve_static


def cantilever(
    formulation: Formulation,
    section: Section,
    length: float,
    elements: int,
    *,
    force: Any = (0.0, 0.0, 0.0),
    moment: Any = (0.0, 0.0, 0.0),
    steps: int = 1,
    curve: Curve | None = None,
    planar: bool = False,
) -> jax.Array:
    """Compute the displacement of the tip of a cantilever under a dead force and moment, (3,), m.

    length: m.
    elements: number of elements.
    force, moment: on the tip, (3,), world axes, N and N m. They grow in proportion.
    steps: number of loads on the way, without the unloaded state.
    curve: the unloaded beam; straight along x from the origin if None.
    planar: whether to fix the dofs out of the plane x-y; a planar formulation has none.
    Raises RbjaxError if Newton's method fails: more steps help.

    >>> import rbjax.flexible.reference as rf
    >>> from rbjax.flexible import section
    >>> rod = section([1.0, 1.0, 1.0, 1e4, 1e4, 1e4], 1.0, [0.0, 0.0, 0.0])
    >>> quarter = rf.cantilever(rf.Reissner(), rod, 1.0, 8, moment=(0, 0, np.pi / 2), steps=4)
    >>> f"{quarter[1]:.3f}"  # a quarter of a circle: 2 / pi
    '0.638'
    """
    if steps < 1:
        raise InputError(f"steps is {steps}. It must be at least 1.")
    curve = line() if curve is None else curve
    mesh = formulation.build(curve, length, section, elements)
    supports = formulation.supports(mesh, planar=planar or not formulation.spatial)
    wrench = np.zeros((steps, len(mesh.q), 6))
    wrench[:, -1] = np.linspace(0, 1, steps + 1)[1:, None] * np.array([*force, *moment])
    found = solve_static(mesh, wrench, supports)
    x, x0 = (formulation.pose(q[-1])[0] for q in (found.mesh.q, mesh.q))
    return x - x0


def flying_beam(
    formulation: Formulation,
    elements: int,
    dt: float,
    seconds: float = 7.5,
    *,
    EI: float = 500.0,
    shear: float = 1e4,
) -> Motion:
    """Simulate the free beam of Simo and Vu-Quoc in the plane under a force and a moment.

    The beam of 10 m lies from (0, 8) to (6, 0) m. For 2.5 s a force of 8 N along x and a clockwise
    moment of 80 N m act on its lower end, the last node. EA = 1e4 N, rhoA = 1 kg/m, rhoI = 10 kg m.

    elements: number of elements.
    dt: step, s; 2.5 s should be a multiple of it.
    seconds: duration, s.
    EI: bending stiffness, N m^2: 500, or 100 for the "flying spaghetti".
    shear: GA, N.
    Simo and Vu-Quoc, "On the dynamics of flexible beams under large overall motions, the plane
    case: part II", J. Appl. Mech. 53 (1986) 855-863.

    >>> import rbjax.flexible.reference as rf
    >>> motion = rf.flying_beam(rf.Reissner(), 4, 0.05, 3.0)
    >>> f"{motion.p[-1, :, 0].sum():.10f}"  # the impulse, 8 N for 2.5 s
    '20.0000000000'
    """
    section = section_of([EI, EI, EI, 1e4, shear, shear], 1.0, [20.0, 10.0, 10.0])
    curve = line((0.0, 8.0), -np.arctan2(8.0, 6.0))
    mesh = formulation.build(curve, 10.0, section, elements)
    middle = (np.arange(round(seconds / dt)) + 0.5) * dt
    wrenches = np.zeros((len(middle), len(mesh.q), 6))
    wrenches[middle < 2.5, -1] = [8.0, 0, 0, 0, 0, -80.0]
    return simulate(mesh, wrenches, dt, formulation.supports(mesh, clamp=False, planar=True))


def spin_up_beam(
    formulation: Formulation, elements: int, dt: float, seconds: float = 20.0
) -> tuple[jax.Array, jax.Array]:
    """Simulate a beam whose clamp spins up to 6 rad/s in 15 s.

    elements: number of elements.
    dt: step, s.
    seconds: duration, s.
    Returns times (steps + 1,), s, and the displacement of the tip in the axes of the clamp, axial
    and across, (steps + 1, 2), m.
    Kane, Ryan and Banerjee, J. Guid. Control Dyn. 10 (1987); Simo and Vu-Quoc, "The role of
    non-linear theories in transient dynamic analysis of flexible structures", J. Sound Vib. 119
    (1987), for the parameters.

    >>> import rbjax.flexible.reference as rf
    >>> t, tip = rf.spin_up_beam(rf.AbsoluteNodal(), 2, 0.05, 2.5)
    >>> f"{tip[-1, 1]:.2f}"
    '-0.15'
    """
    stiffness = [1.4e4, 1.4e4, 1.4e4, 2.8e7, 1e7, 1e7]
    section = section_of(stiffness, 1.2, [1.2e-3, 6e-4, 6e-4])
    mesh = formulation.build(line(), 10.0, section, elements)
    t = dt * np.arange(round(seconds / dt) + 1)
    psi = spin_up_angle(t)
    wrenches = np.zeros((len(t) - 1, len(mesh.q), 6))
    supports = formulation.supports(mesh, planar=True)
    motion = simulate(mesh, wrenches, dt, supports, clamp_angles=psi)
    x = formulation.pose(motion.q[:, -1])[0]
    c, s = jnp.cos(psi), jnp.sin(psi)
    across = -s * x[:, 0] + c * x[:, 1]
    return motion.t, jnp.stack([c * x[:, 0] + s * x[:, 1] - 10.0, across], -1)


def spin_up_angle(t: np.ndarray) -> np.ndarray:
    """Return the angle of the clamp of `spin_up_beam` at times t, rad."""
    w = 2 * np.pi / 15
    early = 6 / 15 * (t**2 / 2 + (np.cos(w * t) - 1) / w**2)
    return np.where(t < 15, early, 6 * t - 45)
