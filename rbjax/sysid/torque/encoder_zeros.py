"""Estimation of encoder zeros in each recording, together with the parameters.

    min over pi, z_1, ..., z_R  of  sum over recordings  |tau - W(z_r) pi|^2 / s^2 + |z_r|^2 / w^2

Incremental encoders have a different zero in each recording. Dry friction holds an arm anywhere
within F / (m g r) of the vertical, a few hundredths of a radian. The resulting error of the gravity
torque biases friction and inertias. w is the standard deviation of the zeros. This prior is
necessary, since a common zero of all recordings is equivalent to a shifted center of mass or a
tilted base. Each step is a linear regression on pi and the changes of all z (Gauss-Newton), so the
intervals of pi include the uncertainty of the zeros. A zero of 0.1 rad has a second-order error of
5 mrad; a new call of `torque_rows` at the estimated zeros reduces it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.arguments import integer, real_array, real_number
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.status import HasStatus, Status
from rbjax.sysid.arguments import positive_numbers
from rbjax.sysid.torque.regression import regress
from rbjax.sysid.torque.rows import TorqueRows
from rbjax.sysid.torque.torque_equations import Regression

Array = np.ndarray
DONE = 1e-9  # a smaller change of the zeros in rad or m ends the iteration
LEAST = 3  # least number of steps; in the first step zero parameters hide the encoder zeros


@displayed
@dataclass(frozen=True, eq=False)
class WithZeros(HasStatus):
    """The result of `regress_with_zeros`.

    Fields:
        regression: the last linear regression, for the parameters and the changes of the zeros.
        parameters: (p,) estimates, equal to the prior in unidentifiable directions.
        zeros: name of the recording -> (nv,) zeros in rad or m.
        noise: (nv,) standard deviation of the torques.
        squares: weighted sum of squares of the torque residuals.
        steps: number of linear regressions.
        status: a `Status`.
    """

    regression: Regression
    parameters: Array
    zeros: dict[str, Array]
    noise: Array
    squares: float
    steps: int
    status: Status


def regress_with_zeros(
    rows: Sequence[TorqueRows],
    *,
    prior: Any = None,
    spread: float = 0.05,
    noise: Any = None,
    max_steps: int = 30,
) -> WithZeros:
    """Fit base parameters, and the encoder zeros of each recording, to torques.

    Args:
        rows: equations of each recording.
        prior: (p,) parameters in unidentifiable directions. None: 0.
        spread: w, the standard deviation of the zeros in rad or m.
        noise: standard deviation of the torques, one number or (nv,). None: estimate it from the
            residuals.
        max_steps: largest number of linear regressions.

    Returns:
        `WithZeros`.

    Raises:
        InputError: recordings with different columns or equal names, or a spread that is not
            positive.

    Source: Seber & Wild, *Nonlinear Regression*, 2.1 (Gauss-Newton).

    Example:
        >>> import numpy as np, rbjax as rb
        >>> from rbjax.sysid import Channel, Recording
        >>> from rbjax.sysid.torque import regress_with_zeros, torque_rows
        >>> model, t = rb.load("pendulum"), np.arange(0.0, 4.0, 0.002)
        >>> q, a = np.sin(3 * t)[:, None], -9 * np.sin(3 * t)[:, None]
        >>> W = rb.sysid.torque.regressor(model, q, 3 * np.cos(3 * t)[:, None], a)
        >>> tau = np.asarray(W @ rb.inertial_parameters(model))
        >>> run = Recording("swing", {"q": Channel(t, q - 0.03), "tau": Channel(t, tau)})
        >>> rows = torque_rows(model, run, 5.0).only(["rod.hz", "rod.Iyy"])  # no offset centre
        >>> found = regress_with_zeros([rows], noise=1e-4)
        >>> round(float(found.zeros["swing"][0]), 2)
        0.03
    """
    where = "regress_with_zeros"
    rows = _checked(where, rows)
    real_number(where, "spread", spread, "a positive angle or length", above=0.0)
    integer(where, "max_steps", max_steps, least=1)
    names, tau = rows[0].names, np.concatenate([r.tau for r in rows])
    p, (N, k) = len(names), tau.shape
    changes = [f"{r.name}.zero[{i}]" for r in rows for i in range(k)]
    prior = np.zeros(p) if prior is None else _parameters(where, "prior", prior, p)
    if noise is not None:
        noise = positive_numbers(where, "noise", noise, k, "torque")
    zeros = np.stack([r.zeros for r in rows])
    lengths = [*(len(r.t) for r in rows), *(1 for _ in rows)]
    parameters, base, sd = prior, None, np.full(k, tau.std()) if noise is None else noise
    step, moved = 0, np.inf
    while step < max_steps and (step < LEAST or moved > DONE):
        step += 1
        W, y = _augmented(rows, zeros, parameters)
        each = np.concatenate([np.broadcast_to(sd, (N, k)), np.full((len(rows), k), spread)])
        found = regress(
            W, np.concatenate([tau, y]), [*names, *changes], noise=each, base=base, lengths=lengths
        )
        base = found.combinations
        whole = found.parameters(np.concatenate([prior, np.zeros(len(changes))]))
        parameters, change = whole[:p], whole[p:].reshape(zeros.shape)
        zeros, moved = zeros + change, float(np.abs(change).max())
        off = np.concatenate([r.residual(parameters, z) for r, z in zip(rows, zeros, strict=True)])
        if noise is None:
            sd = np.sqrt((off**2).sum(0) * k / (N * k - found.beta.size))
    by_name = {r.name: z for r, z in zip(rows, zeros, strict=True)}
    squares = float(((off / sd) ** 2).sum())
    done = step >= LEAST and moved <= DONE
    return WithZeros(found, parameters, by_name, sd, squares, step, Status.of(done))


def _augmented(rows: Sequence[TorqueRows], zeros: Array, parameters: Array) -> tuple[Array, Array]:
    """Assemble linear equations for the parameters and the changes of all zeros.

    Return the matrix, whose last rows are the prior of the zeros, and the right side of these rows.
    """
    blocks, (runs, k) = [], zeros.shape
    for i, (r, z) in enumerate(zip(rows, zeros, strict=True)):
        moved = np.zeros((*r.tau.shape, runs, k))
        moved[:, :, i] = np.einsum("nkpz,p->nkz", r.slopes, parameters)
        blocks.append(np.concatenate([r.at(z), moved.reshape(*r.tau.shape, -1)], 2))
    priors = np.zeros((runs, k, blocks[0].shape[2]))
    priors[:, :, -runs * k :] = np.eye(runs * k).reshape(runs, k, -1)
    return np.concatenate([*blocks, priors]), -zeros


def _parameters(where: str, name: str, given: Any, p: int) -> Array:
    x = real_array(where, name, given)
    if x.shape != (p,):
        raise InputError(f"{where}: {name} has shape {x.shape}, expected ({p},)")
    return x


def _checked(where: str, given: Any) -> list[TorqueRows]:
    rows = list(given) if isinstance(given, (list, tuple)) else [given]
    if not rows or not all(isinstance(r, TorqueRows) for r in rows):
        raise InputError(
            f"{where}: rows is {[type(r).__name__ for r in rows]}, expected the `TorqueRows` of at "
            "least one recording"
        )
    names = [r.name for r in rows]
    if len(set(names)) < len(names) or any(r.names != rows[0].names for r in rows):
        raise InputError(
            f"{where}: the recordings are {names}, expected different names, and the same columns "
            "in all: make all rows with the same joint_terms"
        )
    return rows
