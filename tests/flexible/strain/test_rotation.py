"""Rotation over a cell: order of the Magnus expansion, and derivatives of the exponential."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from rbjax.flexible.strain import rotation, strain_beam
from rbjax.flexible.strain.basis import legendre
from rbjax.lanes import Vec3

CURVATURE = np.random.default_rng(0).normal(size=(3, 4)) * 2  # coefficients of x, y, z


def integrated(length: float) -> np.ndarray:
    """Integrate R' = R [k] to a given part of a beam of length 1, tightly."""

    def rate(s, y):
        x, y_, z = CURVATURE @ legendre(3, s)
        return (y.reshape(3, 3) @ [[0, -z, y_], [z, 0, -x], [-y_, x, 0]]).ravel()

    found = solve_ivp(rate, (0, length), np.eye(3).ravel(), "DOP853", rtol=1e-13, atol=1e-14)
    return found.y[:, -1].reshape(3, 3)


def test_rotation_converges_with_order_six():
    """Over n equal cells the error falls as n^-6. Here a cell ends at each frame of `Cells`."""
    from rbjax.flexible.strain.section_rotations import Cells

    k = [list(map(float, row)) for row in CURVATURE]
    errors, want = [], integrated(1.0)
    for n in (4, 8, 16):
        ends = np.arange(1, n + 1) / n
        cells = Cells(3, ends, (), (), (0, 1, 2))
        R = cells.sections(k, columns=False)[-1].R
        errors.append(np.abs(np.array([float(x) for x in R]).reshape(3, 3) - want).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders > 5.7) & (orders < 6.6)).all(), (errors, orders)


def test_a_frame_branches_off_from_the_node_before_it():
    places = (0.07, 0.5, 0.93)
    beam = strain_beam({"k_x": 3, "k_y": 3, "k_z": 3}, points=12, frames=places)
    poses = beam.poses(list(map(float, CURVATURE.ravel())), beam.defaults)
    for place, at in zip((1.0, *places), poses[beam.tip :], strict=True):
        R = np.array([float(x) for x in at.R]).reshape(3, 3)
        assert np.abs(R - integrated(place)).max() < 2e-6  # the order of twelve cells


def test_exponential_and_its_coefficients():
    """To an angle of 4 rad, against scipy and Stumpff's closed forms."""
    rng = np.random.default_rng(1)
    for angle in (0.0, 1e-9, 0.3, 2.0, 3.1, 4.0):
        v = rng.normal(size=3)
        v *= angle / np.linalg.norm(v)
        c = rotation.stumpff_series(jnp.asarray(v @ v))
        R = np.array([float(x) for x in rotation.exponential(Vec3(*v), c)]).reshape(3, 3)
        assert np.abs(R - Rotation.from_rotvec(v).as_matrix()).max() < 2e-14
        if angle > 0.1:
            t = angle
            closed = (np.sin(t) / t, (1 - np.cos(t)) / t**2, (t - np.sin(t)) / t**3)
            assert np.abs(np.array(c[:3]) - closed).max() < 1e-14


def test_single_precision():
    v = np.array([1.0, -2.0, 3.0], np.float32)
    c = rotation.stumpff_series(jnp.asarray(v @ v))
    R = np.array([*rotation.exponential(Vec3(*map(jnp.asarray, v)), c)]).reshape(3, 3)
    assert R.dtype == np.float32
    assert np.abs(R - Rotation.from_rotvec(v).as_matrix()).max() < 1e-6


def test_rates_are_the_derivatives():
    """w = J O' and its rate, against two nested jvps of the rotation."""
    rng = np.random.default_rng(2)
    O, d, dd = jnp.asarray(rng.normal(size=(3, 3)))

    def R(t):
        v = Vec3(*(O + t * d + t * t / 2 * dd))
        return jnp.stack([*rotation.exponential(v, rotation.stumpff_series(v.dot(v)))])

    one = jnp.asarray(1.0)
    dR = lambda t: jax.jvp(R, (t,), (one,))[1]  # noqa: E731
    at = jnp.asarray(0.0)
    first, second = jax.jvp(dR, (at,), (one,))
    R0 = R(at).reshape(3, 3)
    W = first.reshape(3, 3) @ R0.T
    A = second.reshape(3, 3) @ R0.T - W @ W
    v, v1, v2 = Vec3(*O), Vec3(*d), Vec3(*dd)
    c = rotation.stumpff_series(v.dot(v))
    w = np.array([*rotation.angular_velocity(v, v1, c)])
    alpha = np.array([*rotation.angular_acceleration(v, v1, v2, c)])
    J = np.array([*rotation.left_jacobian(v, c)]).reshape(3, 3)
    assert np.abs(w - np.array([W[2, 1], W[0, 2], W[1, 0]])).max() < 1e-14
    assert np.abs(w - J @ d).max() < 1e-14
    assert np.abs(alpha - np.array([A[2, 1], A[0, 2], A[1, 0]])).max() < 1e-14
