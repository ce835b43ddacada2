"""Twists, wrenches and inertias as arrays, against matrices written out in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import spatial
from rbjax.errors import InputError
from rbjax.rotations import se3, so3
from rbjax.spatial import MassProperties
from tests.tolerances import F64_IDENTITY, F64_ROUNDING, GRADIENT, relative_error

RNG = np.random.default_rng(3)


def skew(r) -> np.ndarray:
    x, y, z = r
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def blocks(a, b, c, d) -> np.ndarray:
    return np.block([[a, b], [c, d]])


def close(got, want, tolerance=F64_ROUNDING) -> bool:
    return bool(relative_error(got, want) <= tolerance)


O, ONE = np.zeros((3, 3)), np.eye(3)
R = np.asarray(so3.random(jax.random.key(1)))
p, d, omega = RNG.normal(size=(3, 3))
T = np.block([[R, p[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
V, W, F, G = RNG.normal(size=(4, 6))
MASS, COM = 1.7, RNG.normal(size=3)
_half = RNG.normal(size=(3, 3))
INERTIA = _half @ _half.T + 3 * ONE
SPATIAL = blocks(
    INERTIA + MASS * skew(COM) @ skew(COM).T, MASS * skew(COM), -MASS * skew(COM), MASS * ONE
)


def test_plucker_transforms_are_their_matrices() -> None:
    X, star = blocks(R, O, skew(p) @ R, R), blocks(R, skew(p) @ R, O, R)
    assert close(spatial.motion_transform(T), X)
    assert close(spatial.force_transform(T), star)
    assert close(spatial.transform_motion(T, V), X @ V)
    assert close(spatial.transform_force(T, F), star @ F)
    assert close(star, np.linalg.inv(X).T)  # what they are for: the power is the same
    moved = spatial.power(spatial.transform_force(T, F), spatial.transform_motion(T, V))
    assert close(moved, F @ V) and close(spatial.power(F, V), F @ V)


def test_cross_products_are_their_matrices() -> None:
    w, v = skew(V[:3]), skew(V[3:])
    assert close(spatial.motion_cross_matrix(V), blocks(w, O, v, w))
    assert close(spatial.force_cross_matrix(V), blocks(w, v, O, w))
    assert close(spatial.motion_cross(V, W), blocks(w, O, v, w) @ W)
    assert close(spatial.force_cross(V, F), blocks(w, v, O, w) @ F)


def test_cross_products_are_rates_of_what_a_frame_carries() -> None:
    """d/dt of X m and X* f at t = 0, for the frame exp(t V)."""

    def carried(t):
        T = se3.exp(t * V)
        return spatial.transform_motion(T, W), spatial.transform_force(T, F)

    rates = jax.jit(lambda t: jax.jvp(carried, (t,), (1.0,))[1])(0.0)
    assert close(rates[0], spatial.motion_cross(V, W)) and close(
        rates[1], spatial.force_cross(V, F)
    )


def test_extended_operators() -> None:
    assert close(spatial.extended_rotation(R), blocks(R, O, O, R))
    assert close(spatial.extended_translation(p), blocks(ONE, O, skew(p), ONE))
    assert close(spatial.extended_cross(omega), blocks(skew(omega), O, O, skew(omega)))


def test_wrenches_merge_as_their_forces_do() -> None:
    forces, points, couples = RNG.normal(size=(3, 5, 3))
    want = sum(
        np.r_[c + np.cross(x - d, f), f] for f, x, c in zip(forces, points, couples, strict=True)
    )
    wrenches = np.concatenate([couples, forces], -1)
    assert close(spatial.merge_wrenches(wrenches, points, d), want)
    assert close(spatial.force_at(forces, points).sum(0)[:3], np.cross(points, forces).sum(0))
    there = spatial.wrench_at(F, d)
    assert close(there, np.r_[F[:3] - np.cross(d, F[3:]), F[3:]])
    assert close(spatial.twist_at(V, d), np.r_[V[:3], V[3:] + np.cross(V[:3], d)])
    assert close(spatial.power(there, spatial.twist_at(V, d)), F @ V)


def test_central_axis_of_a_wrench() -> None:
    line = spatial.central_axis(F)
    at = spatial.wrench_at(F, line.point)  # on the line, couple and force are parallel
    assert close(at[:3], line.pitch * F[3:]) and close(at[3:], line.magnitude * line.axis)
    couple = spatial.central_axis(np.r_[F[:3], 0, 0, 0])
    assert np.isinf(couple.pitch) and close(couple.magnitude, np.linalg.norm(F[:3]))


def test_spatial_inertia_and_back() -> None:
    assert close(spatial.spatial_inertia(MASS, COM, INERTIA), SPATIAL)
    back = spatial.mass_properties(SPATIAL)
    assert close(back.mass, MASS) and close(back.com, COM) and close(back.inertia, INERTIA)
    assert close(spatial.momentum(SPATIAL, V), SPATIAL @ V)
    assert close(spatial.kinetic_energy(SPATIAL, V), V @ SPATIAL @ V / 2)


def test_inertia_moves_with_its_frame() -> None:
    star = blocks(R, skew(p) @ R, O, R)
    want = star @ SPATIAL @ star.T
    assert close(spatial.transform_inertia(T, SPATIAL), want)
    moved = spatial.transform_properties(T, MASS, COM, INERTIA)
    assert close(spatial.spatial_inertia(*moved), want)
    assert close(spatial.rotate_inertia(R, INERTIA), R @ INERTIA @ R.T)
    assert close(spatial.parallel_axes(INERTIA, MASS, d), INERTIA - MASS * skew(d) @ skew(d))
    six = RNG.normal(size=(6, 6))
    six = six @ six.T  # added mass: symmetric, and no more than that
    assert close(spatial.transform_inertia(T, six), star @ six @ star.T)


def test_principal_axes() -> None:
    found = spatial.principal_axes(INERTIA)
    assert close(found.R @ np.diag(found.moments) @ found.R.T, INERTIA)
    assert close(np.linalg.det(found.R), 1.0)
    direction = np.array([[1.0, 0.3, -0.2], [0.3, 0.5, 0.1], [-0.2, 0.1, -0.4]])
    step = 6e-6
    rate = jax.jit(lambda S: jax.jvp(spatial.principal_axes, (S,), (direction,))[1])(INERTIA)
    ends = [spatial.principal_axes(INERTIA + s * step * direction) for s in (-1, 1)]
    for k in range(2):
        want = (np.asarray(ends[1][k]) - np.asarray(ends[0][k])) / (2 * step)
        assert close(rate[k], want, GRADIENT)


def test_principal_axes_of_a_ball_are_flagged_and_finite() -> None:
    found = spatial.principal_axes(2 * ONE)
    assert found.gap == 0 and close(found.moments, [2, 2, 2])
    rate = jax.jit(lambda S: jax.jvp(spatial.principal_axes, (S,), (ONE,))[1])(2 * ONE)
    assert np.isfinite(rate.R).all() and close(rate.moments, [1, 1, 1])


# ------------------------------------------------------------------- physical consistency


def cloud() -> MassProperties:
    x, m = RNG.uniform(-1, 1, (8, 3)), RNG.uniform(0.1, 1, 8)
    return spatial.shapes.points(x, m)


def test_pseudo_inertia_is_the_second_moment() -> None:
    x, m = RNG.normal(size=(8, 3)), RNG.uniform(0.1, 1, 8)
    h = np.c_[x, np.ones(8)]
    body = spatial.shapes.points(x, m)
    P = (m[:, None, None] * h[:, :, None] * h[:, None, :]).sum(0)
    assert close(spatial.pseudo_inertia(*body), P)
    for got, want in zip(spatial.from_pseudo_inertia(P), body, strict=True):
        assert close(got, want, F64_IDENTITY)


@pytest.mark.parametrize(
    ("mass", "moments", "expected"),
    [
        (1.0, [1.0, 1.5, 2.0], (True, True, True)),
        (1.0, [1.0, 1.0, 2.0], (True, True, False)),  # a disc: no volume
        (1.0, [1.0, 1.0, 2.5], (True, False, False)),
        (1.0, [-1.0, 2.0, 2.0], (False, False, False)),
        (-1.0, [1.0, 1.0, 1.0], (False, True, False)),
        (0.0, [1.0, 1.0, 1.0], (False, True, False)),
    ],
)
def test_consistency(mass, moments, expected) -> None:
    found = jax.jit(spatial.consistency)(mass, R @ np.diag(moments) @ R.T)
    assert tuple(bool(x) for x in found[:3]) == expected
    # the pseudo-inertia says the same in one matrix
    P = spatial.pseudo_inertia(mass, COM, R @ np.diag(moments) @ R.T)
    assert (np.linalg.eigvalsh(P).min() > 1e-12) == expected[2]


def test_what_fits_into_an_ellipsoid() -> None:
    """A cloud inside a ball passes; the same cloud moved out of it does not."""
    body = cloud()
    size = np.sqrt(3.0) * np.ones(3)
    assert spatial.ellipsoid_margin(*body, size, np.zeros(3)) > 0
    assert spatial.ellipsoid_margin(*body, size, np.array([4.0, 0, 0])) < 0
    shell = spatial.shapes.points(np.vstack([ONE, -ONE]), np.ones(6))
    assert abs(spatial.ellipsoid_margin(*shell, np.ones(3), np.zeros(3))) < 1e-15


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((-1.0, COM, ONE), ["mass is -1", "above zero"]),
        ((1.0, COM, np.diag([1.0, 1, 3])), ["1, 1, 3", "triangle inequality"]),
        ((1.0, COM, np.diag([-1.0, 1, 1])), ["-1, 1, 1", "none below zero"]),
        ((1.0, COM, ONE + skew(COM)), ["transpose", "symmetric"]),
        ((1.0, COM[:2], ONE), ["com", "shape (2,)"]),
    ],
)
def test_what_is_no_inertia_is_refused_in_a_sentence(arguments, words) -> None:
    with pytest.raises(InputError) as caught:
        spatial.check_mass_properties(*arguments)
        spatial.spatial_inertia(*arguments)
    for word in words:
        assert word in str(caught.value)
    if "com" not in words:  # in traced code the numbers pass through, and `consistency` flags them
        jax.jit(spatial.check_mass_properties)(*arguments)


def test_a_thin_rod_and_a_particle_are_bodies() -> None:
    """Moments may vanish, and be negative by rounding."""
    for moments in ([0.0, 1.0, 1.0], [-1e-16, 1.0, 1.0], [0.0, 0.0, 0.0]):
        spatial.check_mass_properties(1.0, COM, np.diag(moments))


def test_batches_and_single_precision() -> None:
    """Leading axes are vmap; f32 stays f32."""
    Ts = se3.exp(RNG.normal(size=(4, 6)))
    batch = spatial.transform_motion(Ts, V)
    assert close(batch, jax.vmap(spatial.transform_motion, (0, None))(Ts, V))
    inertias = spatial.spatial_inertia(np.arange(1.0, 5), COM, INERTIA)
    assert inertias.shape == (4, 6, 6)
    assert spatial.transform_inertia(Ts, inertias).shape == (4, 6, 6)
    single = spatial.force_transform(jnp.asarray(T, jnp.float32))
    assert single.dtype == jnp.float32
    assert relative_error(single, spatial.force_transform(T)) < 1e-6
