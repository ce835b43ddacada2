"""Linear systems: controllability, observability, poles, discretisation.

    continuous  dx/dt = A x + B u,   y = C x         discrete  x+ = A x + B u

The reachable space is the range of [B, AB, ..., A^(n-1) B]. The staircase algorithm builds an
orthonormal basis: V_1 of B, then V_(j+1) of the part of A V_j orthogonal to all previous vectors. A
state is unobservable if it is uncontrollable for (A', C'). Source: Van Dooren, IEEE TAC 26, 1981;
Åström & Wittenmark, *Computer-Controlled Systems*, 3; Zhou, Doyle & Glover, 3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiled
from rbjax.control.linear.arguments import check_matrices
from rbjax.control.products import product
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_model, check_step
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_not_negative
from rbjax.model import Model

LEAST = 0.05  # least entry of a direction that is described, relative to its largest one


@displayed
class Reach(NamedTuple):
    """A controllable or observable subspace of states.

    rank: its dimension, ().
    inside: orthogonal projector onto it, (n, n).
    outside: orthonormal basis of its complement in the first n - rank columns, zeros after, (n, n).
    weakest: smallest singular value of the staircase form above the tolerance, (). A and the
        columns of B are scaled to norm 1. It approximates the distance to a system of lower rank.
    """

    rank: jax.Array
    inside: jax.Array
    outside: jax.Array
    weakest: jax.Array

    def missing(self, model: Model) -> list[str]:
        """Describe the directions outside of the subspace with the names of a model's joints.

        Each text is such as "1.00 velocity of hinge - 0.31 position of slide". If several
        directions are missing, their basis is reduced so that each has few entries. The subspace
        is of the states dq, dv, dx_e of the model, and not traced.

        Raises:
            InputError: another number of states.
        """
        check_model("missing", model)
        n = 2 * model.nv + model.nx
        if self.inside.shape != (n, n):
            raise InputError(
                f"missing: the subspace has shape {self.inside.shape}, expected {(n, n)}, of the "
                "model's dq, dv and states of force elements"
            )
        names = state_names(model)
        outside = np.asarray(self.outside)[:, : n - int(self.rank)]
        texts = []
        for row in _reduced(outside.T):
            row = row / np.abs(row).max()
            order = [i for i in np.argsort(-np.abs(row), kind="stable") if abs(row[i]) >= LEAST]
            row = row * np.sign(row[order[0]])
            parts = [f"{abs(row[i]):.2f} {names[i]}" for i in order]
            signs = ["" if k == 0 else " + " if row[i] > 0 else " - " for k, i in enumerate(order)]
            texts.append("".join(s + p for s, p in zip(signs, parts, strict=True)))
        return texts


def controllability(A: Any, B: Any, *, tolerance: float | None = None) -> Reach:
    """Compute the controllable subspace of dx/dt = A x + B u or x+ = A x + B u.

    Args:
        A: (n, n).
        B: (n, m).
        tolerance: singular values up to this are zero, relative to the norm of A, and for B to the
            norm of its column; n times the rounding unit times 100 if None.

    Returns:
        `Reach`. The rank is an integer, so it has no derivative. `missing(model)` describes the
        directions outside.

    Raises:
        InputError: shapes, values that are not finite.

    Source: Van Dooren 1981.

    Example:
        >>> from rbjax.control.linear import controllability
        >>> found = controllability([[1.0, 0.0], [0.0, 2.0]], [[0.0], [1.0]])
        >>> int(found.rank), [abs(float(x)) for x in found.outside[:, 0]]
        (1, [1.0, 0.0])
    """
    A, B = check_matrices("controllability", ("A", A, "nn"), ("B", B, "nm"))
    return _reach(A, B, _tolerance("controllability", tolerance))


def observability(A: Any, C: Any, *, tolerance: float | None = None) -> Reach:
    """Compute the observable subspace of readings y = C x; `outside` spans the unobservable states.

    Args:
        A: (n, n).
        C: (l, n).
        tolerance: as in `controllability`.

    Returns:
        `Reach`.

    Raises:
        InputError: shapes, values that are not finite.

    Source: Kalman 1960 (duality).

    Example:
        >>> from rbjax.control.linear import observability
        >>> int(observability([[0.0, 1.0], [0.0, 0.0]], [[0.0, 1.0]]).rank)  # only the speed
        1
    """
    A, C = check_matrices("observability", ("A", A, "nn"), ("C", C, "ln"))
    return _reach(A.T, C.T, _tolerance("observability", tolerance))


def _tolerance(where: str, tolerance: Any) -> Any:
    return None if tolerance is None else check_not_negative(where, "tolerance", tolerance, ())


@compiled
def _reach(A: jax.Array, B: jax.Array, tolerance: float | None) -> Reach:
    n = A.shape[0]
    eps = jnp.finfo(A.dtype).eps
    least = 100 * n * eps if tolerance is None else tolerance
    size = jnp.linalg.norm(A, ord=2) if n > 1 else jnp.abs(A).max()
    size = jnp.where(size > 0, size, 1.0)
    columns = jnp.sqrt((B * B).sum(0))
    V = B / jnp.where(columns > 0, columns, 1.0)  # scale the column of each control to unit length
    one = jnp.eye(n, dtype=A.dtype)

    def turn(carry, _):
        P, new, weakest = carry
        left = new - product(P, new)
        left = left - product(P, left)  # twice: the first pass loses digits
        U, s, _ = jnp.linalg.svd(left, full_matrices=False)
        kept = s > least
        U = jnp.where(kept, U, 0.0)
        weakest = jnp.minimum(weakest, jnp.where(kept, s, jnp.inf).min())
        P = P + product(U, U.T)
        image = product(A, U) / size
        image = jnp.pad(image, ((0, 0), (0, V.shape[1] - U.shape[1])))
        return (P, image, weakest), None

    begin = (jnp.zeros_like(A), V, jnp.asarray(jnp.inf, A.dtype))
    (P, _, weakest), _ = jax.lax.scan(turn, begin, None, length=n)
    rank = jnp.round(jnp.trace(P)).astype(jnp.int32)
    axes = jnp.linalg.eigh((one - P + (one - P).T) / 2)[1][:, ::-1]
    outside = jnp.where(jnp.arange(n) < n - rank, axes, 0.0)
    return Reach(rank, P, outside, jnp.where(rank > 0, weakest, 0.0))


def state_names(model: Model) -> list[str]:
    """Return the names of the tangent coordinates dq, dv, dx_e."""
    each: list[str] = []
    for name in model.joint_names:
        part = model.v_slice(name)
        size = part.stop - part.start
        each += [name] if size == 1 else [f"{name}[{k}]" for k in range(size)]
    elements = [f"state {k} of the force elements" for k in range(model.nx)]
    return [f"{what} of {x}" for what in ("position", "velocity") for x in each] + elements


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Reduce rows to echelon form by elimination with full pivoting, so that each row has few
    entries."""
    rows = rows.copy()
    free = set(range(rows.shape[1]))
    for k in range(len(rows)):
        at = sorted(free)
        i, j = np.unravel_index(np.abs(rows[k:, at]).argmax(), (len(rows) - k, len(at)))
        rows[[k, k + i]] = rows[[k + i, k]]
        pivot = at[j]
        free.discard(pivot)
        rows[k] /= rows[k, pivot]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, pivot] * rows[k]
    return rows


