"""The Coriolis matrix of a tree with flexible links.

Let y = [V; q'] = J v be the twist of a link in its own axes, with the rates of its coordinates if
it has an inertia I(q) over both. A prime is a time derivative:

    C = sum over links of J^T (I J' + N J),
    N = (I' + P - P^T) / 2 + Q,    P = [0, d(I y)/dq],   Q = blockdiag(-[[h~, p~], [p~, 0]], 0)

with [h; p] the momentum of the link, the part of I y for V. Q and P - P^T are skew, so M' = C + C^T
for the mass matrix M = sum of J^T I J (Lagrange's equations in quasi-velocities, Hamel 1904). The
stiffness of rotation of modal bodies (`rbjax.flexible.modal`) is not part of C.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.body_jacobians import body_jacobians
from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.joints import LinkInertia
from rbjax.lanes import Vec3, as_arrays, matmat, matvec
from rbjax.model import Model, prepare
from rbjax.spatial import Force, Motion, RigidInertia


def flexible_coriolis_matrix(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute `coriolis_matrix` (nv, nv) of a tree with flexible links."""
    h = jnp.zeros((), q.dtype)
    J, J_rate = jax.jvp(
        lambda h: body_jacobians(model, integrate(model, q, h * v)), (h,), (jnp.ones_like(h),)
    )
    d = Unrolled(model, prepare(model, q.dtype))
    C = jnp.zeros((model.nv, model.nv), q.dtype)
    for i, (link, joint) in enumerate(zip(d.constants, d.joints(q, v), strict=True)):
        M = rigid_matrix(joint.inertia(link), q.dtype)
        C = C + matmat(
            J[i].T, matmat(M, J_rate[i]) + matmat(_momentum_matrix(M, matvec(J[i], v)), J[i])
        )
        if joint.link_inertia(Vec3.zero()) is not None:
            C = C + _of_link_inertia(model, joint, i, J[i], J_rate[i], v)
    return C


def _of_link_inertia(model: Model, joint: Any, i: int, J: Any, J_rate: Any, v: Any) -> jax.Array:
    """Compute the part of C of a `LinkInertia`."""
    at = jnp.array(list(model.topology.links[i].v))
    count, none = len(at), [0.0] * len(at)
    unit = jnp.zeros((count, model.nv), v.dtype).at[jnp.arange(count), at].set(1.0)
    J, J_rate = jnp.concatenate([J, unit]), jnp.concatenate([J_rate, 0 * unit])
    q, y = jnp.stack(as_arrays(list(joint.q), v[0])), matvec(J, v)

    def matrix(q: jax.Array) -> jax.Array:
        inertia = joint.joint.inertia(list(q), none, Vec3.zero(), joint.params)
        return link_matrix(inertia, v.dtype)

    M, rate = jax.jvp(matrix, (q,), (v[at],))
    by_q = jax.jacfwd(lambda q: matvec(matrix(q), y))(q)
    P = jnp.concatenate([jnp.zeros((len(y), 6), v.dtype), by_q], 1)
    N = (rate + P - P.T) / 2 + _momentum_matrix(M, y)
    return matmat(J.T, matmat(M, J_rate) + matmat(N, J))


def _momentum_matrix(M: jax.Array, y: jax.Array) -> jax.Array:
    """Return Q, with Q y = V x* (M y) for the part of V and zero for the part of q'."""
    momentum = matvec(M, y)
    h, p = _skew(momentum[:3]), _skew(momentum[3:6])
    Q = -jnp.block([[h, p], [p, jnp.zeros_like(p)]])
    return jnp.zeros_like(M).at[:6, :6].set(Q)


def _skew(x: jax.Array) -> jax.Array:
    o = jnp.zeros_like(x[0])
    return jnp.stack([o, -x[2], x[1], x[2], o, -x[0], -x[1], x[0], o]).reshape(3, 3)


def rigid_matrix(inertia: RigidInertia, dtype: Any) -> jax.Array:
    """Return the spatial inertia (6, 6) of a rigid body, angular part first."""
    like = jnp.zeros((), dtype)
    columns = [inertia(Motion.from_lanes([float(k == j) for k in range(6)])) for j in range(6)]
    return jnp.stack([jnp.stack(as_arrays([*f], like)) for f in columns], -1)


def link_matrix(inertia: LinkInertia, dtype: Any) -> jax.Array:
    """Return the inertia (6 + n, 6 + n) of a flexible link over its base and coordinates."""
    like = jnp.zeros((), dtype)

    def column(f: Force) -> jax.Array:
        return jnp.stack(as_arrays([*f], like))

    C = jnp.stack([column(f) for f in inertia.coupling], -1)
    m = jnp.stack([jnp.stack(as_arrays(list(row), like)) for row in inertia.mass])
    return jnp.block([[rigid_matrix(inertia.rigid, dtype), C], [C.T, m]])
