"""The identities of the cross-product operator and of its extension to six, both sides of each."""

import jax
import numpy as np
import pytest

from rbjax import spatial
from rbjax.rotations import se3, so3
from rbjax.spatial import operators as op
from tests.tolerances import F64_ROUNDING, relative_error

RNG = np.random.default_rng(8)
a, b, c = RNG.normal(size=(3, 3))
M = RNG.normal(size=(3, 3))
R = np.asarray(so3.random(jax.random.key(3)))
V, W, F = RNG.normal(size=(3, 6))
T, S = np.asarray(se3.exp(RNG.normal(size=(2, 6))))


def skew(r) -> np.ndarray:
    x, y, z = r
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


A, B, unit = skew(a), skew(b), a / np.linalg.norm(a)
X, star, adV = spatial.motion_transform, spatial.force_transform, spatial.motion_cross_matrix
rotation, shift, wide = (
    np.asarray(f(x))
    for f, x in (
        (spatial.extended_rotation, R),
        (spatial.extended_translation, a),
        (spatial.extended_cross, b),
    )
)

IDENTITIES = {
    "skew": (so3.hat(a), -so3.hat(a).T),
    "anticommutes": (so3.hat(a) @ b, -so3.hat(b) @ a),
    "double": (op.double_cross(a, b), A @ B),
    "of cross": (op.cross_of_cross(a, b), skew(np.cross(a, b))),
    "commutator": (op.cross_of_cross(a, b), A @ B - B @ A),
    "triple": (op.triple_cross(a, b), A @ B @ A),
    **{f"power {n}": (op.cross_power(a, n), np.linalg.matrix_power(A, n)) for n in range(1, 7)},
    "rotated": (op.rotated_cross(R, a), R @ A @ R.T),
    "congruent": (op.congruent_cross(M, a), M.T @ skew(M @ a) @ M),
    "sum": (op.cross_sum(M, a), A @ M + M.T @ A),
    "along": (op.along(a), np.outer(unit, unit)),
    "across": (op.across(a), np.eye(3) - np.outer(unit, unit)),
    "volume": (op.triple_product(a, b, c), np.linalg.det(np.stack([a, b, c]))),
    "cyclic": (op.triple_product(a, b, c), op.triple_product(c, a, b)),
    "Lagrange": (op.double_cross_product(a, b, c), np.cross(a, np.cross(b, c))),
    "Jacobi": (
        op.double_cross_product(a, b, c) + op.double_cross_product(b, c, a),
        -op.double_cross_product(c, a, b),
    ),
    # extended, six by six
    "translations add": (
        shift @ spatial.extended_translation(b),
        spatial.extended_translation(a + b),
    ),
    "translation back": (np.linalg.inv(shift), spatial.extended_translation(-a)),
    "rotation turns arm": (rotation @ shift @ rotation.T, spatial.extended_translation(R @ a)),
    "rotation orthogonal": (rotation.T @ rotation, np.eye(6)),
    "rotation turns cross": (rotation @ wide @ rotation.T, spatial.extended_cross(R @ b)),
    "X = T R": (
        X(T),
        spatial.extended_translation(T[:3, 3]) @ spatial.extended_rotation(T[:3, :3]),
    ),
    "X* = T^-T R": (
        star(T),
        spatial.extended_translation(-T[:3, 3]).T @ spatial.extended_rotation(T[:3, :3]),
    ),
    "X is a group": (X(T) @ X(S), X(T @ S)),
    "X* is a group": (star(T) @ star(S), star(T @ S)),
    "X X*^T": (X(T) @ star(T).T, np.eye(6)),
    "V x* = -(V x)^T": (spatial.force_cross_matrix(V), -adV(V).T),
    "X carries V x": (X(T) @ adV(V) @ np.linalg.inv(X(T)), adV(X(T) @ V)),
    "Jacobi of six": (adV(adV(V) @ W), adV(V) @ adV(W) - adV(W) @ adV(V)),
    "V x V": (adV(V) @ V, np.zeros(6)),
    "power does not change": (F @ adV(V) @ W, -(spatial.force_cross_matrix(V) @ F) @ W),
}


@pytest.mark.parametrize("name", IDENTITIES)
def test_identity(name: str) -> None:
    left, right = IDENTITIES[name]
    assert relative_error(left, right, floor=1.0) <= 2 * F64_ROUNDING


def test_rates_of_the_extended_operators() -> None:
    """Along T exp(t V), by differentiation."""

    def path(t):
        pose = se3.compose(T, se3.exp(t * V))
        return X(pose), star(pose), spatial.extended_rotation(pose[:3, :3])

    dX, dstar, dR = jax.jit(lambda: jax.jvp(path, (0.0,), (1.0,))[1])()
    assert relative_error(op.motion_transform_rate(T, V), dX) <= F64_ROUNDING
    assert relative_error(op.force_transform_rate(T, V), dstar) <= F64_ROUNDING
    turning = spatial.extended_rotation(T[:3, :3]) @ spatial.extended_cross(V[:3])
    assert relative_error(turning, dR) <= F64_ROUNDING
