"""Exponential, logarithm and bracket of the groups, against SciPy's matrix functions."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, logm

import rbjax as rb
from rbjax.rotations import quaternion
from tests.tolerances import F64_ROUNDING

GROUP = rb.solvers.SE3()
SIZES = (0.0, 1e-9, 1e-3, 0.09, 0.11, 1.0, 3.0)


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def twist(u):
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = hat(u[0]), u[1]
    return out


def pose(y):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = quaternion.to_matrix(y[0]), y[1]
    return out


def draw(seed: int, size: float):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    u = (jnp.array(size * axis / np.linalg.norm(axis)), jnp.array(rng.normal(size=3)))
    y = (quaternion.normalize(jnp.array(rng.normal(size=4))), jnp.array(rng.normal(size=3)))
    return y, u


@pytest.mark.parametrize("size", SIZES)
def test_se3_is_the_matrix_exponential(size: float) -> None:
    y, u = draw(0, size)
    got = GROUP.retract(y, u)
    np.testing.assert_allclose(pose(got), pose(y) @ expm(twist(u)), atol=10 * F64_ROUNDING)
    back = GROUP.difference(y, got)
    for a, b in zip(back, u, strict=True):
        np.testing.assert_allclose(a, b, atol=20 * F64_ROUNDING)
    if 0.01 < size < 3:
        np.testing.assert_allclose(twist(back), np.real(logm(expm(twist(u)))), atol=1e-12)


def test_brackets_are_commutators() -> None:
    (_, u), (_, w) = draw(1, 0.7), draw(2, 1.3)
    a, b = twist(u), twist(w)
    np.testing.assert_allclose(twist(GROUP.bracket(u, w)), a @ b - b @ a, atol=F64_ROUNDING)
    so3 = rb.solvers.SO3().bracket(u[0], w[0])
    np.testing.assert_allclose(hat(so3), hat(u[0]) @ hat(w[0]) - hat(w[0]) @ hat(u[0]), atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 0.1, 1.0])
def test_derivatives_are_finite_and_right_at_every_size(size: float) -> None:
    y, u = draw(3, size)
    f = lambda u: jnp.concatenate(GROUP.difference(y, GROUP.retract(y, u)))  # noqa: E731
    jacobian = np.hstack(jax.jit(jax.jacfwd(f))(u))
    np.testing.assert_allclose(jacobian, np.eye(6), atol=1e-12)


@pytest.mark.slow
def test_a_constant_twist_is_followed_exactly() -> None:
    """A screw: one step of any method on the group, and dense output between."""
    y, u = draw(4, 1.1)
    term = rb.solvers.OnGroup(lambda t, y, args: u, GROUP)
    ts = jnp.array([0.3, 1.0])
    for solver in (rb.solvers.rkmk(4), rb.solvers.CommutatorFree4()):
        found = diffrax.diffeqsolve(term, solver, 0.0, 1.0, 1.0, y, saveat=diffrax.SaveAt(ts=ts)).ys
        for i, t in enumerate(ts):
            at = jax.tree.map(lambda x, i=i: x[i], found)
            want = pose(y) @ expm(twist(u) * float(t))
            np.testing.assert_allclose(pose(at), want, atol=1e-14)
