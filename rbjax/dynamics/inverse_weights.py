"""Inverse inertias of bodies and dofs, which scale the regularisation of MuJoCo's constraints.

    O_i = (1 - S K^T) X O_p X^T (1 - S K^T)^T + S S^T / D,     K = U / D
is the response J M^-1 J^T of link i to a unit force on it, from the one of its parent p and the
factors of ABA. Then (M^-1)_ii = K^T X O_p X^T K + 1 / D. The configuration is the one in which the
file draws the robot. The weights are functions of the masses, as MuJoCo's mj_setConst makes them.

Source: Jain, *Robot and Multibody Dynamics*, ch. 10 (operational space compliance); MuJoCo,
*Computation*, constraint model.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.algorithms.aba import factorize
from rbjax.dynamics.algorithms.frames import jacobian
from rbjax.dynamics.algorithms.inverse import inverse_mass_matrix
from rbjax.dynamics.drivers.choice import Driver
from rbjax.dynamics.drivers.rolled import Rolled
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.joints import JointMotion
from rbjax.joints.lower_pairs import HINGE, SLIDE, hinge_motion
from rbjax.lanes import Lane, Vec3, add, matmat, mul, total
from rbjax.model import WORLD, Model, prepare
from rbjax.model.cells import constant_leaves
from rbjax.model.leaves import table
from rbjax.model.links import lane, without_constants
from rbjax.spatial import ArticulatedInertia, Force, Motion, Transform

#: a function of two arrays that returns both
Correction = Callable[[Any, Any], tuple[Any, Any]]
#: MuJoCo's least weight of a body that moves
LEAST = 1e-15


def inverse_weights(
    model: Model, dtype: Any = None, correct: Correction | None = None
) -> tuple[Any, Any]:
    """Compute MuJoCo's body_invweight0 (nb, 2) and dof_invweight0 (nv,).

    body[:, 0] is the mean of diag(J M^-1 J^T) of the three translations of the centre of mass,
    1/kg, and body[:, 1] of the three rotations, 1/(kg m^2). dof is diag(M^-1), with the mean over
    the three translations of a free joint and over the three rotations of a free joint or ball.
    Bodies that only slide along their axes have 1 / mass. Both are NumPy arrays if the model is
    constant while tracing.

    Args:
        model: the robot.
        dtype: the dtype of traced results; the one of the model if None.
        correct: applied to the weights of bodies (nb, 2) and to diag(M^-1), for inertia that is
            not in the links.
    """
    dtype = model.gravity.dtype if dtype is None else dtype
    if model.execution.weights is not None:
        return model.execution.weights[:2]
    if model.topology.frames:
        return _of_flexible(model, dtype)
    traced = [isinstance(x, jax.core.Tracer) for x in constant_leaves(model).values()]
    constant = not any(traced)
    if constant:
        model = without_constants(model)
        d: Driver = Unrolled(model, prepare(model, dtype))
    else:  # a short program, which runs once
        d = Rolled(model, prepare(model, dtype))
    response, diagonal = d.unzip(_responses(d, _joints(d, model, dtype)), 2)
    if not model.nv:
        return np.zeros((model.nb, 2)), np.zeros(0)
    if constant and not isinstance(model.bodies.com, jax.core.Tracer):
        found = np.zeros((model.nb, 2))
        found[_moving(model)] = np.array(_of_bodies(d, model, response, dtype)).reshape(-1, 2)
        diagonal = np.array(diagonal)
        if correct is not None:
            with jax.ensure_compile_time_eval():
                found, diagonal = (np.asarray(x, np.float64) for x in correct(found, diagonal))
        return _with_slides(model, found, _averaged(model, diagonal))
    like = jnp.zeros((), dtype)
    dof = d.pack(diagonal, jnp.zeros(model.nv, dtype))
    weights = d.stack(_of_bodies(d, model, response, dtype), lambda pair: pair, like)
    body = jnp.zeros((model.nb, 2), dtype).at[np.array(_moving(model))].set(weights)
    body, dof = (body, dof) if correct is None else correct(body, dof)
    return _with_slides(model, body, _averaged(model, dof))


def _of_flexible(model: Model, dtype: Any) -> tuple[jax.Array, jax.Array]:
    """Compute the inverse weights of a tree with flexible links from M^-1 and Jacobians."""
    q = model.joints.reference.astype(dtype)
    inverse = inverse_mass_matrix(model, q)
    body = [jnp.zeros(2, dtype)] * model.nb
    for b in _moving(model):
        J = jacobian(model, q, model.body_names[b], model.bodies.com[b].astype(dtype))
        diagonal = (J * matmat(J, inverse)).sum(-1)
        body[b] = jnp.stack([diagonal[3:].mean(), diagonal[:3].mean()])
    return jnp.stack(body), _averaged(model, jnp.diagonal(inverse))


def _joints(d: Driver, model: Model, dtype: Any) -> Any:
    """Return the motions of the joints in the reference configuration, per link.
    The `Unrolled` driver gets literals, with zero displacement of hinges and slides."""
    reference = table(model.joints.reference, dtype)
    if not isinstance(d, Unrolled):
        return d.joints(jnp.asarray(reference, dtype), None)
    out = []
    for i, dof in enumerate(model.topology.dofs):
        at = [lane(reference, k) for k in dof.q]
        out.append(_motion(dof, d.constants[i], at))
    return out


def _motion(dof: Any, link: Any, at: list[Lane]) -> JointMotion:
    """Return the motion of one joint dof in the reference configuration, at zero velocity."""
    rest = [0.0] * len(dof.v)
    if dof.spec.from_reference and dof.kind is HINGE:
        return hinge_motion(1.0, 0.0, 0.0)
    if dof.spec.from_reference and dof.kind is SLIDE:
        return SLIDE.motion([link.reference], rest, link)
    if any(isinstance(x, jax.core.Tracer) for x in (*at, *jax.tree.leaves(link.params))):
        return dof.kind.motion(at, rest, link)
    with jax.ensure_compile_time_eval():
        motion = dof.kind.motion(at, rest, link)
    return jax.tree.map(lambda x: x if isinstance(x, jax.core.Tracer) else float(x), motion)


def _responses(d: Driver, joints: Any) -> Any:
    """Return, for each link, its response J M^-1 J^T to wrenches, and the diagonal entry of M^-1.
    The response is an `ArticulatedInertia` whose J is the block of translations."""
    factors = factorize(d, joints)

    def outward(factor, parent):
        X, S = factor.X, factor.S
        moved = parent.shifted(-X.p).rotated(X.E)
        K = factor.U * factor.inverse_D
        both = moved(Motion(K.lin, K.ang))
        Y = Motion(both.lin, both.ang)
        diagonal = add(K.dot(Y), factor.inverse_D)
        Z = Y - S * mul(0.5, diagonal)
        a, b = Force(S.lin, S.ang), Force(Z.lin, Z.ang)
        own = moved - ArticulatedInertia.outer(a, b) - ArticulatedInertia.outer(b, a)
        return own, (own, diagonal)

    return d.outward(outward, ArticulatedInertia.zero(), factors)


def _moving(model: Model) -> list[int]:
    """Return the indices of the bodies that are not welded to the world."""
    return [b for b, link in enumerate(model.topology.body_links) if link != WORLD]


def _of_bodies(d: Driver, model: Model, response: Any, dtype: Any) -> Any:
    """Compute the inverse weights (translation, rotation) of all bodies that move."""
    moving, com = _moving(model), table(model.bodies.com, dtype)
    links = [model.topology.body_links[b] for b in moving]
    if d.listed:
        welds: Any = [d.prepared.weld(b) for b in moving]
        centres: Any = [Vec3(*(lane(com[:, k], b) for k in range(3))) for b in moving]
    else:
        at = np.array(moving)
        welds = jax.tree.map(lambda x: jnp.asarray(x[at], dtype), d.prepared.welds)
        centres = Vec3(*(jnp.asarray(com[at, k], dtype) for k in range(3)))
    return d.each(_weights, d.take(d.whole(response), links), welds, centres)


def _weights(response: ArticulatedInertia, weld: Transform, centre: Vec3) -> tuple[Lane, Lane]:
    """Return the inverse weights of a body: the mean translational response of its centre of mass
    to forces, and the mean rotational response to moments."""
    J = response.shifted(-(weld.p + weld.R @ centre)).J
    return mul(1 / 3, total(list(J)[:3])), mul(1 / 3, total(list(response.M)[:3]))


def _with_slides(model: Model, body: Any, dof: Any) -> tuple[Any, Any]:
    """Replace the inverse weights of bodies that only translate along slides, and of their dofs."""
    slides = () if model.solver is None else model.solver.translating
    if not slides:
        return body, dof
    xp = np if isinstance(body, np.ndarray) else jnp
    mass = xp.asarray(model.bodies.mass, body.dtype)
    owners = np.array([x.body for x in model.topology.dofs])
    point = xp.stack([1 / mass, xp.zeros_like(mass)], -1)
    which = np.isin(np.arange(model.nb), slides)[:, None]
    own = np.isin(owners, slides)
    return xp.where(which, point, body), xp.where(own, 1 / mass[owners], dof)


def _averaged(model: Model, diagonal: Any) -> Any:
    """Replace the entries of the three translations, or the three rotations, of a joint by their
    mean."""
    top, rows = model.topology, np.arange(model.nv).repeat(3).reshape(-1, 3)
    for joint, start in zip(top.joints, top.joint_v, strict=True):
        for first in range(start, start + joint.nv, 3) if joint.quaternion else ():
            rows[first : first + 3] = np.arange(first, first + 3)
    single = rows[:, 0] == rows[:, 2]
    xp = np if isinstance(diagonal, np.ndarray) else jnp
    return xp.where(single, diagonal, diagonal[rows].sum(1) / 3)
