"""Derivatives of forces that act on their own joint only, multiplied by a matrix from the left.

If all elements are springs, dampers and actuators of the joints, a force depends only on its own
joint: the Jacobian has a block for each joint, and one tangent gives a column of all blocks at once
(Curtis, Powell & Reid 1974). A chain of 40 hinges takes 3 tangents, not 120.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers.choice import CPU_UNROLLED_UP_TO
from rbjax.lanes.arrays import matmat
from rbjax.model import Model

Forces = Callable[[jax.Array, jax.Array], jax.Array]


def times_jacobian(
    model: Model, forces: Forces, nu: int, M: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """M F_x (n, 2 n) and M F_u (n, nu) of forces(dx, du), at zero, with M (n, n), if each force
    depends only on the state of its own joint."""
    n, dtype = model.nv, M.dtype
    zero, none = jnp.zeros(2 * n, dtype), jnp.zeros(nu, dtype)
    top = model.topology
    sizes = [joint.nv for joint in top.joints]
    joint = np.repeat(np.arange(len(sizes)), sizes)
    place = np.concatenate([np.arange(k) for k in sizes])  # of each dof within its joint
    drives = np.array(model.actuators.joints[:nu], int).reshape(nu)
    rank = np.array([(drives[:k] == drives[k]).sum() for k in range(nu)], int)
    b, c = max(sizes), max(rank, default=-1) + 1
    seeds = [np.concatenate([place == k, np.zeros(n)]) for k in range(b)]
    seeds += [np.roll(seed, n) for seed in seeds]
    along_x = np.stack([*seeds, *np.zeros((c, 2 * n))]).astype(dtype)
    along_u = np.stack([np.zeros(nu)] * (2 * b) + [rank == k for k in range(c)]).astype(dtype)

    def column(dx: jax.Array, du: jax.Array) -> jax.Array:
        return jax.jvp(forces, (zero, none), (dx, du))[1]

    columns = jax.vmap(column, out_axes=1)(jnp.asarray(along_x), jnp.asarray(along_u))
    by_q, by_v, by_u = columns[:, :b], columns[:, b : 2 * b], columns[:, 2 * b :]
    if b > 1:
        same = joint[:, None] == joint
        F_x = [jnp.where(same, block[:, place], 0.0) for block in (by_q, by_v)]
        F_u = jnp.where(joint[:, None] == drives, by_u[:, rank], 0.0)
        return matmat(M, jnp.concatenate(F_x, 1)), matmat(M, F_u)
    at = np.maximum(drives, 0)  # a joint is a dof; without a joint there is no force
    share = jnp.where(drives >= 0, by_u[at, rank], 0.0)
    return jnp.concatenate([M * by_q[:, 0], M * by_v[:, 0]], 1), M[:, at] * share


def by_joint(model: Model) -> bool:
    """Whether each force depends only on the state of its own joint, in a model so large that this
    shortens the program."""
    local = not model.forces and all(site < 0 for site in model.actuators.sites)
    return local and model.nv > CPU_UNROLLED_UP_TO
