"""Elastic and viscous forces of a beam in strain coordinates.

    tau = -K q - D q',    K = int B^T C B ds,   D = int B^T C_v B ds

B is the derivative of the strains by q, C the stiffness of the section and C_v its viscosity
(Kelvin and Voigt). If C is constant and diagonal, K is diagonal. A step that is implicit in
stiffness then adds it to the armature, without a further factorization.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import equinox as eqx
import jax

from rbjax.errors import InputError
from rbjax.flexible.strain import StrainBeam, elastic_energy, stiffness_matrix
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.forces.slopes import Slope
from rbjax.lanes import Lane, add, inner, is_zero, neg
from rbjax.model import Model
from rbjax.model.leaves import numbers


class BeamElasticity(Element):
    """The elasticity and damping of a beam. `Model.with_beam` adds it.

    Fields:
        stiffness: C of the section in the order k_x, k_y, k_z, e_x, g_y, g_z: the diagonal (6,) or
            (6, 6); of a tapered beam one diagonal (points, 6) or matrix (points, 6, 6) at each
            Gauss point.
        viscosity: C_v of the section, of the same shape.
        joint: the name of the beam; static.

    Source: Boyer, Lebastard, Candelier & Renda, IEEE T-RO 37(3), 2021.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 1}, mass=0.5)
        >>> model = rb.load("<mujoco/>").with_beam("rod", rod)
        >>> state = model.default_state().replace(q=jnp.array([1.0, 1.0]))
        >>> rb.applied_forces(model, state).tolist()
        [-12.0, -4.0]
    """

    stiffness: jax.Array
    viscosity: jax.Array
    joint: str = eqx.field(static=True)

    def shapes(self, model: Model) -> Shapes:
        shape = (None,) * self.stiffness.ndim
        return {"stiffness": shape, "viscosity": shape}

    def _matrices(self, context: Context) -> tuple[StrainBeam, list[list[Lane]], list[list[Lane]]]:
        """Return the kind of joint, K and D."""
        kind, length = beam_of(context.model, self.joint, context.q.dtype, "BeamElasticity")

        def made(C: jax.Array) -> list[list[Lane]]:
            return stiffness_matrix(kind, _nested(C, context.q.dtype), length)

        return kind, made(self.stiffness), made(self.viscosity)

    def loads(self, context: Context) -> Loads:
        model = context.model
        _, K, D = self._matrices(context)
        at_q, at_v = model.q_slice(self.joint), model.v_slice(self.joint)
        q, v = list(context.q[at_q]), list(context.v[at_v])
        rows = enumerate(zip(K, D, strict=True), at_v.start)
        return Loads({i: neg(add(inner(k, q), inner(d, v))) for i, (k, d) in rows})

    def slopes(self, context: Context) -> Iterable[Slope]:
        _, K, D = self._matrices(context)
        start = context.model.v_slice(self.joint).start
        for i, (k, d) in enumerate(zip(K, D, strict=True)):
            for j, (stiffness, damping) in enumerate(zip(k, d, strict=True)):
                if not (is_zero(stiffness) and is_zero(damping)):
                    along = None if i == j else {start + j: 1.0}
                    yield Slope({start + i: 1.0}, stiffness, damping, along)

    def energy(self, context: Context) -> Lane:
        _, K, _ = self._matrices(context)
        return elastic_energy(K, list(context.q[context.model.q_slice(self.joint)]))


def beam_of(
    model: Model, joint: str, dtype: jax.typing.DTypeLike, where: str
) -> tuple[StrainBeam, Lane]:
    """Return the kind of joint of a beam and its length. `where` is the caller in messages."""
    j = model.joint(joint)
    kind = model.topology.joints[j]
    if not isinstance(kind, StrainBeam):
        raise InputError(
            f"{where}: the joint {joint!r} is of the kind {kind.name!r}, expected a beam "
            "(Model.with_beam)"
        )
    at = sum(len(one.defaults) for one in model.topology.joints[:j])
    params = numbers(model.joints.params[at : at + len(kind.defaults)], dtype)
    (length,) = kind.named(params)["length"]
    return kind, length


def _nested(C: jax.Array, dtype: jax.typing.DTypeLike) -> Sequence:
    """Convert an array to nested lists of lanes."""
    if C.ndim == 1:
        return numbers(C, dtype)
    return [_nested(C[i], dtype) for i in range(C.shape[0])]
