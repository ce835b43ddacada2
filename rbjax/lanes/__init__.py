"""Lanes: the scalars, small vectors and matrices of the algorithms.

    algebra           lanes, Vec3, Mat3, Sym3; literal zeros and ones vanish
    arrays            packing of lanes, products without `dot`, extreme entries, maps over rows
    factorization     L D L^T and L U of small matrices, regularization of singular ones
    primitives        fusion barrier, batch axis, inverse, cosine and sine

This package has no frames and no physics.
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
    safe_sqrt,
    sub,
    total,
)
from rbjax.lanes.arrays import matmat, matrix_transpose, matvec, outer, pack, unpack
from rbjax.lanes.factorization import LDLT, LU, elimination_order, ldlt, lu
from rbjax.lanes.primitives import (
    batch_first,
    batch_last,
    fusion_barrier,
    horner,
    inverse,
    polynomial_sincos,
    sincos,
)

__all__ = [
    "LDLT",
    "LU",
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
    "lu",
    "matvec",
    "matmat",
    "matrix_transpose",
    "mul",
    "neg",
    "outer",
    "pack",
    "polynomial_sincos",
    "quaternion_matrix",
    "rotation_z",
    "safe_sqrt",
    "sincos",
    "sub",
    "total",
    "unpack",
]

__dir__ = __all__.copy
