"""A warning about a rollout with values that are not finite, and the step that would be stable."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import RbjaxError
from rbjax.model import Model, State
from rbjax.motion.field import Dynamics
from rbjax.motion.linearise import linearise
from rbjax.motion.trajectory import Trajectory


def warn_if_not_finite(model: Model, path: Trajectory, dt: jax.Array, dynamics: Dynamics) -> None:
    """Warn once of all samples of a rollout that are not finite: how many, the first time, and the
    largest stable step. The trajectory must be known (not traced)."""
    if not path.ok.is_fully_addressable:  # a part is on another process
        return
    ok = np.atleast_1d(np.asarray(path.ok))
    if ok.all():
        return
    batched = path.ok.ndim == 1
    states = [x if batched else x[None] for x in (path.q, path.v, path.x) if x is not None]
    bad = ~np.logical_and.reduce([np.isfinite(np.asarray(x)).all(-1) for x in states])
    at = int(bad.any(0).argmax())
    sample = int(bad[:, at].argmax())
    which = f", sample {sample}" if batched else ""
    count = f"{int((~ok).sum())} of {len(ok)} samples have" if batched else "the motion has"
    given = State(*(x[sample, 0] for x in states))
    warnings.warn(
        f"rollout: {count} values that are not finite, the first at t = "
        f"{float(path.ts[at]):.6g} s{which}; dt is {float(dt):.4g} s. "
        f"{_advice(model, given, float(dt), dynamics)}",
        stacklevel=3,
    )


def _advice(model: Model, state: State, dt: float, dynamics: Dynamics) -> str:
    largest = np.nan
    try:
        ctrl = jnp.zeros(model.nu, state.q.dtype) if model.nu else None
        A = np.asarray(linearise(model, state, ctrl, dynamics=dynamics).A)
        largest = np.abs(np.linalg.eigvals(A)).max(initial=0.0) if np.isfinite(A).all() else np.nan
    except (
        RbjaxError,
        TypeError,
        NotImplementedError,
    ):  # `linearise` does not support the dynamics
        pass
    if not np.isfinite(largest) or largest == 0:
        return "Take a smaller dt; if no step helps, check that rb.mass_matrix is not singular"
    stable = 2 / largest
    found = f"at the start the linearised motion has an eigenvalue s with |s| = {largest:.4g} /s"
    if stable < dt:
        return f"Take dt below {stable:.2g} s: {found}, and explicit steps need dt < 2 / |s|"
    return (
        f"Take a smaller dt: {found}, for which this step is stable, so forces, controls or speeds "
        "later in the motion need a smaller one"
    )
