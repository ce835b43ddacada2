"""Where the zero of an encoder is, in each recording: found with the parameters.

    min over pi, z_1, ..., z_R  of  sum over recordings  |tau - W(z_r) pi|^2 / s^2 + |z_r|^2 / w^2

Encoders that count from where they stood when they were switched on have another zero in each
recording: dry friction holds an arm anywhere within F / (m g r) of the vertical, a few hundredths
of a radian. The torque of gravity that this makes is an error of constant sign, which spoils the
friction and the inertias. w says how far zeros may be off; it decides where the data cannot: a zero
that all recordings share looks like a centre of mass off the link, or like a tilted base. Each step
is a linear regression on pi and the change of all z (Gauss-Newton), so the intervals of pi know
that the zeros were found too. Zeros of 0.1 rad are right to second order, 5 mrad; rows that are
made again at these zeros (`torque_rows`) do better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.arguments import integer
from rbjax.errors import InputError
from rbjax.sysid.torque.regression import Regression, regress
from rbjax.sysid.torque.rows import TorqueRows

Array = np.ndarray
DONE = 1e-9  # rad or m that zeros still move
LEAST = 3  # steps; in the first one the parameters may be 0, so zeros have no effect


@dataclass(frozen=True, eq=False)
class WithZeros:
    """A regression and the zeros of each recording.

    Fields: regression, of the parameters and of the last changes of the zeros, its residual that of
    the data and the zeros; parameters (p,), those of the prior where the data say nothing; zeros,
    name of the recording -> (nv,) rad or m; noise (nv,) standard deviation of the torques; squares,
    the weighted sum of squares of the data; steps; success, whether it converged.
    """

    regression: Regression
    parameters: Array
    zeros: dict[str, Array]
    noise: Array
    squares: float
    steps: int
    success: bool


def regress_with_zeros(
    rows: Sequence[TorqueRows],
    *,
    prior: Any = None,
    spread: float = 0.05,
    noise: Any = None,
    max_steps: int = 30,
) -> WithZeros:
    """Base parameters and the zeros of the encoders of each recording, together.

    Args:
        rows: the equations of each recording.
        prior: (p,) parameters that stay where the data say nothing; 0 if None.
        spread: w in rad or m, the standard deviation of zeros.
        noise: standard deviation of the torques, a number or (nv,); that of the residuals if None.
        max_steps: linear regressions.

    Returns:
        `WithZeros`.

    Raises:
        InputError: recordings with other columns, or the same name; a spread that is not positive.

    Source: Seber & Wild, *Nonlinear Regression*, 2.1 (Gauss-Newton).

    Example:
        >>> import numpy as np, rbjax as rb
        >>> from rbjax.sysid import Channel, Recording
        >>> from rbjax.sysid.torque import regress_with_zeros, torque_rows
        >>> model, t = rb.load("pendulum"), np.arange(0.0, 4.0, 0.002)
        >>> q, a = np.sin(3 * t)[:, None], -9 * np.sin(3 * t)[:, None]
        >>> W = rb.sysid.torque.observation_matrix(model, q, 3 * np.cos(3 * t)[:, None], a)
        >>> tau = np.asarray(W @ rb.inertial_parameters(model))
        >>> run = Recording("swing", {"q": Channel(t, q - 0.03), "tau": Channel(t, tau)})
        >>> rows = torque_rows(model, run, 5.0).only(["rod.hz", "rod.Iyy"])  # no offset centre
        >>> found = regress_with_zeros([rows], noise=1e-4)
        >>> round(float(found.zeros["swing"][0]), 2)
        0.03
    """
    where = "regress_with_zeros"
    rows = _checked(where, rows)
    _check_spread(where, spread)
    integer(where, "max_steps", max_steps, least=1)
    names, tau = rows[0].names, np.concatenate([r.tau for r in rows])
    p, (N, k) = len(names), tau.shape
    changes = [f"{r.name}.zero[{i}]" for r in rows for i in range(k)]
    prior = np.zeros(p) if prior is None else _numbers(where, "prior", prior, (p,))
    if noise is not None:
        noise = _noise(where, noise, k)
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
    sd = np.broadcast_to(np.asarray(sd, float), (k,))
    squares = float(((off / sd) ** 2).sum())
    done = step >= LEAST and moved <= DONE
    return WithZeros(found, parameters, by_name, sd, squares, step, done)


def _augmented(rows: Sequence[TorqueRows], zeros: Array, parameters: Array) -> tuple[Array, Array]:
    """Columns of the parameters and of the changes of all zeros, with a row a recording that pulls
    its zeros to 0; and the right side of these rows."""
    blocks, (runs, k) = [], zeros.shape
    for i, (r, z) in enumerate(zip(rows, zeros, strict=True)):
        moved = np.zeros((*r.tau.shape, runs, k))
        moved[:, :, i] = np.einsum("nkpz,p->nkz", r.slopes, parameters)
        blocks.append(np.concatenate([r.at(z), moved.reshape(*r.tau.shape, -1)], 2))
    pulls = np.zeros((runs, k, blocks[0].shape[2]))
    pulls[:, :, -runs * k :] = np.eye(runs * k).reshape(runs, k, -1)
    return np.concatenate([*blocks, pulls]), -zeros


def zeros_of(rows: TorqueRows, parameters: Any, *, noise: Any = 1.0, spread: float = 0.05) -> Array:
    """The zeros (nv,) of one recording, for given parameters: of one that was not fitted.

    z = argmin |(tau - W(z) pi) / s|^2 + |z|^2 / w^2, which is linear.

    Args:
        rows: its equations, or those of its first seconds.
        parameters: (p,).
        noise: s, standard deviation of the torques, a number or (nv,).
        spread: w in rad or m.

    Returns:
        (nv,) rad or m.

    Example:
        >>> import numpy as np, rbjax as rb
        >>> from rbjax.sysid import Channel, Recording
        >>> from rbjax.sysid.torque import torque_rows, zeros_of
        >>> model, t = rb.load("pendulum"), np.arange(0.0, 4.0, 0.002)
        >>> still = Recording("still", {"q": Channel(t, 0 * t), "tau": Channel(t, 0 * t)})
        >>> zeros_of(torque_rows(model, still, 5.0), rb.inertial_parameters(model)).tolist()
        [0.0]
    """
    where = "zeros_of"
    (rows,) = _checked(where, [rows])
    _check_spread(where, spread)
    parameters = _numbers(where, "parameters", parameters, (len(rows.names),))
    sd = np.broadcast_to(_noise(where, noise, rows.tau.shape[1]), rows.tau.shape[1:])
    J = np.einsum("nkpz,p->nkz", rows.slopes, parameters) / sd[:, None]
    off = rows.residual(parameters) / sd
    n = J.shape[-1]
    J = np.concatenate([J.reshape(-1, n), np.eye(n) / spread])
    off = np.concatenate([off.ravel(), -rows.zeros / spread])
    return rows.zeros + np.linalg.lstsq(J, off, rcond=None)[0]


def _check_spread(where: str, spread: Any) -> None:
    if not isinstance(spread, (int, float, np.number)) or not 0 < spread < np.inf:
        raise InputError(f"{where}: spread is {spread!r}, expected a positive angle or length")


def _noise(where: str, noise: Any, k: int) -> Array:
    x = _numbers(where, "noise", noise, (), (k,))
    if not (x > 0).all():
        raise InputError(f"{where}: noise is {x.tolist()}, expected standard deviations above 0")
    return x


def _numbers(where: str, name: str, x: Any, *shapes: tuple[int, ...]) -> Array:
    try:
        x = np.asarray(x, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {name} is {type(x).__name__}, expected numbers") from error
    if x.shape not in shapes or not np.isfinite(x).all():
        raise InputError(
            f"{where}: {name} has shape {x.shape}, expected {' or '.join(map(str, shapes))}, finite"
        )
    return x


def _checked(where: str, rows: Sequence[TorqueRows]) -> list[TorqueRows]:
    given: Any = rows
    several = isinstance(given, (list, tuple))
    rows = list(given) if several else [given]  # a wrong one is named below
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
