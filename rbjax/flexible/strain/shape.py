"""The static configuration of a beam in strain coordinates."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbjax.arguments import real_array
from rbjax.errors import InputError, UnknownName
from rbjax.flexible.strain.basis import ShapeFunction

#: the strains, in the order of the 6 by 6 stiffness of a section
STRAINS = ("k_x", "k_y", "k_z", "e_x", "g_y", "g_z")
_MOST = 30  # the largest degree: the basis of more coefficients is better split into several beams


class Shape(NamedTuple):
    """The static configuration of a beam.

    Fields:
        degrees: (strain, degree) in the order of `STRAINS`.
        points: the number of Gauss points.
        places: s / L of further frames.
        natural: (curvature, degree) of natural curvature and twist.
        tapered: True if the section varies along the beam.
        eccentric: True if the mass centre of a section is off the line, or its axes are not
            principal.
        basis: rows of T, the Legendre coefficients of the strains for a unit of each coordinate;
            empty if the coordinates are the Legendre coefficients.
    """

    degrees: tuple[tuple[str, int], ...]
    points: int
    places: tuple[float, ...] = ()
    natural: tuple[tuple[str, int], ...] = ()
    tapered: bool = False
    eccentric: bool = False
    basis: tuple[tuple[float, ...], ...] = ()

    @classmethod
    def checked(
        cls,
        degrees: Mapping[str, int],
        points: int | None,
        frames: Sequence[float],
        natural: Mapping[str, int] | None,
        tapered: bool,
        eccentric: bool,
        basis: Any,
    ) -> Shape:
        """Check the arguments of `strain_beam`."""
        active = checked_degrees("degrees", degrees, STRAINS)
        if not active:
            raise InputError(
                f"strain_beam: degrees is {degrees!r}, a beam without a strain, which is a rigid "
                'body; give at least one, for example {"k_y": 2, "k_z": 2}'
            )
        curved = checked_degrees("natural", natural or {}, STRAINS[:3])
        most = max(degree for _, degree in (*active, *curved)) + 1
        if points is None:
            points = most + 3
        if not is_integer(points) or not most <= points <= 100:
            raise InputError(
                f"strain_beam: points is {points!r}, expected an integer from {most}, the largest "
                "number of coefficients of a strain, to 100; leave it out for the default"
            )
        places = tuple(checked_place(x) for x in frames)
        T = () if basis is None else checked_basis(basis, sum(d + 1 for _, d in active))
        return cls(active, int(points), places, curved, tapered, eccentric, T)

    @property
    def name(self) -> str:
        """The name of the kind of joint."""
        parts = [f"{strain}^{degree}" for strain, degree in self.degrees]
        parts += [f"points={self.points}"]
        parts += [f"frame={x!r}" for x in self.places]
        parts += [f"natural_{strain}^{degree}" for strain, degree in self.natural]
        parts += ["tapered"] * self.tapered + ["eccentric"] * self.eccentric
        if self.basis:
            digest = hashlib.sha256(np.array(self.basis).tobytes()).hexdigest()
            parts += [f"basis={len(self.basis[0])}:{digest[:16]}"]
        return f"strain_beam({','.join(parts)})"


def shape_function(
    coefficients: Sequence[tuple[int, int]], column: Sequence[float]
) -> ShapeFunction:
    """Return a column of a basis by strain, up to the last coefficient of each that is not zero.

    coefficients: (strain, degree) of each entry of the column.
    """
    entries = list(zip(coefficients, column, strict=True))
    by_strain = {k: [x for (i, _), x in entries if i == k] for k, _ in coefficients}
    trimmed = {k: np.trim_zeros(x, "b") for k, x in by_strain.items()}
    return {k: x for k, x in trimmed.items() if x}


def checked_degrees(
    where: str, given: Mapping[str, int], known: Sequence[str]
) -> tuple[tuple[str, int], ...]:
    if not isinstance(given, Mapping):
        raise InputError(
            f"strain_beam: {where} is {given!r}, expected a mapping from strain to degree, for "
            f'example {{"{known[-1]}": 2}}'
        )
    for name, degree in given.items():
        if name not in known:
            raise UnknownName(f"strain in {where}", name, known)
        if not is_integer(degree) or not 0 <= degree <= _MOST:
            raise InputError(
                f"strain_beam: the degree of {name} in {where} is {degree!r}, expected an integer "
                f"from 0 to {_MOST}; use several beams in series for more coefficients"
            )
    return tuple((name, int(given[name])) for name in known if name in given)


def checked_basis(given: Any, coefficients: int) -> tuple[tuple[float, ...], ...]:
    """Return the rows of a basis (coefficients, coordinates) with independent columns."""
    T = real_array("strain_beam", "basis", given, "Legendre coefficients of each coordinate")
    if T.ndim != 2 or len(T) != coefficients or not 1 <= T.shape[1] <= coefficients:
        raise InputError(
            f"strain_beam: basis has the shape {T.shape}, expected ({coefficients}, n): a row for "
            f"each Legendre coefficient of degrees, and n columns from 1 to {coefficients}, one "
            "for each coordinate"
        )
    size = np.linalg.norm(T, axis=0)
    rank = np.linalg.matrix_rank(T / np.where(size > 0, size, 1.0), tol=1e-10)
    if rank < T.shape[1]:
        raise InputError(
            f"strain_beam: the {T.shape[1]} columns of basis are linearly dependent, of rank "
            f"{rank}; leave out columns, or use Beam.reduced, which leaves them out"
        )
    return tuple(map(tuple, T.tolist()))


def checked_place(x: float) -> float:
    if isinstance(x, bool) or not isinstance(x, (int, float)) or not 0 < x <= 1:
        raise InputError(
            f"strain_beam: a frame is at s / L = {x!r}, expected a number above 0 and up to 1; the "
            "base frame is at 0"
        )
    return float(x)


def is_integer(x: object) -> bool:
    return isinstance(x, int) and not isinstance(x, bool)
