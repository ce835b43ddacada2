"""Identifiable combinations of parameters, by the rank of a Jacobian.

J (m, n) are the derivatives of m measurements by n parameters. The columns are scaled to unit
length, J D^-1 = U S V^T, and r singular values are above the tolerance. r columns span the
remaining ones:

    J_dropped = J_kept K,   J pi = J_kept beta,   beta = pi_kept + K pi_dropped.

The base parameters beta are identifiable. The n - r directions pi_kept = -K pi_dropped are not. A
parameter is identifiable by itself if its row of K is zero. The kept columns are the first
independent ones in the given order (reduced row echelon form of V_r^T). Later parameters are
grouped into earlier ones, as in textbooks. Gautier, J. Robotic Systems 8(4), 1991; Khalil & Dombre,
*Modeling, Identification and Control of Robots*, ch. 9 and 12.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
from scipy.linalg import get_lapack_funcs

from rbjax.arguments import choice, real_array, real_number
from rbjax.display import displayed
from rbjax.errors import InputError, listed
from rbjax.rank_tolerances import rank_tolerance
from rbjax.sysid.arguments import names_of

#: A column below this multiple of the rounding error of the largest column counts as zero.
NOTHING = 500
#: Least relative part of a column outside of the span of the kept ones, in the first pass.
CLEAR = 1e-3
#: block size of LAPACK's QR in columns
BLOCK = 64


@displayed
@dataclass(frozen=True, eq=False)
class Combinations:
    """The identifiable combinations of parameters.

    Fields:
        names: (n,) names of the parameters.
        singular_values: singular values of J with columns of unit length, descending.
        tolerance: relative singular value that counts as zero.
        kept: indices of the r base parameters.
        dropped: indices of the n - r remaining parameters.
        K: (r, n - r) with beta = pi[kept] + K pi[dropped].
    """

    names: tuple[str, ...]
    singular_values: np.ndarray
    tolerance: float
    kept: tuple[int, ...]
    dropped: tuple[int, ...]
    K: np.ndarray

    @property
    def rank(self) -> int:
        """The number of identifiable combinations."""
        return len(self.kept)

    @property
    def gap(self) -> tuple[float, float]:
        """The smallest singular value above the tolerance and the largest below it.

        Both are relative to the largest singular value. The rank is certain if they differ by
        decades.
        """
        s, r = self.singular_values, self.rank
        if not r:
            return 0.0, 0.0
        return float(s[r - 1] / s[0]), float(s[r] / s[0]) if r < len(s) else 0.0

    @property
    def condition(self) -> float:
        """The condition number of the Jacobian restricted to its r identifiable dimensions."""
        return 1 / self.gap[0] if self.rank else np.inf

    @cached_property
    def hidden(self) -> tuple[str, ...]:
        """The names of the parameters without effect on the measurements."""
        silent = ~np.any(self.K, axis=0, keepdims=True)[0]
        return tuple(self.names[j] for j, x in zip(self.dropped, silent, strict=True) if x)

    @cached_property
    def single(self) -> tuple[str, ...]:
        """The names of the parameters that are identifiable by themselves."""
        single = ~np.any(self.K, axis=1, keepdims=True)[:, 0]
        return tuple(self.names[j] for j, x in zip(self.kept, single, strict=True) if x)

    @cached_property
    def matrix(self) -> np.ndarray:
        """The matrix B (r, n) that maps the parameters to the base parameters, beta = B pi."""
        B = np.zeros((self.rank, len(self.names)))
        B[np.arange(self.rank), list(self.kept)] = 1.0
        B[:, list(self.dropped)] = self.K
        return B

    @cached_property
    def free_directions(self) -> np.ndarray:
        """The directions N (n, n - r) in parameter space that change no measurement."""
        N = np.zeros((len(self.names), len(self.dropped)))
        N[list(self.dropped), np.arange(len(self.dropped))] = 1.0
        N[list(self.kept)] = -self.K
        return N

    def combine(self, values: Any) -> np.ndarray:
        """Compute the base parameters beta (r,) from parameters (n,)."""
        return self.matrix @ np.asarray(values, float)

    def term(self, k: int) -> str:
        """Format combination k as a sum, such as "link1.Izz + joint1.armature - 0.25 link2.m"."""
        parts = [self.names[self.kept[k]]]
        for j, x in zip(self.dropped, self.K[k], strict=True):
            if x:
                size = f"{abs(x):.4g}"
                factor = "" if size == "1" else f"{size} "
                parts.append(f"{'-' if x < 0 else '+'} {factor}{self.names[j]}")
        return " ".join(parts)

    def terms(self) -> tuple[str, ...]:
        """Format all combinations as sums."""
        return tuple(self.term(k) for k in range(self.rank))

    def summary(self) -> str:
        """Return the identifiable and unidentifiable parameters as text, one sentence a line."""
        n, (least, most) = len(self.names), self.gap
        kinds = len(self.single), self.rank - len(self.single), len(self.hidden)
        lines = [
            f"{self.rank} of {n} are identifiable: {kinds[0]} by themselves and {kinds[1]} as "
            f"combinations; {kinds[2]} have no effect. The smallest singular value above the "
            f"tolerance is {least:.2g} of the largest; the next is {most:.2g}."
        ]
        if self.single:
            lines.append(f"Identifiable by themselves: {', '.join(self.single)}.")
        for k in range(self.rank):
            if self.K[k].any():
                partners = int((self.K[k] != 0).sum())
                rest = "neither by itself" if partners == 1 else "none of them by itself"
                lines.append(f"{self.term(k)} is identifiable; {rest}.")
        if self.hidden:
            lines.append(f"Without effect: {', '.join(self.hidden)}.")
        return "\n".join(lines)


def combinations(
    J: Any, names: Sequence[str], *, tolerance: float | None = None, first: Sequence[str] = ()
) -> Combinations:
    """Find the combinations of parameters that a Jacobian identifies.

    Args:
        J: (..., n) derivatives of measurements by parameters. Leading axes index measurements.
            Divide rows of unequal noise by their noise.
        names: (n,) names of the parameters. Later parameters are grouped into earlier ones.
        tolerance: relative singular value that counts as zero, for columns of unit length. None:
            1e-9 in float64 and 1e-4 in float32.
        first: names of parameters to keep with priority, if they are independent.

    Returns:
        `Combinations`.

    Raises:
        InputError: inconsistent shapes, values that are not finite, or repeated names.
        UnknownName: an unknown parameter in `first`.

    Source: Gautier 1991; Golub & Van Loan, *Matrix Computations*, 5.4.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.statistics import combinations
        >>> t = np.linspace(0.0, 1.0, 9)
        >>> seen = combinations(np.stack([t, 2 * t, t**2, 0 * t], 1), ["a", "b", "c", "d"])
        >>> print("\\n".join(seen.summary().splitlines()[1:]))
        Identifiable by themselves: c.
        a + 2 b is identifiable; neither by itself.
        Without effect: d.
    """
    names = names_of("combinations", "names", names)
    first = names_of("combinations", "first", first)
    dtype = np.asarray(J).dtype
    J = real_array("combinations", "J", J, finite=False)
    eps = float(np.finfo(np.float32 if dtype == np.float32 else np.float64).eps)
    if tolerance is None:
        tolerance = rank_tolerance("unknowns", dtype)
    if J.ndim < 2 or J.shape[-1] != len(names):
        raise InputError(
            f"combinations: J has shape {J.shape} and there are {len(names)} names, expected one "
            "column for each name"
        )
    if len(set(names)) < len(names):
        twice = sorted({x for x in names if names.count(x) > 1})
        raise InputError(f"combinations: names repeat: {listed(twice, 4)}; expected unique names")
    real_number("combinations", "tolerance", tolerance, "between 0 and 1", above=0.0, most=1.0)
    for name in first:
        choice("parameter", name, names)
    J = J.reshape(-1, len(names))
    if not np.isfinite(J).all():
        i, j = np.argwhere(~np.isfinite(J))[0]
        raise InputError(f"combinations: J[{i}] of {names[j]} is {J[i, j]}, expected finite values")
    size = np.linalg.norm(J, axis=0)
    shows = size > NOTHING * eps * size.max(initial=0.0)
    scale = np.where(shows, size, 1.0)
    scaled = np.where(shows, J, 0.0) / scale
    if len(J) > len(names):
        scaled = scipy.linalg.qr(scaled, mode="r")[0][: len(names)]
    _, s, Vt = np.linalg.svd(scaled, full_matrices=False)
    rank = int((s > tolerance * s[0]).sum()) if s.size and s[0] > 0 else 0
    leading = [names.index(name) for name in dict.fromkeys(first)]
    order = [*leading, *(j for j in range(len(names)) if j not in leading)]
    kept = _independent(Vt[:rank], order)
    dropped = tuple(j for j in range(len(names)) if j not in set(kept))
    K = np.zeros((rank, len(dropped)))
    if rank and dropped:
        K = scipy.linalg.solve(Vt[:rank, list(kept)], Vt[:rank, list(dropped)])
        # smaller entries are zero up to rounding and the neglected singular values
        K = np.where(np.abs(K) > max(tolerance * s[0] / s[rank - 1], 1e-12), K, 0.0)
        K = K * (scale[list(dropped)] / scale[list(kept), None])
    return Combinations(names, s, float(tolerance), kept, dropped, K)


def triangle_of(rows: np.ndarray) -> np.ndarray:
    """Compute the QR factor R of rows [J r], or nan if an entry is not finite."""
    n = rows.shape[1]
    if not np.isfinite(rows).all():
        return np.full((n, n), np.nan, rows.dtype)
    (factorise,) = get_lapack_funcs(("geqrf",), (rows,))
    # column order and block size of LAPACK, twice as fast as `np.linalg.qr`
    columns, _, _, _ = factorise(np.array(rows, order="F"), lwork=BLOCK * n, overwrite_a=True)
    R: Any = np.triu(columns[:n])
    missing = n - R.shape[0]
    return R if missing <= 0 else np.pad(R, ((0, missing), (0, 0)))


def project_out_others(R: np.ndarray, n: int) -> np.ndarray:
    """Project the span of the other columns out of the first n columns of R.

    R (m, size + 1) is a triangular factor of [J r]. Columns n to size - 1 are derivatives by
    entries such as initial states.
    """
    first, others = R[:, :n], R[:, n:-1]
    if not others.shape[1]:
        return first
    size = np.linalg.norm(others, axis=0)
    moves = size > 0
    U, s, _ = np.linalg.svd(others[:, moves] / size[moves], full_matrices=False)
    U = U[:, s > rank_tolerance("unknowns", R.dtype) * s.max(initial=0.0)]
    return np.asarray(first - U @ (U.T @ first))


def _independent(rows: np.ndarray, order: Sequence[int]) -> tuple[int, ...]:
    """Choose r independent columns of r orthonormal rows, with priority in the given order.

    The first pass keeps columns with a clear component outside of the span of the kept ones. If
    these are too few, the columns with the largest such components follow.
    """
    rank = len(rows)
    kept: list[int] = []
    basis = np.zeros((rank, 0))

    def outside(x: np.ndarray) -> np.ndarray:
        for _ in range(2):  # twice is enough (Kahan)
            x = x - basis @ (basis.T @ x)
        return x

    for j in order:
        part = outside(rows[:, j])
        length, whole = (float(np.linalg.norm(x)) for x in (part, rows[:, j]))
        if len(kept) < rank and length > CLEAR * max(whole, 1e-6):
            kept.append(j)
            basis = np.column_stack([basis, part / length])
    while len(kept) < rank:
        parts = outside(rows)
        j = int(np.argmax(np.linalg.norm(parts, axis=0)))
        kept.append(j)
        basis = np.column_stack([basis, parts[:, j] / np.linalg.norm(parts[:, j])])
    return tuple(sorted(kept))
