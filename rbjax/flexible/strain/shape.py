"""The static configuration of a beam in strain coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rbjax.errors import InputError, UnknownName

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
    """

    degrees: tuple[tuple[str, int], ...]
    points: int
    places: tuple[float, ...] = ()
    natural: tuple[tuple[str, int], ...] = ()
    tapered: bool = False
    eccentric: bool = False

    @property
    def name(self) -> str:
        """The name of the kind of joint."""
        parts = [f"{strain}^{degree}" for strain, degree in self.degrees]
        parts += [f"points={self.points}"]
        parts += [f"frame={x!r}" for x in self.places]
        parts += [f"natural_{strain}^{degree}" for strain, degree in self.natural]
        parts += ["tapered"] * self.tapered + ["eccentric"] * self.eccentric
        return f"strain_beam({','.join(parts)})"


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


def checked_place(x: float) -> float:
    if isinstance(x, bool) or not isinstance(x, (int, float)) or not 0 < x <= 1:
        raise InputError(
            f"strain_beam: a frame is at s / L = {x!r}, expected a number above 0 and up to 1; the "
            "base frame is at 0"
        )
    return float(x)


def is_integer(x: object) -> bool:
    return isinstance(x, int) and not isinstance(x, bool)
