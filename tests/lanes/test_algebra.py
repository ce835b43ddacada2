"""The lanes' algebra is that of NumPy; structural zeros and ones leave no operation."""

import jax
import jax.numpy as jnp
import numpy as np

from rbjax import lanes
from rbjax.lanes import Mat3, Sym3, Vec3
from tests.tolerances import F64_ROUNDING, relative_error

RNG = np.random.default_rng(0)


def vec(x) -> Vec3:
    return Vec3(*(jnp.asarray(a) for a in x))


def mat(x) -> Mat3:
    return Mat3(*(jnp.asarray(a) for a in np.ravel(x)))


def sym(x) -> Sym3:
    return Sym3.upper(mat(x))


def dense(x) -> np.ndarray:
    """A Vec3, Mat3 or Sym3 as an array."""
    if isinstance(x, Sym3):
        x = x.dense
    out = np.array([float(a) for a in x])
    return out.reshape(3, 3) if len(out) == 9 else out


def close(got, want) -> bool:
    return relative_error(dense(got) if isinstance(got, lanes.Lanes) else got, want) <= F64_ROUNDING


def test_algebra_is_that_of_matrices() -> None:
    a, b = RNG.normal(size=(2, 3))
    A, B = RNG.normal(size=(2, 3, 3))
    S, s = B + B.T, 0.7
    assert close(vec(a) + vec(b), a + b) and close(vec(a) - vec(b), a - b) and close(-vec(a), -a)
    assert close(vec(a) * s, a * s) and close(s * vec(a), a * s)
    assert close(vec(a).dot(vec(b)), a @ b) and close(vec(a).cross(vec(b)), np.cross(a, b))
    assert close(Mat3.skew(vec(a)) @ vec(b), np.cross(a, b))
    assert close(mat(A) @ vec(a), A @ a) and close(mat(A) @ mat(B), A @ B) and close(mat(A).T, A.T)
    assert close(mat(A) @ sym(S), A @ S) and close(sym(S) @ vec(a), S @ a)
    assert close(sym(S).rotated(mat(A)), A @ S @ A.T)
    assert close(Sym3.outer(vec(a), vec(a) * 2.0), 2 * np.outer(a, a))
    assert close(Mat3.identity(), np.eye(3)) and close(Mat3.zero(), np.zeros((3, 3)))
    for rows, want in ((mat(A).rows, A), (mat(A).columns, A.T)):
        assert close(np.stack([dense(r) for r in rows]), want)


def test_rotations() -> None:
    q = RNG.normal(size=4)
    R = dense(lanes.quaternion_matrix(*q))
    assert close(R @ R.T, np.eye(3)) and np.linalg.det(R) > 0
    u = q / np.linalg.norm(q)
    angle, axis = 2 * np.arctan2(np.linalg.norm(u[1:]), u[0]), u[1:] / np.linalg.norm(u[1:])
    K = dense(Mat3.skew(vec(axis)))
    assert close(R, np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)
    assert close(lanes.rotation_z(np.cos(0.3), np.sin(0.3)) @ vec([1.0, 0, 0]),
                 [np.cos(0.3), np.sin(0.3), 0])  # fmt: skip


def test_zeros_and_ones_vanish() -> None:
    x = jnp.array(2.0)
    for zero in (lanes.mul(0.0, x), lanes.mul(x, 0.0), lanes.neg(0.0), lanes.inner((x,), (0.0,))):
        assert lanes.is_zero(zero)
    assert lanes.mul(1.0, x) is x and lanes.mul(x, 1) is x
    assert lanes.add(0.0, x) is x and lanes.add(x, 0.0) is x and lanes.sub(x, 0.0) is x
    assert float(lanes.sub(0.0, x)) == -2.0 and float(lanes.mul(-1.0, x)) == -2.0
    assert lanes.is_literal(1.0) and lanes.is_literal(0) and not lanes.is_literal(x)
    assert not lanes.is_zero(x) and lanes.total([]) == 0.0
    along_z = Vec3(0.0, 0.0, 1.0).cross(Vec3(x, x, x))
    assert lanes.is_zero(along_z[2])


def operations(f, *args) -> int:
    return len(jax.make_jaxpr(f)(*args).eqns)


def test_structure_costs_nothing() -> None:
    x = [jnp.array(float(i)) for i in range(9)]
    assert operations(lambda *a: tuple(Mat3.identity() @ Mat3(*a)), *x) == 0
    assert operations(lambda *a: tuple(Mat3(*a) @ Vec3(0.0, 0.0, 1.0)), *x) == 0
    turned = operations(lambda *a: tuple(lanes.rotation_z(a[0], a[1]) @ Vec3(*a[2:5])), *x[:5])
    assert turned <= 7  # four products, a sum, a difference, a sign
    assert operations(lambda *a: tuple(Mat3(*a) @ Mat3(*a)), *x) == 45


def test_pytrees_and_literals_in_them() -> None:
    v = Vec3(0.0, jnp.array(1.0), 2.0)
    doubled = jax.tree.map(lambda a: 2 * a, v)
    assert isinstance(doubled, Vec3) and list(map(float, doubled)) == [0.0, 2.0, 4.0]
    assert repr(Vec3(0.0, 1.0, 2.0)) == "Vec3(0.0, 1.0, 2.0)" and v[2] == 2.0
    out = lanes.as_arrays(v, jnp.zeros(5, jnp.float32))
    assert all(a.shape == (5,) and a.dtype == jnp.float32 for a in out)


def test_safe_sqrt_has_finite_derivatives_at_zero_and_keeps_nan() -> None:
    x = jnp.array([4.0, 1e-300, 0.0, -0.0, -1.0, jnp.inf, jnp.nan])
    want = np.array([2.0, 1e-150, 0.0, 0.0, 0.0, np.inf, np.nan])
    np.testing.assert_array_equal(np.asarray(lanes.safe_sqrt(x)), want)
    slope = jax.grad(lambda x: lanes.safe_sqrt(x).sum())(x[:5])
    np.testing.assert_allclose(slope, [0.25, 5e149, 0.0, 0.0, 0.0], rtol=1e-12)
    assert lanes.safe_sqrt(9.0) == 3.0 and isinstance(lanes.safe_sqrt(9.0), float)
    assert lanes.safe_sqrt(-1) == 0.0


def test_entrywise_product_keeps_structural_zeros() -> None:
    a, b = RNG.normal(size=(2, 3))
    assert np.array_equal(dense(vec(a).entrywise(vec(b))), a * b)
    assert vec(a).entrywise([0.0, 1.0, 2.0])[0] == 0.0
