"""Elastic and viscous forces of a beam in strain coordinates.

    tau = -K q - D q',    K = int B^T C B ds,   D = int B^T C_v B ds

B is the derivative of the strains by q, C the stiffness of the section and C_v its viscosity
(Kelvin and Voigt). If C is constant and diagonal, K is diagonal. A step that is implicit in
stiffness then adds it to the armature, without a further factorization.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax

from rbjax.errors import InputError
from rbjax.flexible.linear_elasticity import LinearElasticity, Matrix
from rbjax.flexible.strain import StrainBeam, stiffness_matrix
from rbjax.forces.context import Context
from rbjax.forces.element import Shapes
from rbjax.lanes import Lane
from rbjax.model import Model
from rbjax.model.leaves import numbers


class BeamElasticity(LinearElasticity):
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

    def matrices(self, context: Context) -> tuple[str, Matrix, Matrix]:
        kind, length = beam_of(context.model, self.joint, context.q.dtype, "BeamElasticity")

        def matrix(C: jax.Array) -> Matrix:
            return stiffness_matrix(kind, _nested(C, context.q.dtype), length)

        return self.joint, matrix(self.stiffness), matrix(self.viscosity)


def beam_of(
    model: Model, joint: str, dtype: jax.typing.DTypeLike, where: str
) -> tuple[StrainBeam, Lane]:
    """Return the kind of joint of a beam and its length. `where` is the caller in messages."""
    kind, params = beam_params(model, joint, dtype, where)
    return kind, params["length"][0]


def beam_params(
    model: Model, joint: str, dtype: jax.typing.DTypeLike, where: str
) -> tuple[StrainBeam, dict[str, list[Lane]]]:
    """Return the kind of joint of a beam and its parameters by name."""
    j = model.joint(joint)
    kind = model.topology.joints[j]
    if not isinstance(kind, StrainBeam):
        raise InputError(
            f"{where}: the joint {joint!r} is of the kind {kind.name!r}, expected a beam "
            "(Model.with_beam)"
        )
    at = sum(len(one.defaults) for one in model.topology.joints[:j])
    return kind, kind.named(numbers(model.joints.params[at : at + len(kind.defaults)], dtype))


def _nested(C: jax.Array, dtype: jax.typing.DTypeLike) -> Sequence:
    """Convert an array to nested lists of lanes."""
    if C.ndim == 1:
        return numbers(C, dtype)
    return [_nested(C[i], dtype) for i in range(C.shape[0])]
