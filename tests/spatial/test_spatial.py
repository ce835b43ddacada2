"""Spatial algebra against the 6 by 6 matrices of Featherstone's chapter 2."""

import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.lanes import Mat3, Sym3, Vec3, is_zero, quaternion_matrix
from rbjax.spatial import ArticulatedInertia, Force, Motion, RigidInertia, Transform
from tests.tolerances import F64_ROUNDING, relative_error

RNG = np.random.default_rng(0)


def lanes(x):
    return [jnp.asarray(a) for a in np.ravel(x)]


def array(x) -> np.ndarray:
    return np.array([float(a) for a in x])


def skew(r) -> np.ndarray:
    x, y, z = r
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def columns(f, kind) -> np.ndarray:
    """The matrix of a linear map of motions or forces."""
    return np.stack([array(f(kind.from_lanes(lanes(e)))) for e in np.eye(6)], -1)


def close(got, want) -> bool:
    return relative_error(got, want) <= F64_ROUNDING


R = array(quaternion_matrix(*RNG.normal(size=4))).reshape(3, 3)
P = RNG.normal(size=3)
X = Transform(Mat3(*lanes(R)), Vec3(*lanes(P)))
MATRIX = np.block([[R.T, np.zeros((3, 3))], [-R.T @ skew(P), R.T]])  # X_CP, (2.24)
MASS, COM = 1.7, RNG.normal(size=3)
_half = RNG.normal(size=(3, 3))
INERTIA = _half @ _half.T  # about the frame's origin, to be read as any symmetric matrix
RIGID = RigidInertia(jnp.asarray(MASS), Vec3(*lanes(MASS * COM)), Sym3.upper(Mat3(*lanes(INERTIA))))
_six = RNG.normal(size=(6, 6))
SIX = _six @ _six.T
ARTICULATED = ArticulatedInertia(
    Sym3.upper(Mat3(*lanes(SIX[:3, :3]))),
    Mat3(*lanes(SIX[:3, 3:])),
    Sym3.upper(Mat3(*lanes(SIX[3:, 3:]))),
)


def test_transforms() -> None:
    assert close(columns(X, Motion), MATRIX)
    assert close(columns(X.T, Force), MATRIX.T)
    assert close(columns(X.motion_to_parent, Motion), np.linalg.inv(MATRIX))
    assert close(columns(X.then(X), Motion), MATRIX @ MATRIX)
    assert close(array(X.E), R.T.ravel())


def test_cross_products() -> None:
    v = RNG.normal(size=6)
    motion = Motion.from_lanes(lanes(v))
    crm = np.block([[skew(v[:3]), np.zeros((3, 3))], [skew(v[3:]), skew(v[:3])]])  # (2.31)
    assert close(columns(motion.cross, Motion), crm)
    assert close(columns(motion.cross_force, Force), -crm.T)


def test_vectors() -> None:
    a, b = RNG.normal(size=(2, 6))
    m, f = Motion.from_lanes(lanes(a)), Force.from_lanes(lanes(b))
    assert close(float(m.dot(f)), a @ b)
    assert close(array(m + m - (-m) * 0.5), 2.5 * a) and close(array(0.5 * f), 0.5 * b)
    assert all(map(is_zero, Motion.zero())) and repr(m).startswith("Motion(ang=")


@pytest.mark.parametrize(
    ("inertia", "matrix"),
    [
        (RIGID, np.block([[INERTIA, MASS * skew(COM)], [-MASS * skew(COM), MASS * np.eye(3)]])),
        (RIGID.articulated(), None),
        (ARTICULATED, SIX),
    ],
    ids=["rigid", "rigid as articulated", "articulated"],
)
def test_inertias(inertia, matrix) -> None:
    if matrix is None:
        matrix = columns(RIGID, Motion)
    turn = np.kron(np.eye(2), R)
    shift = np.block([[np.eye(3), skew(P)], [np.zeros((3, 3)), np.eye(3)]])
    rotation, arm = Mat3(*lanes(R)), Vec3(*lanes(P))
    assert close(columns(inertia, Motion), matrix)
    assert close(columns(inertia + inertia, Motion), 2 * matrix)
    assert close(columns(inertia.rotated(rotation), Motion), turn @ matrix @ turn.T)
    assert close(columns(inertia.shifted(arm), Motion), shift @ matrix @ shift.T)
    moved = (
        X.articulated_to_parent if isinstance(inertia, ArticulatedInertia) else X.rigid_to_parent
    )
    assert close(columns(moved(inertia), Motion), MATRIX.T @ matrix @ MATRIX)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("armature", [0.0, 0.3])
def test_inertia_across_a_joint(axis: int, armature: float) -> None:
    """I_A - U U^T / D, with a row of structural zeros where nothing is left along the axis."""
    S = Motion.from_lanes(np.eye(6)[axis].tolist())
    U = ARTICULATED(S)
    D = S.dot(U) + armature
    left = ARTICULATED.without(U, 1 / D, S, armature)
    u = SIX[:, axis]
    want = SIX - np.outer(u, u) / (SIX[axis, axis] + armature)
    assert relative_error(columns(left, Motion), want) <= 10 * F64_ROUNDING  # it cancels
    row = [array(left(Motion.from_lanes(e.tolist())))[axis] for e in np.eye(6)]
    assert armature or not np.any(row)


def test_nothing_weighs_nothing() -> None:
    zero = RigidInertia.zero()
    assert all(map(is_zero, zero(Motion.from_lanes(lanes(RNG.normal(size=6))))))
    assert close(columns(zero + RIGID, Motion), columns(RIGID, Motion))
