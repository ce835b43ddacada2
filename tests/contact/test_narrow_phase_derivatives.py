"""Derivatives of contacts by the poses of both shapes, at generic and at singular poses."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.geometry.narrow_phase import PAIRS
from rbjax.lanes import quaternion_matrix
from tests.contact.test_narrow_phase import SIZES, arrays


def turned(x: jax.Array) -> jax.Array:
    """A rotation matrix with the derivative of the rotation vector at 0."""
    return jnp.stack(list(quaternion_matrix(1.0, *(x / 2)))).reshape(3, 3)


def outputs(kinds: tuple[str, str], pose: jax.Array, x: jax.Array) -> jax.Array:
    """Distance, position and frame of all candidates, of poses (2, 12) moved by x (2, 6). A
    candidate is zero if it does not exist."""
    p, R = pose[:, :3], pose[:, 3:].reshape(2, 3, 3)
    moved = [
        (p[k] + x[k, 3:], turned(x[k, :3]) @ R[k], jnp.asarray(SIZES[kind], x.dtype))
        for k, kind in enumerate(kinds)
    ]
    distance, position, frame, exists = arrays(PAIRS[kinds], *moved, 1.0)
    columns = jnp.concatenate([distance[:, None], position, frame.reshape(-1, 9)], 1)
    return jnp.where(exists[:, None], columns, 0.0)


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


@pytest.mark.parametrize("kinds", [k for k in PAIRS if not {"mesh", "hfield"} & {*k}], ids="-".join)
def test_derivatives_at_generic_poses(kinds) -> None:
    """Central differences of all candidates. Features change at a pose if differences of two widths
    are unequal."""

    def both(pose, x, dx):
        return jax.jvp(functools.partial(outputs, kinds, pose), (x,), (dx,))

    f = jax.jit(jax.vmap(rb.threads(both)))
    pose = jnp.asarray(poses(20))
    d = jnp.asarray(np.random.default_rng(0).normal(size=(20, 2, 6)))
    tangent = f(pose, 0 * d, d)[1]
    wide, narrow = (
        np.asarray(f(pose, h * d, d)[0] - f(pose, -h * d, d)[0]) / (2 * h) for h in (1e-6, 3e-7)
    )
    inside = np.abs(wide - narrow).reshape(20, -1).max(1) < 1e-6
    assert inside.mean() > 0.85
    np.testing.assert_allclose(tangent[inside], narrow[inside], atol=1e-6)


@pytest.mark.parametrize("kinds", SINGULAR, ids="-".join)
def test_reverse_mode_equals_forward_mode(kinds) -> None:
    _, forward, reverse = programs(kinds, jnp.float64)
    pose, zero = jnp.asarray(poses(20)), jnp.zeros((20, 2, 6))
    np.testing.assert_allclose(reverse(pose, zero), forward(pose, zero), atol=1e-10)


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