def poles(A: Any, B: Any = None, K: Any = None) -> jax.Array:
    """Compute the eigenvalues (n,) of A or of A - BK, in order of falling real part.

    JAX computes them on CPUs, and on GPUs in some versions. Simple eigenvalues have derivatives.

    Args:
        A: (n, n).
        B: (n, m).
        K: (m, n).

    Returns:
        Complex numbers.

    Raises:
        InputError: shapes, values that are not finite.

    Example:
        >>> from rbjax.control.linear import poles
        >>> [float(x) for x in poles([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[2.0, 3.0]]).real]
        [-1.0, -2.0]
    """
    if (B is None) != (K is None):
        missing = "B" if B is None else "K"
        raise InputError(f"poles: {missing} is None, expected both of B and K, or neither")
    due = ("A", A, "nn"), ("B", B, "nm"), ("K", K, "mn")
    closed, *gains = check_matrices("poles", *due[: 1 if B is None else 3])
    if gains:
        closed = closed - product(*gains)
    found = jnp.linalg.eigvals(closed)
    return found[jnp.argsort(-found.real)]


def discretise(A: Any, B: Any, dt: Any) -> tuple[jax.Array, jax.Array]:
    """Compute the exact discrete system for controls that are constant over a step.

        Ad = exp(A dt),   Bd = integral_0^dt exp(A s) ds B

    Args:
        A: (n, n).
        B: (n, m).
        dt: seconds.

    Returns:
        Ad (n, n) and Bd (n, m).

    Raises:
        InputError: shapes, values that are not finite, a step that is not positive.

    Differentiable in all three.

    Source: Van Loan, IEEE TAC 23(3), 1978.

    Example:
        >>> from rbjax.control.linear import discretise
        >>> Ad, Bd = discretise([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], 0.5)
        >>> [float(x) for x in Bd[:, 0]]
        [0.125, 0.5]
    """
    A, B = check_matrices("discretise", ("A", A, "nn"), ("B", B, "nm"))
    n, m = B.shape
    dt = check_step("discretise", "dt", dt, A.dtype)
    both = jnp.concatenate([jnp.concatenate([A, B], 1), jnp.zeros((m, n + m), A.dtype)])
    with jax.default_matmul_precision("highest"):
        found = jax.scipy.linalg.expm(both * dt)
    return found[:n, :n], found[:n, n:]
