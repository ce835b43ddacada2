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

import jax.numpy as jnp
import numpy as np

from rbjax.flexible.reference.uniform_beam import UniformBeam
from rbjax.forces import Cable
from rbjax.loading.builder import ModelBuilder
from rbjax.model import Model


def lumped_beam(beam: UniformBeam) -> Model:
    """Make a clamped beam along x of rigid links with springs, as a robot of hinges or balls.

    The error of static deflections and of frequencies falls as 1 / segments^2.

    Args:
        beam: the properties of the beam, with a link for each segment. A planar beam has hinges
            about z, otherwise balls.

    Returns:
        A model with the bodies and joints "link1" ... and the site "tip". The springs are
        `model.joints.stiffness` in the plane and an `rb.forces.Cable` in space.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.flexible.reference import UniformBeam, lumped_beam
        >>> beam = UniformBeam(
        ...     1.0, 4, bending=(1.0, 1.0), torsion=0.8, mass=1.0, inertia=(2e-4, 1e-4, 1e-4)
        ... )
        >>> model = lumped_beam(beam)
        >>> model.nv, round(float(model.bodies.mass.sum()), 6)
        (12, 1.0)
    """
    n, h, mass = beam.segments, beam.segment_length, beam.mass
    rod = mass * h**3 / 12
    moments = np.array(beam.inertia, float) * h + [0.0, rod, rod]
    builder = ModelBuilder(gravity=beam.gravity)
    parent: str | None = None
    for k in range(n):
        name = f"link{k + 1}"
        at = (h if k else 0.0, 0.0, 0.0)
        builder.add_body(
            name, parent, position=at, mass=mass * h, com=(h / 2, 0, 0), inertia=moments
        )
        if beam.planar:
            (stiffness,) = beam.spring_constants
            builder.add_joint(name, name, stiffness=float(stiffness) / h * (1 if k else 2))
        else:
            builder.add_joint(name, name, "ball")
        parent = name
    builder.add_site("tip", parent, position=(h, 0, 0))
    model = builder.build()
    if beam.planar:
        return model
    dtype = model.gravity.dtype
    rows = np.tile(beam.spring_constants, (n, 1))
    lengths = np.full(n, h)
    lengths[0] = h / 2
    one = jnp.ones((), dtype)
    springs = Cable(
        one, one, jnp.asarray(rows, dtype), jnp.asarray(lengths, dtype), jnp.zeros((n, 3), dtype),
        model.joint_names,
    )  # fmt: skip
    return model.with_forces(springs)
