"""A beam as a chain of segments of constant curvature, with masses lumped at their ends.

The curvature and torsion of a segment of length h are constant, phi = h (k_x, k_y, k_z):

    R = exp(phi),   p = J_l(phi) (h, 0, 0),   K = diag(GJ, EI_y, EI_z) / h

R, p is the pose of the end of a segment at its start: a `Node` of three coordinates phi, or of one
in the plane. The mass of half a segment on either side is at each end. The segments neither stretch
nor shear. It is the coarsest of the beams in strain coordinates, whose strains are polynomials.

Source: Renda, Boyer, Dias & Seneviratne, *Discrete Cosserat approach for multisection soft
manipulator dynamics*, IEEE Trans. Robotics 34, 2018, 1518-1533; lumped masses as in Herrmann &
Kotyczka, Comput. Methods Appl. Mech. Eng. 431, 2024, 117367.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax import joints
from rbjax.flexible.reference.uniform_beam import UniformBeam
from rbjax.forces import Context, Element, Loads
from rbjax.forces.element import Shapes
from rbjax.forces.slopes import Slope
from rbjax.lanes import Lane, Mat3, Vec3, mul, neg, total
from rbjax.loading.builder import ModelBuilder
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.rotations.coefficients import polynomial, stumpff
from rbjax.spatial import Transform


class ConstantStrain(joints.Node):
    """A segment of constant curvature and torsion. q is phi (3,), rad, and its `length` is in m."""

    name, coordinates = "constant_strain", 3
    params = {"length": 1.0}  # noqa: RUF012

    def pose(self, q: Sequence[Lane], params: Sequence[Lane]) -> Transform:
        phi, (length,) = list(q), params
        c1, c2, c3 = stumpff(sum(x * x for x in phi), 1, 2, 3)
        along = Mat3(*polynomial(1.0, c2, c3, phi))
        return Transform(Mat3(*polynomial(1.0, c1, c2, phi)), along @ Vec3(length, 0.0, 0.0))


class ConstantCurvature(joints.Node):
    """A segment of constant curvature in the plane. q is the angle of the arc, rad, about z."""

    name, coordinates = "constant_curvature", 1
    params = {"length": 1.0}  # noqa: RUF012

    def pose(self, q: Sequence[Lane], params: Sequence[Lane]) -> Transform:
        (a,), (length,) = q, params
        c0, c1, c2 = stumpff(a * a, 0, 1, 2)
        sine = a * c1
        R = Mat3(c0, -sine, 0.0, sine, c0, 0.0, 0.0, 0.0, 1.0)
        return Transform(R, Vec3(length * c1, length * a * c2, 0.0))


for _kind in (ConstantStrain(), ConstantCurvature()):
    joints.register(_kind)


class StrainSprings(Element):
    """Linear springs on the coordinates of segments, tau_i = -k_i q_i.

    Fields:
        stiffness: (n, c), a row per segment, N m/rad.
        segments: joints, names or indices; static.

    Example:
        >>> import jax.numpy as jnp, rbjax as rb
        >>> from rbjax.flexible.reference.piecewise_constant_strain import StrainSprings
        >>> model = rb.load("pendulum")
        >>> model = model.with_forces(StrainSprings(jnp.array([[3.0]]), model.joint_names))
        >>> state = model.default_state().replace(q=jnp.array([0.5]))
        >>> rb.applied_forces(model, state).tolist()
        [-1.5]
    """

    stiffness: jax.Array
    segments: tuple[str | int, ...] = eqx.field(static=True)
    unlimited = ()

    def shapes(self, model: Model) -> Shapes:
        return {"stiffness": (len(self.segments), None)}

    def loads(self, context: Context) -> Loads:
        return Loads({i: mul(neg(k), x) for i, k, x in self._coordinates(context)})

    def slopes(self, context: Context) -> list[Slope]:
        return [Slope({i: 1.0}, k, 0.0) for i, k, _ in self._coordinates(context)]

    def energy(self, context: Context) -> Lane:
        """Compute the sum of k_i q_i^2 / 2, J."""
        return total(mul(0.5, mul(k, x * x)) for _, k, x in self._coordinates(context))

    def _coordinates(self, context: Context) -> list[tuple[int, Lane, Lane]]:
        """List dof, stiffness and value of each coordinate."""
        rows, out = table(self.stiffness, context.q.dtype), []
        for n, joint in enumerate(map(context.joint, self.segments)):
            stiffness = [lane(rows[:, c], n) for c in range(rows.shape[1])]
            out += [
                (joint.start + c, k, x)
                for c, (k, x) in enumerate(zip(stiffness, joint.q, strict=True))
            ]
        return out


def constant_strain_beam(beam: UniformBeam) -> Model:
    """Make a clamped beam along x of segments of constant curvature, as a robot of nodes.

    The error of static deflections and of frequencies falls as 1 / segments^2.

    Args:
        beam: the properties of the beam.

    Returns:
        A model with the bodies and joints "segment1" ..., each body at the end of its segment, and
        the site "tip". The springs are `StrainSprings`.

    Example:
        >>> from rbjax.flexible.reference import UniformBeam, constant_strain_beam
        >>> beam = UniformBeam(
        ...     1.0, 4, bending=(1.0, 1.0), torsion=0.8, mass=1.0, inertia=(2e-4, 1e-4, 1e-4)
        ... )
        >>> model = constant_strain_beam(beam)
        >>> model.nv, model.topology.joint_kinds[0]
        (12, 'constant_strain')
    """
    n, h = beam.segments, beam.segment_length
    builder = ModelBuilder(gravity=beam.gravity)
    names = [f"segment{k + 1}" for k in range(n)]
    for k, name in enumerate(names):
        share = h if k < n - 1 else h / 2
        moments = np.array(beam.inertia, float) * share
        mass = beam.mass * share
        builder.add_body(name, names[k - 1] if k else None, mass=mass, inertia=moments)
        builder.add_joint(name, name)
    builder.add_site("tip", names[-1])
    model = builder.build()
    kind = ConstantCurvature.name if beam.planar else ConstantStrain.name
    for name in names:
        model = model.with_joint(name, kind, length=h)
    rows = np.tile(beam.spring_constants / h, (n, 1))
    return model.with_forces(StrainSprings(jnp.asarray(rows, model.gravity.dtype), tuple(names)))
