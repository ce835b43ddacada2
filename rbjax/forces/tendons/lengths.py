"""Lengths and Jacobians of all tendons as functions of the configuration."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.forces.context import Context
from rbjax.forces.reach import Reach
from rbjax.forces.tendons.paths import tendon_reach
from rbjax.lanes.arrays import pack
from rbjax.model import Model, State


def _reaches(model: Model, q: jax.Array) -> list[Reach]:
    context = Context.of(model, 0.0, State(q, jnp.zeros(model.nv, q.dtype)), None)
    return [tendon_reach(context, i) for i in range(len(model.tendon_names))]


@algorithm("q")
def tendon_lengths(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the lengths l(q) of all tendons.

    A fixed tendon has l = sum of c_k q_k. A spatial tendon has the length of the shortest path
    through its sites and around its spheres and cylinders; branches after a pulley are divided by
    its divisor. Use it for tendon sensors, muscle lengths and springs.

    Args:
        model: the robot; `model.tendons` are its tendons.
        q: (nq,) configuration.

    Returns:
        (nt,) lengths: m, or the unit of the joint coordinates of a fixed tendon. It is empty if the
        model has no tendons. It is differentiable by q; a tendon that begins to touch a geom has a
        continuous first derivative.

    Raises:
        InputError: wrong shape or dtype, values that are not finite, zero quaternions.

    Source: MuJoCo documentation, *XML reference*, tendon; the wrapping is plane geometry
    (`rbjax/forces/tendons/wrapping.py`).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> arm = '<body><joint name="j"/><geom size=".1" contype="0"/></body>'
        >>> belt = '<fixed name="belt"><joint joint="j" coef="2"/></fixed>'
        >>> text = f"<worldbody>{arm}</worldbody><tendon>{belt}</tendon>"
        >>> model = rb.load(f"<mujoco>{text}</mujoco>")
        >>> rb.tendon_lengths(model, jnp.array([0.5])).tolist()
        [1.0]
    """
    return pack([x.length for x in _reaches(model, q)], q)


@algorithm("q")
def tendon_jacobian(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the Jacobian J = dl/dq of all tendon lengths, by velocity coordinates.

    l' = J v, and a tension f in the tendons is the generalized force -J^T f. It is a closed form of
    the directions of the straight pieces of the tendons, not a derivative of the lengths.

    Args:
        model: the robot; `model.tendons` are its tendons.
        q: (nq,) configuration.

    Returns:
        (nt, nv), the moment arms of each tendon in m, or the coefficients of a fixed tendon.

    Raises:
        InputError: wrong shape or dtype, values that are not finite, zero quaternions.

    Source: MuJoCo documentation, *Computation*, transmission.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("cart_pole")
        >>> rb.tendon_jacobian(model, model.default_state().q).shape
        (0, 2)
    """
    rows = [
        pack([reach.arms.get(n, 0.0) for n in range(model.nv)], q) for reach in _reaches(model, q)
    ]
    return jnp.stack(rows) if rows else jnp.zeros((0, model.nv), q.dtype)
