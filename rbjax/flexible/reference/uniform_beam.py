"""The properties of a uniform beam in equal segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rbjax.arguments import integer
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError


@dataclass(frozen=True)
class UniformBeam:
    """A uniform beam along x in equal segments, clamped to the world.

    Fields:
        length: m.
        segments: the number n of segments.
        bending: E I_y, E I_z, N m^2.
        mass: kg/m.
        inertia: rotary inertia per length about x, y, z, kg m, above zero.
        torsion: G J, N m^2; not used in the plane.
        planar: n coordinates, bending about z, instead of 3 n.
        gravity: m/s^2.

    Raises:
        InputError: values that are not above zero, or of another shape.

    Example:
        >>> beam = UniformBeam(
        ...     1.0, 4, bending=(1.0, 1.0), torsion=0.8, mass=1.0, inertia=(2e-4, 1e-4, 1e-4)
        ... )
        >>> beam.segment_length
        0.25
    """

    length: float
    segments: int
    bending: Sequence[float]
    mass: float
    inertia: Sequence[float]
    torsion: float = 0.0
    planar: bool = False
    gravity: Sequence[float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        where = "UniformBeam"
        integer(where, "segments", self.segments, least=1)
        positive = {"length": self.length, "mass": self.mass}
        if not self.planar:
            positive["torsion"] = self.torsion
        for name, value in positive.items():
            if not check_array(where, name, value, ()) > 0:
                raise InputError(f"{where}: {name} is {value}, expected a value above zero")
        for name, values, size in (("bending", self.bending, 2), ("inertia", self.inertia, 3)):
            if not (check_array(where, name, values, (size,)) > 0).all():
                raise InputError(
                    f"{where}: {name} is {values}, expected {size} values above zero"
                )  # fmt: skip

    @property
    def segment_length(self) -> float:
        """The length of a segment, m."""
        return self.length / self.segments

    @property
    def spring_constants(self) -> np.ndarray:
        """E I_z in the plane, otherwise G J, E I_y and E I_z, N m^2."""
        return np.array([self.bending[1]] if self.planar else [self.torsion, *self.bending], float)
