"""A beam as a chain of equal rigid links with springs in the joints between them.

A beam of length L is cut into n rigid links of length h = L / n. The spring of a joint is the
stiffness of the piece of the beam from the middle of one link to the middle of the next:

    K_k = EI / h,    K_1 = 2 EI / h

The first joint is at the clamp and replaces only the half link after it. With K_1 = EI / h the
error would be of order h, not h^2. Masses are those of rigid rods. This is the simplest discrete
beam, and the one of MuJoCo's cables. The links neither stretch nor shear.

Source: Huston, *Multi-body dynamics including the effects of flexibility and compliance*, Computers
& Structures 14, 1981, 443-451; Wittbrodt, Adamiec-Wojcik & Wojciech, *Dynamics of Flexible
Multibody Systems: Rigid Finite Element Method*, Springer 2006.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.forces import Cable
from rbjax.loading.builder import ModelBuilder
from rbjax.model import Model


def lumped_beam(
    length: float,
    segments: int,
    *,
    bending: Sequence[float],
    torsion: float = 0.0,
    mass: float,
    inertia: Sequence[float],
    planar: bool = False,
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
) -> Model:
    """Make a clamped beam along x of rigid links with springs, as a robot of hinges or balls.

    The error of static deflections and of frequencies falls as 1 / segments^2.

    Args:
        length: m.
        segments: the number n of links.
        bending: E I_y, E I_z, N m^2.
        torsion: G J, N m^2; not used in the plane.
        mass: kg/m.
        inertia: rotary inertia per length about x, y, z, kg m, above zero.
        planar: hinges about z, n coordinates, instead of balls with 3 n.
        gravity: m/s^2.

    Returns:
        A model with the bodies and joints "link1" ... and the site "tip". The springs are
        `model.joints.stiffness` in the plane and an `rb.forces.Cable` in space.

    Raises:
        InputError: values that are not above zero, or of another shape.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.flexible.reference.lumped_chain import lumped_beam
        >>> model = lumped_beam(
        ...     1.0, 4, bending=(1.0, 1.0), torsion=0.8, mass=1.0, inertia=(2e-4, 1e-4, 1e-4)
        ... )
        >>> model.nv, round(float(model.bodies.mass.sum()), 6)
        (12, 1.0)
    """
    where = "lumped_beam"
    n = check_beam(where, length, segments, bending, torsion, mass, inertia, planar)
    h = length / n
    rod = mass * h**3 / 12
    moments = np.array(inertia, float) * h + [0.0, rod, rod]
    builder = ModelBuilder(gravity=gravity)
    parent: str | None = None
    for k in range(n):
        name = f"link{k + 1}"
        at = (h if k else 0.0, 0.0, 0.0)
        builder.add_body(
            name, parent, position=at, mass=mass * h, com=(h / 2, 0, 0), inertia=moments
        )
        if planar:
            builder.add_joint(name, name, stiffness=float(bending[1]) / h * (1 if k else 2))
        else:
            builder.add_joint(name, name, "ball")
        parent = name
    builder.add_site("tip", parent, position=(h, 0, 0))
    model = builder.build()
    if planar:
        return model
    dtype = model.gravity.dtype
    rows = np.tile([torsion, *map(float, bending)], (n, 1))
    lengths = np.full(n, h)
    lengths[0] = h / 2
    one = jnp.ones((), dtype)
    springs = Cable(
        one, one, jnp.asarray(rows, dtype), jnp.asarray(lengths, dtype), jnp.zeros((n, 3), dtype),
        model.joint_names,
    )  # fmt: skip
    return model.with_forces(springs)


def check_beam(
    where: str, length: Any, segments: Any, bending: Any, torsion: Any, mass: Any, inertia: Any,
    planar: bool,
) -> int:  # fmt: skip
    """Check the values of a uniform beam, and return the number of segments."""
    n = integer(where, "segments", segments, least=1)
    given = {"length": length, "mass": mass} | ({} if planar else {"torsion": torsion})
    for name, value in given.items():
        if not check_array(where, name, value, ()) > 0:
            raise InputError(f"{where}: {name} is {value}, expected a value above zero")
    for name, value, size in (("bending", bending, 2), ("inertia", inertia, 3)):
        if not (check_array(where, name, value, (size,)) > 0).all():
            raise InputError(f"{where}: {name} is {value}, expected {size} values above zero")
    return n
