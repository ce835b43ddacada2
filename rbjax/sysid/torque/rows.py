"""Linear equations of one recording, with the same zero-phase filter on both sides.

    F[tau] = F[Y(q, v, a)] pi + F[dY/dq pi] z

The torque is linear in pi, so a linear filter F may act on every column and on the torque, without
distortion of the friction columns, which have steps. The filtered equations are decimated to the
bandwidth of the filter. z (nq,) are the encoder zeros, q = q_read + z, about which the equations
are linearised. Each interval of a recording without a gap is filtered separately. Source: Gautier,
ICRA 1997 (parallel filtering and decimation).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, instance, real_array, real_number
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError, listed
from rbjax.model import Model
from rbjax.sysid.arguments import positive_numbers
from rbjax.sysid.data.filtering import check_cutoff, low_pass
from rbjax.sysid.data.recording import Channel, Recording
from rbjax.sysid.statistics.precision import cast, in_double
from rbjax.sysid.torque.regressors import JOINT_TERMS, parameter_names, regressor

Array = np.ndarray
BAND = 0.8  # ratio of the cut-off to the Nyquist frequency of the decimated equations
PADDED = 1000  # samples are padded to a multiple, so that similar motions share a program
BRIDGED = 0.25  # longest gap that a spline bridges, in periods of signal_cutoff


@displayed
@dataclass(frozen=True, eq=False)
class TorqueRows:
    """The equations W pi = tau of one recording.

    Fields:
        name: name of the recording.
        t: (N,) times in s, with the gaps of the recording.
        W: (N, nv, p) observation matrix.
        tau: (N, nv) torques in N m or N.
        names: (p,) names of the columns.
        zeros: (nv,) encoder zeros in W, in rad or m.
        cutoff: cut-off frequency in Hz.
        slopes_of: function that computes `slopes`.
    """

    name: str
    t: Array
    W: Array
    tau: Array
    names: tuple[str, ...]
    zeros: Array
    cutoff: float
    slopes_of: Callable[[], Array]

    @functools.cached_property
    def slopes(self) -> Array:
        """The derivatives dW/dz (N, nv, p, nv), computed at the first access."""
        return self.slopes_of()

    def at(self, zeros: Any) -> Array:
        """Compute W (N, nv, p) at other encoder zeros, to first order."""
        change = np.asarray(zeros, float) - self.zeros
        return self.W + self.slopes @ change if change.any() else self.W

    def residual(self, parameters: Any, zeros: Any = None) -> Array:
        """Compute the residual tau - W pi (N, nv), in N m, for parameters pi (p,)."""
        W = self.W if zeros is None else self.at(zeros)
        return self.tau - W @ np.asarray(parameters, float)

    def encoder_zeros(self, parameters: Any, *, noise: Any = 1.0, spread: float = 0.05) -> Array:
        """Estimate the encoder zeros (nv,) for given parameters, by linear least squares.

        z = argmin |(tau - W(z) pi) / s|^2 + |z|^2 / w^2. Use it for a recording that was not
        fitted, or its first seconds.

        Args:
            parameters: (p,) parameters pi.
            noise: s, the standard deviation of the torques, one number or (nv,).
            spread: w, the standard deviation of the zeros in rad or m.
        """
        where = "encoder_zeros"
        real_number(where, "spread", spread, "a positive angle or length", above=0.0)
        parameters = real_array(where, "parameters", parameters)
        if parameters.shape != (len(self.names),):
            raise InputError(
                f"{where}: parameters has shape {parameters.shape}, expected ({len(self.names)},)"
            )
        sd = positive_numbers(where, "noise", noise, self.tau.shape[1], "torque")
        J = np.einsum("nkpz,p->nkz", self.slopes, parameters) / sd[:, None]
        off = self.residual(parameters) / sd
        n = J.shape[-1]
        J = np.concatenate([J.reshape(-1, n), np.eye(n) / spread])
        off = np.concatenate([off.ravel(), -self.zeros / spread])
        return self.zeros + np.linalg.lstsq(J, off, rcond=None)[0]

    def only(self, names: Sequence[str]) -> TorqueRows:
        """Select columns by name, for a model with fewer terms."""
        for name in names:
            choice("column", name, self.names)
        at = [self.names.index(name) for name in names]
        return dataclasses.replace(
            self, W=self.W[:, :, at], names=tuple(names), slopes_of=lambda: self.slopes[:, :, at]
        )

    def segment(self, start: float = -np.inf, end: float = np.inf) -> TorqueRows:
        """Select the equations with times from start to end in s."""
        keep = (start <= self.t) & (self.t <= end)
        if not keep.any():
            raise InputError(
                f"TorqueRows.segment: no equation of {self.name} lies from {start:g} to {end:g} s, "
                f"expected times within {self.t[0]:g} to {self.t[-1]:g} s"
            )
        cut = {k: getattr(self, k)[keep] for k in ("t", "W", "tau")}
        return dataclasses.replace(self, **cut, slopes_of=lambda: self.slopes[keep])


@in_double
def torque_rows(
    model: Model,
    recording: Recording,
    cutoff: float,
    *,
    signal_cutoff: float | None = None,
    joint_terms: Sequence[str] = (),
    smoothing: float = 0.0,
    zeros: Any = None,
) -> TorqueRows:
    """Compute the filtered equations of a recording of hinges, slides and beams, for `regress`.

    Args:
        model: robot. Only its kinematics and gravity are used.
        recording: recording with channels "q" (rad or m) and "tau" (N m or N), with a column for
            each coordinate of a beam, as of strain gauges; its tau is zero. A spline bridges
            gaps that are shorter than a quarter of a period of `signal_cutoff` or than 3 samples.
            Longer gaps split the recording.
        cutoff: cut-off frequency in Hz of the filter on both sides of the equations.
        signal_cutoff: cut-off frequency in Hz of the positions, before differentiation. None: 8
            times `cutoff`, at most 0.4 of the sample rate.
        joint_terms: names of joint terms, as for `regressor`.
        smoothing: width of the friction step, as for `regressor`.
        zeros: (nv,) encoder zeros in rad or m, which are added to the readings. None: 0.

    Returns:
        `TorqueRows`, without the samples at the ends of each interval, which the filters distort.

    Raises:
        InputError: ball or free joints, no interval without gaps that is long enough for the
            filters, or a cut-off outside of the clock's range.
        UnknownName: a recording without q or tau.

    Source: Gautier, ICRA 1997.

    Example:
        >>> import numpy as np, rbjax as rb
        >>> from rbjax.sysid import Channel, Recording
        >>> from rbjax.sysid.torque import torque_rows
        >>> model, t = rb.load("pendulum"), np.arange(0.0, 4.0, 0.002)
        >>> run = Recording("swing", {"q": Channel(t, np.sin(t)), "tau": Channel(t, np.cos(t))})
        >>> rows = torque_rows(model, run, 5.0, joint_terms=["viscous"])
        >>> rows.W.shape[1:], rows.names[-1]
        ((1, 11), 'hinge.viscous')
    """
    where = "torque_rows"
    check_model(where, model)
    if model.nq != model.nv:
        raise InputError(
            f"{where}: the model has {model.nq} positions and {model.nv} velocities, expected "
            "hinges, slides and beams only"
        )
    fix = "one Recording; call it for each of several"
    instance(where, "recording", recording, Recording, fix)
    recording.check_model(model)
    names = parameter_names(model, joint_terms)
    z = _zeros(where, model, zeros)
    q, tau = (_in_order(where, model, recording, s) for s in ("q", "tau"))
    h = q.step
    smooth = _cutoffs(where, cutoff, signal_cutoff, h)
    both = Recording(recording.name, {"q": q, "tau": tau})
    count = int((both.end - both.start) / h + 1e-9)
    t = np.minimum(both.start + h * np.arange(count + 1), both.end)
    both = both.on_clock(t, gap=max(3 * h, BRIDGED / smooth) * (1 + 1e-9))
    seen = np.concatenate([both["q"].values, both["tau"].values], 1)
    stretches = _stretches(~np.isnan(seen).any(1))
    step = max(1, int(BAND / (2 * cutoff * h) * (1 + 1e-6)))
    first = _disturbed(h, cutoff, smooth)
    usable = [s for s in stretches if s.stop - s.start >= 2 * first + step + 1]
    if not usable:
        longest = max((t[s.stop - 1] - t[s.start] for s in stretches), default=0.0)
        raise InputError(
            f"{where}: {recording.name} has no samples of q and tau without a gap for longer than "
            f"{longest:g} s, expected more than {2 * first * h:.2g} s, which the filters disturb "
            f"at both ends; raise cutoff ({cutoff:g} Hz), or record for longer"
        )
    signals = []
    for s in usable:
        q = both["q"].values[s]
        moved = [low_pass(t[s], q, smooth, derivative=k).values for k in range(3)]
        signals.append([*moved, low_pass(t[s], both["tau"].values[s], smooth).values])
    together = [np.concatenate(x) for x in zip(*signals, strict=True)]
    ends = np.cumsum([0, *(s.stop - s.start for s in usable)])

    def filtered(x: Array) -> Array:
        """Filter and decimate the columns of all intervals."""
        found = []
        for s, at, end in zip(usable, ends[:-1], ends[1:], strict=True):
            flat = low_pass(t[s], x[at:end].reshape(end - at, -1), cutoff).values
            found.append(flat[first : len(flat) - first : step].reshape(-1, *x.shape[1:]))
        return np.concatenate(found)

    n = len(together[0])
    motion = [jnp.asarray(np.pad(x, ((0, -n % PADDED), (0, 0)), mode="edge")) for x in together]
    double, at = cast(model, jnp.float64), jnp.asarray(z)
    how: dict[str, Any] = {
        "terms": tuple(joint_terms), "smoothing": float(smoothing),
        "functions": tuple(JOINT_TERMS[term] for term in joint_terms),
    }  # fmt: skip
    times, torque = (
        np.concatenate([x[s] for s in usable]) for x in (t, both["tau"].values)
    )  # fmt: skip
    kept = np.concatenate(
        [np.arange(a + first, b - first, step) for a, b in itertools.pairwise(ends)]
    )

    @in_double
    def slopes() -> Array:
        """Compute dW/dz, the derivative of the observation matrix by the encoder zeros z, one
        direction of z at a time to save memory."""
        each = (_slope(double, at, jnp.asarray(e), motion, **how) for e in np.eye(z.size))
        return np.stack([filtered(np.asarray(x)[:n]) for x in each], -1)

    W = np.asarray(_matrix(double, at, motion, **how))[:n]
    return TorqueRows(
        recording.name, times[kept], filtered(W), filtered(torque), names, z,
        float(cutoff), slopes,
    )  # fmt: skip


#: `functions` of the terms are static arguments, since a redefined term needs a new program
_static = functools.partial(jax.jit, static_argnames=("terms", "smoothing", "functions"))


@_static
def _matrix(
    model: Model, zeros: jax.Array, motion: list[jax.Array], *, terms: tuple[str, ...],
    smoothing: float, functions: Any,
) -> jax.Array:  # fmt: skip
    q, v, a, tau = motion
    return regressor(model, q + zeros, v, a, joint_terms=terms, smoothing=smoothing, tau=tau)


@_static
def _slope(
    model: Model, zeros: jax.Array, direction: jax.Array, motion: list[jax.Array], *,
    terms: tuple[str, ...], smoothing: float, functions: Any,
) -> jax.Array:  # fmt: skip
    def at(zeros: jax.Array) -> jax.Array:
        return _matrix(model, zeros, motion, terms=terms, smoothing=smoothing, functions=functions)

    return jax.jvp(at, (zeros,), (direction,))[1]


def _zeros(where: str, model: Model, zeros: Any) -> Array:
    fix = f"({model.nv},) finite numbers in rad or m"
    z = real_array(where, "zeros", np.zeros(model.nv) if zeros is None else zeros, fix)
    if z.shape != (model.nv,):
        raise InputError(f"{where}: zeros is {zeros!r}, expected {fix}")
    return z


def _in_order(where: str, model: Model, recording: Recording, sensor: str) -> Channel:
    """Order the columns of a channel by the joints of the model."""
    channel, names = recording[sensor], model.joint_names
    if len(channel.names) != model.nv:
        missing = [n for n in names if n not in channel.names]
        raise InputError(
            f"{where}: channel {sensor} of {recording.name} has {len(channel.names)} columns, "
            f"expected {model.nv}, one for each joint; missing: {listed(missing, 8)}"
        )
    if set(channel.names) != set(names):
        return channel
    at = [channel.names.index(n) for n in names]
    return Channel(channel.t, channel.values[:, at], names, dropped="nan")


def _cutoffs(where: str, cutoff: Any, signal_cutoff: Any, h: float) -> float:
    """Check both cut-off frequencies, and return the cut-off of the signals in Hz."""
    check_cutoff(where, "cutoff", cutoff, h)
    if signal_cutoff is not None:
        check_cutoff(where, "signal_cutoff", signal_cutoff, h)
    return float(min(8 * cutoff, 0.4 / h) if signal_cutoff is None else signal_cutoff)


def _stretches(there: Array) -> list[slice]:
    """Return slices of the intervals without gaps."""
    edges = np.diff(np.concatenate([[0], there.astype(int), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]


def _disturbed(h: float, cutoff: float, smooth: float) -> int:
    """Compute the number of samples at each end that the filters distort."""
    t = h * np.arange(8)
    return max(
        low_pass(t, np.zeros(8), smooth, derivative=2).settled.start,
        low_pass(t, np.zeros(8), cutoff).settled.start,
    )
