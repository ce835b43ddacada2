"""Linear elastic and viscous forces on the coordinates of a flexible link, and its attachment.

    tau = -K q - D q',    U = q.K q / 2

If K and D are diagonal, a step that is implicit in them adds them to the armature, without a
further factorization.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import flag
from rbjax.errors import InputError
from rbjax.flexible.strain import elastic_energy
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads
from rbjax.forces.slopes import Slope
from rbjax.joints import kind
from rbjax.lanes import Lane, add, inner, is_zero, neg
from rbjax.model import Model

Matrix = list[list[Lane]]


class LinearElasticity(Element):
    """Base class of the elasticity of a flexible link. Subclasses define `matrices`."""

    def matrices(self, context: Context) -> tuple[str, Matrix, Matrix]:
        """Return the name of the joint, K and D as rows of lanes. Entries that are structurally
        zero are literals."""
        raise NotImplementedError(
            f"{type(self).__name__} has no method matrices(context) -> joint, K, D"
        )

    def loads(self, context: Context) -> Loads:
        joint, K, D = self.matrices(context)
        at_q, at_v = context.model.q_slice(joint), context.model.v_slice(joint)
        q, v = list(context.q[at_q]), list(context.v[at_v])
        rows = enumerate(zip(K, D, strict=True), at_v.start)
        return Loads({i: neg(add(inner(k, q), inner(d, v))) for i, (k, d) in rows})

    def slopes(self, context: Context) -> Iterable[Slope]:
        joint, K, D = self.matrices(context)
        start = context.model.v_slice(joint).start
        for i, (k, d) in enumerate(zip(K, D, strict=True)):
            for j, (stiffness, damping) in enumerate(zip(k, d, strict=True)):
                if not (is_zero(stiffness) and is_zero(damping)):
                    along = None if i == j else {start + j: 1.0}
                    yield Slope({start + i: 1.0}, stiffness, damping, along)

    def energy(self, context: Context) -> Lane:
        joint, K, _ = self.matrices(context)
        return elastic_energy(K, list(context.q[context.model.q_slice(joint)]))


def diagonal_if_known(x: Any) -> jax.Array:
    """Return the diagonals (..., n) of matrices (..., n, n), if all are known to be diagonal."""
    if isinstance(x, jax.core.Tracer):
        return x
    off = np.asarray(x) * (1 - np.eye(np.shape(x)[-1]))
    return jnp.asarray(x) if off.any() else jnp.diagonal(x, axis1=-2, axis2=-1)


def with_free_base(
    where: str, what: str, model: Model, name: str, parent: str, base: dict[str, Any], free: bool
) -> tuple[Model, str, dict[str, Any]]:
    """Add the free base of a flexible link, if it has one.

    Args:
        where, what: the caller and the link, "beam" or "body", in messages.
        name: name of the link; its base is `name` + "_base".
        parent: the given parent, which must be the world if the base is free.
        base: position and orientation of the base frame.

    Returns:
        the model, the parent of the link, and the place of the link in it.
    """
    if not flag(where, "free", free):
        return model, parent, base
    if parent != "world":
        raise InputError(
            f"{where}: got parent={parent!r} and free=True; the base of a free {what} is in the "
            "world: leave out parent, or free"
        )
    return model.with_link(f"{name}_base", kind("free"), **base), f"{name}_base", {}
