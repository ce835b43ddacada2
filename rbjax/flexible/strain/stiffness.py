"""Elastic energy of a beam in strain coordinates.

    U = 1/2 int (xi - xi_0)^T C (xi - xi_0) ds = 1/2 q^T K q,    K = int B^T C B ds

C is the stiffness of the section, with strains in the order k_x, k_y, k_z, e_x, g_y, g_z: for a
section with principal axes the diagonal GJ, EI_y, EI_z, EA, GA_y, GA_z. The polynomials are
orthogonal. If C is constant along the beam,

    K_{(c,i),(d,j)} = delta_ij L C_cd / (2 j + 1)

and K is diagonal if C is. In a reduced basis the same holds if each coordinate has one strain, and
the coordinates of a strain are orthogonal. If C varies, Gauss quadrature computes K. With the
viscosity of the section in place of C the function gives the damping matrix of Kelvin and Voigt.
"""

from __future__ import annotations

from collections.abc import Sequence

from rbjax.errors import InputError
from rbjax.flexible.strain.basis import product
from rbjax.flexible.strain.beam_joint import StrainBeam
from rbjax.flexible.strain.shape import STRAINS
from rbjax.lanes import Lane, inner, mul
from rbjax.lanes import total as sum_of

Rows = Sequence[Sequence[Lane]]


def stiffness_matrix(beam: StrainBeam, C: Rows | Sequence[Rows], length: Lane) -> list[list[Lane]]:
    """Compute the stiffness matrix K of the coordinates, or with viscosities the damping matrix.

    Args:
        beam: the kind of joint.
        C: stiffness of the section: six lanes (the diagonal), or (6, 6) lanes; or a list of these,
            one for each Gauss point. Stiffness of curvature in N m^2, of Gamma in N. Of a tapered
            beam with six Gauss points, (6, 6) are six diagonals.
        length: the length of the beam, m.

    Returns:
        (n, n) lanes. Entries that are structurally zero are literals.

    Raises:
        InputError: C is neither of these.

    Source: Mathew, Feliu-Talegon, Alkayas, Boyer & Renda, IJRR 44(2), 2025, section 4.

    Example:
        >>> from rbjax.flexible.strain import strain_beam
        >>> stiffness_matrix(strain_beam({"k_z": 1}), [0.0, 0.0, 6.0, 0.0, 0.0, 0.0], 2.0)
        [[12.0, 0.0], [0.0, 4.0]]
    """
    stations = _stations(beam, C)
    if len(stations) == 1:

        def term(i: int, c: int, j: int, d: int) -> Lane:
            share = product(beam.shapes[i][c], beam.shapes[j][d])
            return mul(mul(length, stations[0][c][d]), share) if share else 0.0
    else:

        def term(i: int, c: int, j: int, d: int) -> Lane:
            points = zip(beam.weights, beam.shape_values, strict=True)
            shares = [w * at[i][c] * at[j][d] for w, at in points]
            return mul(length, inner(shares, [at[c][d] for at in stations]))

    def entry(i: int, j: int) -> Lane:
        return sum_of(term(i, c, j, d) for c in beam.shapes[i] for d in beam.shapes[j])

    return [[entry(i, j) for j in range(beam.coordinates)] for i in range(beam.coordinates)]


def elastic_energy(K: Rows, q: Sequence[Lane]) -> Lane:
    """Compute the elastic energy q^T K q / 2, J.

    Args:
        K: the stiffness matrix (n, n).
        q: the coordinates (n,).

    Example:
        >>> elastic_energy([[12.0, 0.0], [0.0, 4.0]], [1.0, 2.0])
        14.0
    """
    return mul(0.5, sum_of(mul(x, inner(row, q)) for x, row in zip(q, K, strict=True)))


def _stations(beam: StrainBeam, C: Rows | Sequence[Rows]) -> list[list[list[Lane]]]:
    """Return C (6, 6) at each Gauss point, or once if it is constant."""
    n, points = len(STRAINS), beam.shape.points
    shape = _shape(C)
    if shape == (n,):
        return [_diagonal(C)]
    if shape == (points, n) and (beam.shape.tapered or points != n):
        return [_diagonal(at) for at in C]
    if shape == (n, n):
        return [[list(row) for row in C]]
    if shape == (points, n, n):
        return [[list(row) for row in at] for at in C]
    raise InputError(
        f"stiffness_matrix: C has the shape {shape}, expected (6,), (6, 6), or for each of the "
        f"{points} Gauss points, ({points}, 6) or ({points}, 6, 6)"
    )


def _shape(x: object) -> tuple[int, ...]:
    if hasattr(x, "shape"):
        return tuple(x.shape)
    return (len(x), *_shape(x[0])) if isinstance(x, (list, tuple)) and x else ()


def _diagonal(values: Sequence[Lane]) -> list[list[Lane]]:
    return [[x if i == j else 0.0 for j in range(len(values))] for i, x in enumerate(values)]
