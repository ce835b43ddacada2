"""Lanes: the scalars, small vectors and matrices of the algorithms.

    algebra           lanes, Vec3, Mat3, Sym3; literal zeros and ones vanish
    products          stacks of matrices, without `dot`
    fusion_barrier    a point where XLA's CPU compiler computes values once and stores them
    ldlt              L D L^T of small symmetric matrices
    extremes          the smallest and largest entry, with finite derivatives
    inverse           inverses of small matrices, real or complex
    proximal          how singular systems are regularized
    sincos            cosine and sine by polynomials
    batch_axis        the position of a result's batch under `vmap`

This package knows no frames and no physics.
"""

from rbjax.lanes.algebra import (
    Lane,
    Lanes,
    Mat3,
    Sym3,
    Vec3,
    add,
    as_arrays,
    inner,
    is_literal,
    is_zero,
    mul,
    neg,
    quaternion_matrix,
    rotation_z,
    sub,
    total,
)
from rbjax.lanes.barriers import fusion_barrier
from rbjax.lanes.batch_axis import batch_first, batch_last
from rbjax.lanes.factorization import LDLT, elimination_order, ldlt
from rbjax.lanes.inversion import inverse
from rbjax.lanes.products import matmat, matrix_transpose, matvec, outer
from rbjax.lanes.trigonometry import horner, polynomial_sincos, sincos

__all__ = [
    "LDLT",
    "Lane",
    "Lanes",
    "Mat3",
    "Sym3",
    "Vec3",
    "add",
    "as_arrays",
    "batch_first",
    "batch_last",
    "elimination_order",
    "fusion_barrier",
    "horner",
    "inner",
    "inverse",
    "is_literal",
    "is_zero",
    "ldlt",
    "matvec",
    "matmat",
    "matrix_transpose",
    "mul",
    "neg",
    "outer",
    "polynomial_sincos",
    "quaternion_matrix",
    "rotation_z",
    "sincos",
    "sub",
    "total",
]
