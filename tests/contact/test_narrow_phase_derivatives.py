"""Derivatives of contacts by the poses of both shapes, at generic and at singular poses."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.contact.geometry.narrow_phase import PAIRS
from rbjax.lanes import quaternion_matrix
from tests.contact.test_narrow_phase import SIZES, arrays


def turned(x: jax.Array) -> jax.Array:
    """A rotation matrix with the derivative of the rotation vector at 0."""
    return jnp.stack(list(quaternion_matrix(1.0, *(x / 2)))).reshape(3, 3)


def outputs(kinds: tuple[str, str], pose: jax.Array, x: jax.Array) -> jax.Array:
    """Distance, position and frame of all candidates, of poses (2, 12) moved by x (2, 6)."""
    p, R = pose[:, :3], pose[:, 3:].reshape(2, 3, 3)
    moved = [
        (p[k] + x[k, 3:], turned(x[k, :3]) @ R[k], jnp.asarray(SIZES[kind], x.dtype))
        for k, kind in enumerate(kinds)
    ]
    distance, position, frame, _ = arrays(PAIRS[kinds], *moved, 1.0)
    return jnp.concatenate([distance[:, None], position, frame.reshape(-1, 9)], 1)


def poses(count: int) -> np.ndarray:
    """Generic poses (count, 2, 12), position and rotation, whose shapes are near each other."""
    rng = np.random.default_rng(4)
    out = np.zeros((count, 2, 12))
    out[:, 1, :3] = rng.normal(size=(count, 3))
    out[:, 1, :3] *= 0.25 / np.linalg.norm(out[:, 1, :3], axis=1, keepdims=True)
    for k in range(count):
        for i in range(2):
            R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            out[k, i, 3:] = (R * np.linalg.det(R)).ravel()
    return out


#: a rotation by 90 degrees about y
UPRIGHT = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
#: positions of the second shape at which two features are equally near, or centers coincide
SINGULAR = {
    ("plane", "sphere"): [(0, 0, 0)],
    ("plane", "capsule"): [(0, 0, 0.13), (0, 0, 0)],
    ("plane", "ellipsoid"): [(0, 0, 0)],
    ("plane", "cylinder"): [(0, 0, 0.09)],
    ("plane", "box"): [(0, 0, 0.14)],
    ("sphere", "sphere"): [(0, 0, 0)],
    ("sphere", "capsule"): [(0, 0, 0), (0, 0, 0.13)],
    ("sphere", "cylinder"): [(0, 0, 0), (0, 0, 0.09), (0.12, 0, 0.09)],
    ("sphere", "box"): [(0, 0, 0), (0.09, 0, 0), (0.09, 0.11, 0.14), (0.02, 0.01, 0)],
    ("capsule", "capsule"): [(0, 0, 0), (0.14, 0, 0), (0, 0, 0.4)],
    ("capsule", "cylinder"): [(0, 0, 0), (0.19, 0, 0), (0, 0, 0.29), (0.12, 0, 0.09), (0.12, 0, 0)],
    ("capsule", "box"): [(0, 0, 0), (0.09, 0, 0), (0.16, 0, 0), (0, 0, 0.34)],
}


@functools.cache
def programs(kinds: tuple[str, str], dtype: type) -> tuple:
    """The function and its two Jacobians, compiled."""
    f = functools.partial(outputs, kinds)
    forward, reverse = jax.jacfwd(f, 1), jax.jacrev(f, 1)
    return tuple(jax.jit(jax.vmap(g)) for g in (f, forward, reverse))


@pytest.mark.parametrize("kinds", SINGULAR, ids="-".join)
def test_derivatives_at_generic_poses(kinds) -> None:
    """Central differences, forward and reverse mode; features change at few of the poses."""
    f, forward, reverse = programs(kinds, jnp.float64)
    pose = jnp.asarray(poses(20))
    zero = jnp.zeros((20, 2, 6))
    J = np.asarray(forward(pose, zero))
    np.testing.assert_allclose(reverse(pose, zero), J, atol=1e-10)
    rng, h = np.random.default_rng(0), 1e-6
    d = jnp.asarray(rng.normal(size=(20, 2, 6)))
    there, back = f(pose, h * d), f(pose, -h * d)
    tangent = np.einsum("nijkl,nkl->nij", J, d)
    error = np.abs((there - back) / (2 * h) - tangent).reshape(20, -1).max(1)
    assert (error < 1e-6).mean() > 0.85, np.sort(error)


@pytest.mark.parametrize("kinds", SINGULAR, ids="-".join)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_derivatives_at_singular_poses_are_finite(kinds, dtype) -> None:
    """Coincident centers, parallel axes, centers on faces; the normal along z and along x."""
    rows = []
    for position in SINGULAR[kinds]:
        for R in (np.eye(3), UPRIGHT):
            rows.append([[0, 0, 0, *R.ravel()], [*(R @ position), *R.ravel()]])
    pose = jnp.asarray(rows, dtype)
    for g in programs(kinds, dtype):
        values = g(pose, jnp.zeros((len(rows), 2, 6), dtype))
        assert values.dtype == dtype and np.isfinite(values).all()
