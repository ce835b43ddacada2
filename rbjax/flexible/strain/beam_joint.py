"""A beam whose strains are polynomials of the arclength: geometric variable strain.

    xi(s) = [k_x, k_y, k_z, 1 + e_x, g_y, g_z] = xi_0(s) + sum_j P_j(2 s / L - 1) T_j q

The base frame is at s = 0 and x is along the beam. k_x is torsion, k_y and k_z bending, e_x axial
strain, g_y and g_z shear. A strain that is absent is zero: without shear the beam is a Kirchhoff
rod, and without e_x it is inextensible. xi_0 has natural curvature and twist. T_j are the rows of a
constant matrix T for the coefficients of degree j. T is the identity if the coordinates are the
Legendre coefficients, otherwise a reduced basis.

(Boyer, Lebastard, Candelier & Renda, *Dynamics of continuum and soft robots: a strain
parameterization based approach*, IEEE T-RO 37(3), 2021. Here rotations and positions are integrated
separately, by a Magnus expansion on SO(3) and by Gauss quadrature, which keeps spectral accuracy.)
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnknownName
from rbjax.flexible.strain import basis, beam_kinematics, virtual_power
from rbjax.flexible.strain.section_rotations import Cells, Coefficients, Orientation
from rbjax.flexible.strain.shape import STRAINS, Shape, shape_function
from rbjax.joints.flexible import Flexible
from rbjax.joints.frame_motion import FrameMotion, VirtualFrame
from rbjax.joints.registry import register
from rbjax.lanes import Lane, Sym3, Vec3, fusion_barrier, inner, is_zero, mul, safe_sqrt
from rbjax.spatial import Motion, RigidInertia, Transform

#: the parameters of a section in which its inertia is linear
_INERTIAL = ("mass_per_length", "rotary_inertia", "first_moment", "product_of_inertia")


class StrainBeam(Flexible):
    """A flexible link in strain coordinates. Create it with `strain_beam`, which registers it.

    The coordinates are the Legendre coefficients of the strains, strain by strain in the order of
    `STRAINS`, each from degree 0 upwards, or those of a reduced basis. The frames are the Gauss
    points, which carry the mass, then the tip, then the further frames.

    Attributes:
        shape: the static configuration.
        coefficients: (index of the strain, degree) of each Legendre coefficient.
        basis: T, Legendre coefficients for a unit of each coordinate (coefficients, coordinates).
        shapes: the shape function of each coordinate, the column of T by strain.
        shape_values: the values of the shape functions at each Gauss point.
        nodes, weights: s / L of the Gauss points and their weights, whose sum is 1.
        tip: the index of the frame at the tip.
    """

    def __init__(self, shape: Shape):
        self.shape = shape
        self.name = shape.name
        self.coefficients = tuple(
            (STRAINS.index(name), j) for name, degree in shape.degrees for j in range(degree + 1)
        )
        T = np.array(shape.basis or np.eye(len(self.coefficients)))
        self.basis, self.coordinates = T.tolist(), T.shape[1]
        self.shapes = [shape_function(self.coefficients, column) for column in T.T.tolist()]
        self.tip, self.count = shape.points, shape.points + 1 + len(shape.places)
        nodes, weights = basis.gauss_points(shape.points)
        self.nodes, self.weights = nodes.tolist(), weights.tolist()
        ends = (1.0, *shape.places)
        degree = max((j for _, j in self.coefficients), default=0)
        self.values = [basis.legendre(degree, x).tolist() for x in self.nodes]
        self.shape_values = [self.shapes_at(P) for P in self.values]
        rows = basis.integration_matrix(shape.points, np.array([*self.nodes, *ends]))
        rows[shape.points] = weights
        self.rows = rows.tolist()
        natural = [(STRAINS.index(strain), j) for strain, j in shape.natural]
        bent = {k for shape in self.shapes for k in shape if k < 3}
        self.cells = Cells(
            max((j for k, j in (*self.coefficients, *natural) if k < 3), default=-1),
            nodes,
            ends,
            self.shapes,
            sorted(bent | {k for k, _ in natural}),
        )
        stations = shape.points if shape.tapered else 1
        each = {"mass_per_length": (1.0,), "rotary_inertia": (1e-4, 5e-5, 5e-5)}
        if shape.eccentric:
            each |= {"first_moment": (0.0, 0.0), "product_of_inertia": (0.0,)}
        self.params = {
            "length": 1.0,
            **{key: value * stations for key, value in each.items()},
            **{f"natural_{strain}": (0.0,) * (j + 1) for strain, j in shape.natural},
        }
        super().__init__()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StrainBeam) and self.shape == other.shape

    def __hash__(self) -> int:
        return hash(self.name)

    def __reduce__(self) -> tuple:
        """Pickle the static configuration, from which the kind is created and registered."""
        return _registered, (self.shape,)

    @property
    def body_frame(self) -> int:
        return self.tip

    def invalid(self, q: np.ndarray, params: np.ndarray) -> str | None:
        lanes = [float(x) if np.ndim(x) == 0 else x for x in np.moveaxis(q, -1, 0)]
        with np.errstate(all="ignore"):
            k = self._curvature(lanes, self.named(params.tolist()))
            largest = max(float(np.max(x)) for x in self.cells.angles(k))
        if largest < np.pi**2:
            return None
        return (
            f"a part of the beam between Gauss points turns by {np.sqrt(largest):.3g} rad, and the "
            "kinematics need less than pi; use more points, or several beams in series"
        )

    def frames(
        self, q: Sequence[Lane], v: Sequence[Lane], params: Sequence[Lane]
    ) -> list[FrameMotion]:
        given = self.named(params)
        (length,) = given["length"]
        moves = not all(map(is_zero, v))
        sections, s = self._stretched(q, v if moves else None, given)
        columns = beam_kinematics.columns(self.rows, self.shape_values, s, sections, length)
        speeds = [(Motion.zero(), Motion.zero())] * self.count
        if moves:
            speeds = beam_kinematics.velocities(self.rows, s, sections)
        inertias = [*self._inertias(given), *[RigidInertia.zero()] * (self.count - self.tip)]
        out = []
        for g, (row, section) in enumerate(zip(self.rows, sections, strict=True)):
            pose = beam_kinematics.pose(row, s, section)
            out.append(FrameMotion.at_pose(pose, columns[g], *speeds[g], inertias[g]))
        return out

    def virtual_frames(
        self,
        q: Sequence[Lane],
        v: Sequence[Lane],
        a: Sequence[Lane],
        rates: Sequence[Lane],
        params: Sequence[Lane],
    ) -> list[VirtualFrame]:
        given = self.named(params)
        (length,) = given["length"]
        sections, s = self._stretched(q, v, given, (a, rates))
        along = [
            beam_kinematics.tangents(s.sections, self.values, self._split(x)[1], length)
            for x in (a, rates)
        ]
        motions = virtual_power.section_motions(self.rows, s, sections, *along)
        power = virtual_power.BeamPower(motions[: self.tip], self._inertias(given))
        return [
            VirtualFrame.in_axes(*x, None if g else power) for g, x in enumerate(motions)
        ]  # fmt: skip

    def _stretched(
        self,
        q: Sequence[Lane],
        v: Sequence[Lane] | None,
        given: dict[str, list[Lane]],
        along: Sequence[Sequence[Lane]] = (),
    ) -> tuple[list[Orientation], beam_kinematics.Stretched]:
        """Compute the sections of all frames, and the tangents at the Gauss points.

        v: rates of the coordinates; None if they are not needed. along: accelerations and virtual
            rates, in place of columns.
        """
        (length,) = given["length"]
        turn_rate, rate = (None, None) if v is None else self._split(v)
        sections = self.cells.sections(
            self._curvature(q, given),
            turn_rate and _scaled(turn_rate, length),
            along=tuple(_scaled(self._split(x)[0], length) for x in along),
            columns=not along,
        )
        strain = self._split(q)[1]
        s = beam_kinematics.stretch(sections[: self.tip], self.values, strain, rate, length)
        return sections, s

    def poses(self, q: Sequence[Lane], params: Sequence[Lane]) -> list[Transform]:
        """Compute the pose of each frame in the base frame, as `frames` does.

        Args:
            q: the coordinates.
            params: the parameters, in the order of `params`.
        """
        given = self.named(params)
        (length,) = given["length"]
        sections = self.cells.sections(self._curvature(q, given), columns=False)
        strain = self._split(q)[1]
        s = beam_kinematics.stretch(sections[: self.tip], self.values, strain, None, length)
        return [beam_kinematics.pose(row, s, x) for row, x in zip(self.rows, sections, strict=True)]

    def strain(
        self, q: Sequence[Lane], given: Mapping[str, Sequence[Lane]], P: Sequence[float]
    ) -> tuple[Vec3, Vec3]:
        """Compute the curvature and Gamma, with natural curvature, where P_j have the values P.

        given: the parameters by name (`named`).
        """
        curvature, gamma = self._split(q)
        natural = [given.get(f"natural_{strain}", []) for strain in STRAINS[:3]]
        rows = [*map(beam_kinematics.added, curvature, natural), *gamma]
        x = [inner(P[: len(row)], row) for row in rows]
        return Vec3(*x[:3]), Vec3(1.0, 0.0, 0.0) + Vec3(*x[3:])

    def shapes_at(self, P: Sequence[float]) -> list[dict[int, float]]:
        """Compute the shape function of each coordinate where P_j have the values P."""
        return [
            {k: sum(x * y for x, y in zip(P, c, strict=False)) for k, c in shape.items()}
            for shape in self.shapes
        ]

    def named(self, params: Sequence[Lane]) -> dict[str, list[Lane]]:
        """Split the flat parameters by name."""
        out, at = {}, 0
        for name, default in self.params.items():
            n = len(default) if isinstance(default, tuple) else 1
            out[name] = list(params[at : at + n])
            at += n
        return out

    @property
    def section_params(self) -> tuple[tuple[str, int], ...]:
        """(name, index) of the parameters in which the inertia is linear."""
        return tuple(
            (name, k)
            for name, default in self.params.items()
            if name in _INERTIAL and isinstance(default, tuple)
            for k in range(len(default))
        )

    def unit_inertias(
        self, given: Mapping[str, Sequence[Lane]], name: str, k: int
    ) -> list[RigidInertia]:
        """Compute the inertia at each Gauss point for a unit of one of `section_params`.

        given: the parameters by name (`named`).
        """
        values = {key: [0.0] * len(x) if key in _INERTIAL else list(x) for key, x in given.items()}
        values[name][k] = 1.0
        return self._inertias(values)

    def values_of(self, **changes: Sequence[Lane] | Lane) -> list[Lane]:
        """Return the flat parameters: the defaults with changes.

        Args:
            changes: name -> value or values; one section's values serve all of a tapered beam.

        Raises:
            UnknownName: no such parameter.
            InputError: a wrong number of values.
        """
        out: list[Lane] = []
        for name in changes:
            if name not in self.params:
                raise UnknownName("parameter of a beam", name, self.params)
        for name, default in self.params.items():
            n = len(default) if isinstance(default, tuple) else 1
            value = changes.get(name, default)
            values = list(value) if hasattr(value, "__len__") else [value]
            if n % len(values) or (len(values) != n and not self.shape.tapered):
                raise InputError(
                    f"{self.name}: {name} has {len(values)} values, expected {n}"
                )  # fmt: skip
            out += values * (n // len(values))
        return out

    def _split(self, q: Sequence[Lane]) -> tuple[list[list[Lane]], list[list[Lane]]]:
        """Return the coefficients of k and of Gamma, component by component."""
        rows: list[list[Lane]] = [[] for _ in STRAINS]
        for (k, _), T in zip(self.coefficients, self.basis, strict=True):
            rows[k].append(inner(T, q))
        rows = fusion_barrier(rows) if self.shape.basis else rows
        return rows[:3], rows[3:]

    def _curvature(self, q: Sequence[Lane], given: dict[str, list[Lane]]) -> Coefficients:
        """Return the coefficients of the curvature times the length."""
        (length,) = given["length"]
        natural = [given.get(f"natural_{strain}", []) for strain in STRAINS[:3]]
        rows = map(beam_kinematics.added, self._split(q)[0], natural)
        return _scaled(rows, length)

    def _inertias(self, given: dict[str, list[Lane]]) -> list[RigidInertia]:
        """Compute the inertia that each Gauss point carries: weight x length x section."""
        (length,) = given["length"]
        out = []
        for g, weight in enumerate(self.weights):
            share = mul(weight, length)

            def of(name: str, n: int, g: int = g, share: Lane = share) -> list[Lane]:
                at = n * g if self.shape.tapered else 0
                values = given.get(name)
                return [mul(share, x) for x in values[at : at + n]] if values else [0.0] * n

            (m,), J = of("mass_per_length", 1), of("rotary_inertia", 3)
            y, z = of("first_moment", 2)
            (yz,) = of("product_of_inertia", 1)
            out.append(RigidInertia(m, Vec3(0.0, y, z), Sym3(*J, 0.0, 0.0, yz)))
        return out


def _scaled(rows: Iterable[Sequence[Lane]], length: Lane) -> list[list[Lane]]:
    return [[mul(length, x) for x in row] for row in rows]


def strain_beam(
    degrees: Mapping[str, int],
    *,
    points: int | None = None,
    frames: Sequence[float] = (),
    natural: Mapping[str, int] | None = None,
    tapered: bool = False,
    eccentric: bool = False,
    basis: Any = None,
) -> StrainBeam:
    """Create and register the kind of joint of a beam. Equal arguments give the same kind.

    Args:
        degrees: strain -> degree of its polynomial. Strains are k_x (torsion), k_y, k_z (bending
            about y and z), e_x (axial), g_y, g_z (shear). A strain that is left out is zero.
        points: the number of Gauss points; by default n + 3, where n is the largest number of
            coefficients of a strain. From n + 2 the mass matrix of small deflections is exact, and
            in large bending quadrature errs less than the polynomials.
        frames: s / L of frames in addition to the Gauss points and the tip, in (0, 1].
        natural: curvature -> degree of the natural curvature or twist, a parameter.
        tapered: True for mass and rotary inertia at each Gauss point, in place of one value.
        eccentric: True for sections whose mass centre is off the line, or whose y and z are not
            principal axes.
        basis: Legendre coefficients of the strains for a unit of each coordinate (coefficients,
            coordinates), constants; by default the coordinates are the Legendre coefficients.

    Returns:
        the joint, whose `params` are leaves of a model:

        - length: m.
        - mass_per_length: kg/m.
        - rotary_inertia: x, y and z about the line in axes of the section, kg m.
        - first_moment: y and z, mass per length times the mass centre, kg.
        - product_of_inertia: entry yz of the rotary inertia, kg m.
        - natural_k_x, natural_k_y, natural_k_z: Legendre coefficients, 1/m.

    Raises:
        InputError: no strain, a degree, a number of points or a place out of range, a basis of a
            wrong shape or with dependent columns.
        UnknownName: no such strain.

    Source: Boyer, Lebastard, Candelier & Renda, IEEE T-RO 37(3), 2021, section III.

    Example:
        >>> beam = strain_beam({"k_z": 3})
        >>> beam.coordinates, beam.shape.points, beam.count
        (4, 7, 8)
        >>> quarter = beam.poses([jnp.pi / 2, 0.0, 0.0, 0.0], beam.defaults)[beam.tip]
        >>> [round(float(x), 6) for x in quarter.p]
        [0.63662, 0.63662, 0.0]
    """
    return _registered(
        Shape.checked(degrees, points, frames, natural, bool(tapered), bool(eccentric), basis)
    )


@functools.cache
def _registered(shape: Shape) -> StrainBeam:
    beam = StrainBeam(shape)
    register(beam)
    return beam


def largest_cell_angle(beam: StrainBeam, q: Sequence[Lane], params: Sequence[Lane]) -> Lane:
    """Compute the largest angle |O| by which a cell of a beam turns, rad.

    A cell lies between neighbouring nodes. The expansion of a spatial rotation converges if the
    integral of |k| over the cell is below pi. |O| is close to this integral if k changes little in
    the cell. Beyond pi the result is wrong: use more points, or several beams in series.
    Quadrature needs an angle well below pi also for a planar beam.

    Args:
        beam: the kind of joint.
        q: the coordinates.
        params: the parameters, in the order of `beam.params`.

    Example:
        >>> beam = strain_beam({"k_z": 0}, points=4)
        >>> bool(largest_cell_angle(beam, [2 * jnp.pi], beam.defaults) < jnp.pi)
        True
    """
    squares = beam.cells.angles(beam._curvature(q, beam.named(params)))
    largest: Lane = 0.0
    for x in squares:
        largest = jnp.maximum(largest, x)
    return safe_sqrt(largest)
