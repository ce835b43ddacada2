"""Inverse inertias of tendons, J M^-1 J^T in the configuration in which the file draws the robot.

They scale the regularization of the rows of a tendon (MuJoCo's tendon_invweight0; MuJoCo,
*Computation*, constraint model).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics import inverse_mass_matrix
from rbjax.dynamics.tracing.custom_rules import is_traced
from rbjax.forces.tendons.lengths import tendon_jacobian
from rbjax.model import Model, without_constants


def has_tendon_rows(model: Model) -> bool:
    """Check whether a tendon of a model has limits or friction loss."""
    own = model.tendons
    return own is not None and bool(own.limited or own.rubbing)


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


def _weights(model: Model) -> jax.Array:
    q = model.joints.reference
    J, inverse = tendon_jacobian(model, q), inverse_mass_matrix(model, q)
    return (J[:, :, None] * inverse * J[:, None, :]).sum((1, 2)) if J.size else jnp.zeros(len(J))
