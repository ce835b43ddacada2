"""rbjax in the comparison: the quantities of `reference`, the motion and its gradient."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics import (
    bias_forces,
    body_velocities,
    forward_dynamics,
    forward_kinematics,
    mass_matrix,
)
from rbjax.forces import applied_forces
from rbjax.model import Model, State
from rbjax.model.record import cast_floats
from rbjax.motion.rollout import rollout
from rbjax.validation.reference import Array, StateSamples


def quantities(model: Model, samples: StateSamples, dtype: Any) -> dict[str, Array]:
    """Compute poses, velocities, M, bias forces and accelerations in a dtype, one row per state.
    The model is a compile-time constant, so its zeros are structural."""

    def one(q: jax.Array, v: jax.Array, ctrl: jax.Array) -> dict[str, jax.Array]:
        R, p = forward_kinematics(model, q)
        tau = applied_forces(model, State(q, v), ctrl)
        return {
            "poses": jnp.concatenate([R.reshape(-1, 9), p], -1),
            "velocities": body_velocities(model, q, v),
            "mass matrix": mass_matrix(model, q),
            "bias forces": bias_forces(model, q, v),
            "forward dynamics": forward_dynamics(model, q, v, tau),
        }

    model, q, v, ctrl = cast_floats((model, samples.q, samples.v, samples.ctrl), dtype)
    out = jax.jit(jax.vmap(one), compiler_options=quick())(q, v, ctrl)
    return {name: np.asarray(x, np.float64) for name, x in out.items()}


def motion(
    model: Model, samples: StateSamples, dt: float, steps: int, weights: Array | None, dtype: Any
) -> dict[str, Array]:
    """Compute one step, the final state (N, nq + nv) of a trajectory, and its gradient (N, nv +
    nu). The gradient, d(weights . final state) / d(v0, ctrl), is omitted if `weights` is None."""

    def ends(v: jax.Array, ctrl: jax.Array, q: jax.Array) -> Any:
        ctrls = jnp.broadcast_to(ctrl[:, None], (len(q), steps, model.nu))
        path = rollout(model, State(q, v), ctrls, dt)
        states = jnp.concatenate([path.q, path.v], -1)
        return states[:, 1], states[:, -1]

    def loss(*args: Any) -> Any:
        first, last = ends(*args)
        return (last @ jnp.asarray(weights, dtype)).sum(), (first, last)

    model, q, v, ctrl = cast_floats((model, samples.q, samples.v, samples.ctrl), dtype)
    out: dict[str, Any] = {}
    if weights is None:
        first, last = jax.jit(ends, compiler_options=quick())(v, ctrl, q)
    else:
        slope = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
        run = jax.jit(slope, compiler_options=quick())
        (_, (first, last)), grads = run(v, ctrl, q)
        out["gradient"] = np.concatenate([np.asarray(g) for g in grads], -1)
    out |= {"one step": first, "trajectory": last}
    return {name: np.asarray(x, np.float64) for name, x in out.items()}


def quick() -> dict[str, Any]:
    """Return compiler options that minimise compile time, for programs that run once."""
    return {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else {}
