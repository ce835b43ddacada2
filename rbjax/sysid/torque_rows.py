"""The linear equations of one recording, both sides behind the same zero-phase filter.

    F[tau] = F[Y(q, v, a)] pi + F[dY/dq pi] z

The torque is linear in pi, so a linear filter F may act on every column and on the torque: what
the filter takes away is taken from both, and friction, whose columns have steps, is not distorted.
Then the equations are thinned out to what the filter leaves. z (nq,) are the zeros of the encoders,
q = q_read + z, and the equations are linearised at those that are given.
Source: Gautier, ICRA 1997 (parallel filtering and decimation).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError, UnknownName
from rbjax.model import Model
from rbjax.sysid.filtering import differentiate, low_pass
from rbjax.sysid.recording import Recording
from rbjax.sysid.regressor import joint_coordinates, observation_matrix, parameter_names

Array = np.ndarray
KEPT = 0.8  # Nyquist's frequency of the thinned equations is the cut-off over this
FILLED = 1000  # samples are filled up to a multiple of it


@dataclass(frozen=True, eq=False)
class TorqueRows:
    """Equations W pi = tau of one recording.

    Fields: name of the recording; t (N,) s; W (N, nv, p); slopes (N, nv, p, nv), dW/dz; tau
    (N, nv) N m; names (p,) of the columns; zeros (nv,) rad, at which W holds; cutoff in Hz.
    """

    name: str
    t: Array
    W: Array
    slopes: Array
    tau: Array
    names: tuple[str, ...]
    zeros: Array
    cutoff: float

    def at(self, zeros: Any) -> Array:
        """W (N, nv, p) at other zeros, to first order."""
        return self.W + self.slopes @ (np.asarray(zeros, float) - self.zeros)

    def residual(self, parameters: Any, zeros: Any = None) -> Array:
        """tau - W pi (N, nv)."""
        W = self.W if zeros is None else self.at(zeros)
        return self.tau - W @ np.asarray(parameters, float)

    def only(self, names: Sequence[str]) -> TorqueRows:
        """The equations with these columns only: a model with fewer terms."""
        for name in names:
            if name not in self.names:
                raise UnknownName("column", name, self.names)
        at = [self.names.index(name) for name in names]
        return dataclasses.replace(
            self, W=self.W[:, :, at], slopes=self.slopes[:, :, at], names=tuple(names)
        )

    def piece(self, start: float = -np.inf, end: float = np.inf) -> TorqueRows:
        """The equations of the times from start to end, in s."""
        keep = (start <= self.t) & (self.t <= end)
        if not keep.any():
            raise InputError(
                f"TorqueRows.piece: no equation of {self.name} lies from {start:g} to {end:g} s, "
                f"expected times within {self.t[0]:g} to {self.t[-1]:g} s"
            )
        cut = {k: getattr(self, k)[keep] for k in ("t", "W", "slopes", "tau")}
        return dataclasses.replace(self, **cut)


def torque_rows(
    model: Model,
    recording: Recording,
    cutoff: float,
    *,
    signal_cutoff: float | None = None,
    joint_terms: Sequence[str] = (),
    smoothing: float = 1e-2,
    zeros: Any = None,
) -> TorqueRows:
    """The equations of a recording of hinges and slides, filtered and thinned out.

    Args:
        model: the robot; of its numbers only kinematics and gravity matter.
        recording: with channels "q" (rad or m) and "tau" (N m or N).
        cutoff: in Hz, of both sides of the equations.
        signal_cutoff: in Hz, of the positions from which velocities and accelerations follow; 8
            times `cutoff` if None, at most 0.4 of the rate.
        joint_terms: as for `regressor`.
        smoothing: as for `regressor`.
        zeros: (nv,) rad or m, added to the positions that were read; 0 if None.

    Returns:
        `TorqueRows`, without the samples that an end of the recording disturbs.

    Raises:
        InputError: balls or free joints; missing samples; a recording shorter than its filters.
        UnknownName: the recording has no q or tau.

    Source: Gautier, ICRA 1997.

    Example:
        >>> import numpy as np, rbjax as rb
        >>> from rbjax.sysid import Channel, Recording, torque_rows
        >>> model, t = rb.load("pendulum"), np.arange(0.0, 4.0, 0.002)
        >>> run = Recording("swing", {"q": Channel(t, np.sin(t)), "tau": Channel(t, np.cos(t))})
        >>> rows = torque_rows(model, run, 5.0, joint_terms=["viscous"])
        >>> rows.W.shape[1:], rows.names[-1]
        ((1, 11), 'hinge.viscous')
    """
    where = "torque_rows"
    check_model(where, model)
    if model.nq != model.nv or len(joint_coordinates(model)) < model.nv:
        raise InputError(
            f"{where}: the model has {model.nq} positions and {model.nv} velocities, expected "
            "hinges and slides only"
        )
    recording.check_model(model)
    both = Recording(recording.name, {s: recording[s] for s in ("q", "tau")})
    h = both["q"].step
    count = int((both.end - both.start) / h + 1e-9)
    t = np.minimum(both.start + h * np.arange(count + 1), both.end)
    both = both.on_clock(t)
    for sensor in ("q", "tau"):
        if np.isnan(both[sensor].values).any():
            k = int(np.isnan(both[sensor].values).any(1).argmax())
            raise InputError(
                f"{where}: {recording.name} has no {sensor} at {t[k]:g} s, expected no gaps; use "
                "`Recording.piece` to cut them out"
            )
    smooth = min(8 * cutoff, 0.4 / h) if signal_cutoff is None else signal_cutoff
    moved = [differentiate(t, both["q"].values, smooth, times=k) for k in range(3)]
    load = low_pass(t, both["tau"].values, smooth)
    z = np.zeros(model.nv) if zeros is None else np.asarray(zeros, float)
    if z.shape != (model.nv,):
        raise InputError(f"{where}: zeros has shape {z.shape}, expected ({model.nv},)")

    signals = [*(m.values for m in moved), load.values]
    W, slopes = _columns(model, z, signals, joint_terms, smoothing)
    shape = (len(t), -1)
    each = [low_pass(t, x.reshape(shape), cutoff) for x in (W, slopes, both["tau"].values)]
    first = max(m.settled.start for m in (*moved, each[0]))
    step = max(1, int(KEPT / (2 * cutoff * h)))
    keep = slice(first, len(t) - first, step)
    if len(t[keep]) < 2:
        raise InputError(
            f"{where}: {recording.name} lasts {t[-1] - t[0]:g} s, expected more than "
            f"{2 * first * h:.2g} s, which its filters disturb at both ends"
        )
    W, slopes, torque = (
        f.values.reshape(x.shape)[keep]
        for f, x in zip(each, (W, slopes, both["tau"].values), strict=True)
    )
    names = parameter_names(model, joint_terms)
    return TorqueRows(recording.name, t[keep], W, slopes, torque, names, z, cutoff)


def _columns(
    model: Model, z: Array, motion: list[Array], joint_terms: Sequence[str], smoothing: float
) -> tuple[Array, Array]:
    """W and dW/dz, with samples filled up so that runs of about a length share one program."""
    n = len(motion[0])
    rest = -n % FILLED
    filled = [np.pad(x, ((0, rest), (0, 0)), mode="edge") for x in motion]
    found = _traced(model, jnp.asarray(z), filled, tuple(joint_terms), smoothing)
    W, slopes = (np.asarray(x)[:n] for x in found)
    return W, slopes


@functools.partial(jax.jit, static_argnums=(3, 4))
def _traced(
    model: Model, z: jax.Array, motion: list[Any], joint_terms: tuple[str, ...], smoothing: float
) -> tuple[jax.Array, jax.Array]:
    q, v, a, tau = motion

    def at(z: jax.Array) -> jax.Array:
        return observation_matrix(
            model, q + z, v, a, joint_terms=joint_terms, smoothing=smoothing, tau=tau
        )

    columns = [jax.jvp(at, (z,), (e,))[1] for e in jnp.eye(z.size, dtype=z.dtype)]
    return at(z), jnp.stack(columns, -1)
