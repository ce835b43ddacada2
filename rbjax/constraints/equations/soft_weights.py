"""Inverse inertias of the rows of soft constraints, as functions of the masses of a model.

    pair of two bodies     the sum of the inverse inertias of both bodies, of translation, rotation
    coupling of joints     the sum of the inverse inertias of both dofs
    coupling of tendons    the sum of the inverse inertias of both tendons
    others                 diag(G M^-1 G^T) at `Soft.at`, or at the configuration of the file
The first three are MuJoCo's estimates (*Computation*, constraint model).
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from rbjax.constraints.equations.model_rows import jacobian
from rbjax.constraints.rows.couplings import JointPolynomial
from rbjax.constraints.rows.pairs import Pair
from rbjax.constraints.rows.soft import Soft
from rbjax.constraints.rows.tendons import TendonPolynomial
from rbjax.dynamics import inverse_mass_matrix
from rbjax.dynamics.tracing.custom_rules import is_traced
from rbjax.forces.place import Place
from rbjax.forces.tendons.tendon_weights import row_weights, tendon_weights, weights_with_tendons
from rbjax.model import Model, without_constants


def with_weights(model: Model, dtype: Any = None) -> Model:
    """Precompute the inverse inertias of bodies, dofs, tendons and soft constraints and store them
    in the model, for all steps of a motion."""
    found = (*weights_with_tendons(model, dtype), tendon_weights(model), soft_weights(model))
    return model.replace(weights=found)


def soft_weights(model: Model) -> tuple[Any, ...]:
    """Compute the inverse inertias (rows,) of each constraint of a model; None for a rigid one.
    They are NumPy arrays if the model is constant while tracing."""
    if model.execution.weights is not None:
        return model.execution.weights[3]
    return tuple(_weights(model, x) if isinstance(x, Soft) else None for x in model.constraints)


def _weights(model: Model, soft: Soft) -> Any:
    if soft.weight is not None:
        return soft.weight
    one = soft.of
    if soft.at is None and isinstance(one, JointPolynomial):
        _, dof = weights_with_tendons(model)
        top = model.topology
        return _sum(dof, [top.joint_v[model.joint(x)] for x in (one.joint, one.driver)
                          if x is not None])  # fmt: skip
    if soft.at is None and isinstance(one, TendonPolynomial):
        ends = [model.tendon(x) for x in (one.tendon, one.driver) if x is not None]
        return _sum(tendon_weights(model, every=True), ends)
    if soft.at is None and isinstance(one, Pair):
        body, _ = weights_with_tendons(model)
        bodies = [_body(model, x) for x in (one.a, one.b)]
        both = body[np.array([x for x in bodies if x is not None], int)].sum(0)
        return both[np.array([0] * 3 + [1] * (one.size - 3))[: one.size]]
    model = without_constants(model)
    if is_traced((model, soft)):
        return _exact(model, soft)
    with jax.ensure_compile_time_eval():
        return np.asarray(_exact(model, soft))


def _sum(x: Any, index: list[int]) -> Any:
    return x[np.array(index)].sum(keepdims=True)


def _body(model: Model, place: Place) -> int | None:
    """Return the body of a place; None for the world."""
    if place.site is not None:
        found: int | None = model.topology.site_bodies[model.site(place.site)]
    else:
        found = None if place.body is None else model.body(place.body)
    return found if found is not None and found >= 0 else None


def _exact(model: Model, soft: Soft) -> jax.Array:
    """Compute diag(G M^-1 G^T)."""
    q = model.joints.reference if soft.at is None else soft.at
    G = jacobian(model.replace(constraints=(soft.of,)), q)
    return row_weights(G, inverse_mass_matrix(model, q))
