"""Properties of spatial transforms for any frames: composition, inverse, duality, invariants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rbjax import spatial
from rbjax.lanes import matmat, matvec
from rbjax.rotations import se3

# A few dozen operations on numbers up to ten: an entry of X has the size of p, and products of two.
ROUNDING = 400
DTYPES = pytest.mark.parametrize(
    "dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)]
)
once = settings(max_examples=60, derandomize=True, deadline=None, database=None)

numbers = st.one_of(st.floats(-2, 2), st.sampled_from([0.0, 1e-12, np.pi, -np.pi, np.pi / 2]))
six = st.tuples(*[numbers] * 6).map(np.array)
three = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
mass = st.floats(0.1, 10)


@jax.jit
def pairs(x, y, V, W, F, m, com, moments):
    """name -> two roads to one quantity."""
    A, B = se3.exp(x), se3.exp(y)
    AB, back = se3.compose(A, B), se3.inverse(A)
    X, Xf = spatial.motion_transform, spatial.force_transform
    one = jnp.eye(6, dtype=V.dtype)
    I = spatial.spatial_inertia(m, com, jnp.diag(moments))
    there = spatial.transform_inertia(A, I)
    moved = spatial.transform_properties(A, m, com, jnp.diag(moments))
    seen = spatial.transform_motion(A, V)
    return {
        "composition of motions": (X(AB), matmat(X(A), X(B))),
        "composition of forces": (Xf(AB), matmat(Xf(A), Xf(B))),
        "inverse of motions": (matmat(X(A), X(back)), one),
        "inverse of forces": (matmat(Xf(A), Xf(back)), one),
        "forces are dual to motions": (Xf(A), X(back).T),
        "with and without the matrix": (seen, matvec(X(A), V)),
        "power is the same in all frames": (
            spatial.power(spatial.transform_force(A, F), seen), spatial.power(F, V),
        ),
        "kinetic energy is the same in all frames": (
            spatial.kinetic_energy(there, seen), spatial.kinetic_energy(I, V),
        ),
        "momentum is a force": (
            spatial.momentum(there, seen), spatial.transform_force(A, spatial.momentum(I, V)),
        ),
        "inertia of moved mass properties": (there, spatial.spatial_inertia(*moved)),
        "cross products transform": (
            spatial.motion_cross(seen, spatial.transform_motion(A, W)),
            spatial.transform_motion(A, spatial.motion_cross(V, W)),
        ),
        "V x V is zero": (spatial.motion_cross(V, V), 0 * V),
        "force cross is minus the transposed motion cross": (
            spatial.force_cross_matrix(V), -spatial.motion_cross_matrix(V).T,
        ),
    }  # fmt: skip


@DTYPES
@once
@given(x=six, y=six, V=six, W=six, F=six, m=mass, com=three, moments=three)
def test_identities(dtype, x, y, V, W, F, m, com, moments) -> None:
    given = (x, y, V, W, F, m, com, 1 + 0.3 * np.abs(moments))
    for name, (got, want) in pairs(*(np.asarray(a, dtype) for a in given)).items():
        assert got.dtype == want.dtype == dtype, name
        scale = 1.0 + np.abs(np.asarray(want, float)).max()
        error = np.abs(np.asarray(got, float) - np.asarray(want, float)).max()
        assert error <= ROUNDING * scale * np.finfo(dtype).eps, (name, error / scale)
