"""Inverse inertias of tendons, J M^-1 J^T in the configuration in which the file draws the robot.

They scale the regularization of the rows of a tendon (MuJoCo's tendon_invweight0; MuJoCo,
*Computation*, constraint model).
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics import inverse_mass_matrix
from rbjax.dynamics.inverse_weights import inverse_weights
from rbjax.dynamics.tracing.custom_rules import is_traced
from rbjax.forces.context import Context
from rbjax.forces.tendons.paths import tendon_jacobian, tendon_reach
from rbjax.lanes import Lane, Vec3, add, mul
from rbjax.model import Model, State, without_constants
from rbjax.model.leaves import table
from rbjax.model.links import lane


def has_tendon_rows(model: Model) -> bool:
    """Check whether a tendon of a model has limits, friction loss or armature."""
    own = model.tendons
    return own is not None and bool(own.limited or own.rubbing or own.inertial)


def tendon_weights(model: Model, *, every: bool = False) -> Any:
    """Compute the inverse inertias (nt,) of tendons; (0,) if no tendon has limits or friction loss,
    unless `every` is True.

    They are a function of the model's leaves: masses, lengths and geoms change them as mj_setConst
    does. They are a NumPy array if the model is constant while tracing.
    """
    if model.execution.weights is not None and not every:
        return model.execution.weights[2]
    if not has_tendon_rows(model) and not every:
        return np.zeros(0)
    model = without_constants(model)
    if is_traced(model):
        return _weights(model)
    with jax.ensure_compile_time_eval():
        return np.asarray(_weights(model), np.float64)


def armature_updates(model: Model) -> list[tuple[jax.Array, jax.Array]]:
    """Return pairs (c, u) of the armatures of tendons, in the reference configuration:
    (M + J^T m J)^-1 = M^-1 - sum of c u u^T (Sherman & Morrison 1950)."""
    return _updated(model)[1]


def armature_entries(model: Model, q: jax.Array) -> dict[tuple[int, int], Lane]:
    """Compute the entries of J^T m J, the inertia of the armatures of tendons, at q."""
    out: dict[tuple[int, int], Lane] = {}
    own = model.tendons
    if own is None or not own.inertial:
        return out
    context = Context.of(model, 0.0, State(q, jnp.zeros(model.nv, q.dtype)), None)
    for k in own.inertial:
        m, arms = lane(table(own.armature, q.dtype), k), tendon_reach(context, k).arms
        for i, x in arms.items():
            for j, y in arms.items():
                out[i, j] = add(out.get((i, j), 0.0), mul(m, mul(x, y)))
    return out


def _updated(model: Model) -> tuple[jax.Array, list[tuple[jax.Array, jax.Array]]]:
    """Return the inverse inertias (nv, nv) with tendons, and the updates."""
    q, own = model.joints.reference, model.tendons
    assert own is not None
    J, inverse, out = tendon_jacobian(model, q), inverse_mass_matrix(model, q), []
    for i in own.inertial:
        u = (inverse * J[i]).sum(-1)
        c = own.armature[i] / (1 + own.armature[i] * (J[i] * u).sum())
        inverse = inverse - c * u[:, None] * u
        out.append((c, u))
    return inverse, out


def _weights(model: Model) -> jax.Array:
    return row_weights(tendon_jacobian(model, model.joints.reference), _updated(model)[0])


def row_weights(J: jax.Array, inverse: jax.Array) -> jax.Array:
    """Compute diag(J M^-1 J^T) (n,) of rows J (n, nv) from the inverse mass matrix (nv, nv)."""
    return (J[:, :, None] * inverse * J[:, None, :]).sum((1, 2)) if J.size else jnp.zeros(len(J))


def weights_with_tendons(model: Model, dtype: Any = None) -> tuple[Any, Any]:
    """Compute the inverse inertias of bodies (nb, 2) and dofs (nv,) with the armature of tendons.
    Arguments are those of `inverse_weights`."""
    own = model.tendons
    if own is None or not own.inertial:
        return inverse_weights(model, dtype)
    return inverse_weights(model, dtype, functools.partial(_with_armature, model))


def _with_armature(model: Model, body: Any, dof: Any) -> tuple[Any, Any]:
    """Subtract from the weights of bodies (nb, 2) and dofs (nv,) the effect of tendon armatures."""
    model = without_constants(model)
    for c, u in armature_updates(model):
        context = Context.of(model, 0.0, State(model.joints.reference, u), None)
        rows = []
        for b in range(model.nb):
            frame = context.body(b)
            w = frame.angular_velocity
            com = table(model.bodies.com, u.dtype)
            v = frame.velocity + w.cross(frame.pose.R @ Vec3(*(com[b, k] for k in range(3))))
            rows.append(jnp.stack([jnp.asarray(x.dot(x), u.dtype) for x in (v, w)]))
        body = body - c * jnp.stack(rows) / 3
        dof = dof - c * u * u
    return body, dof
