"""The report of a law's solver over a motion: [number of unconverged steps, largest error].

`State.report` contains it from step to step. A law reports if it has `solver_tolerance`, and
    acceleration_and_error(model, t, state, tau, f_ext)     if it maps forces to accelerations
    solver_error(memory)                                    if it maps forces to velocities
A step has converged if its error is at most the tolerance. An integrator with several evaluations
in a step reports the largest error.
"""

from __future__ import annotations

import warnings
from typing import Any, Protocol, TypeGuard, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np


@runtime_checkable
class ReportsSolver(Protocol):
    """A law whose solver may end before it converges."""

    def solver_tolerance(self, dtype: Any) -> float:
        """Return the largest solver error of a step that counts as converged. dtype: of
        the motion."""
        ...


def reports(dynamics: Any) -> TypeGuard[Any]:
    """Check whether a dynamics reports the errors of its solver."""
    return isinstance(dynamics, ReportsSolver)


def initial_report(dynamics: Any, dtype: Any, batch: tuple[int, ...] = ()) -> jax.Array | None:
    """Return the report (..., 2) before the first step, or None if the dynamics has no solver."""
    return jnp.zeros((*batch, 2), dtype) if reports(dynamics) else None


def with_step(report: jax.Array, error: jax.Array, tolerance: float) -> jax.Array:
    """Add a step to a report: count it if its error is above the tolerance, and keep the largest
    error. The report has no derivative."""
    error = jax.lax.stop_gradient(error).astype(report.dtype)
    failed = ~(error <= tolerance)  # NaN is a failure
    return jnp.stack([report[0] + failed, jnp.maximum(report[1], error)])


def counted(n: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def warn_if_unconverged(where: str, motion: Any, law: Any) -> None:
    """Warn of the steps of an untraced trajectory or state that did not converge."""
    report = motion.report
    if report is None or isinstance(report, jax.core.Tracer) or not report.is_fully_addressable:
        return
    ts = getattr(motion, "ts", None)
    rows = np.asarray(report)
    rows = rows.reshape(-1, 1 if rows.ndim == 1 else rows.shape[-2], 2)
    left = rows[:, -1, 0]
    if not left.any():
        return
    sample = int(left.argmax())
    of_batch = f", {int((left > 0).sum())} of {len(left)} samples" if len(left) > 1 else ""
    first = ""
    if ts is not None and rows.shape[1] > 1:
        at = int((rows[sample, :, 0] > 0).argmax())
        first = f", the first {'of sample ' + str(sample) + ' ' if of_batch else ''}before t = "
        first += f"{float(ts[at]):.6g} s"
    name, steps = type(law).__name__, counted(int(left.sum()), "step")
    warnings.warn(
        f"{where}: the solver of {name} did not converge in {steps}{of_batch}{first}; the largest "
        f"error is {rows[..., 1].max():.2g}, expected at most "
        f"{law.solver_tolerance(rows.dtype):.2g}. The motion has the best solution that was found. "
        f"Take a smaller dt, or {name} with more iterations",
        stacklevel=3,
    )
