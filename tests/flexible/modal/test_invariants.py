"""Inertia invariants against sums over points, and against a beam in closed form."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

from rbjax.errors import InputError, UnknownName
from rbjax.flexible.modal import from_points, inertia_invariants
from rbjax.rotations import so3
from tests.flexible.modal.points import energy, random_points

ROUNDING = 2e-14  # relative to the largest number: sums of 40 terms


def close(a, b, tolerance=ROUNDING):
    a, b = np.asarray(a), np.asarray(b)
    assert np.abs(a - b).max() <= tolerance * max(1.0, np.abs(b).max())


def skew(a):
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def test_invariants_are_sums_over_points():
    points = random_points(np.random.default_rng(0))
    found = inertia_invariants(**points)
    m, f, U, V, J = points.values()
    every, modes = range(len(m)), range(3)
    close(found.I1, sum(m))
    close(found.I2, sum(m[i] * f[i] for i in every))
    close(found.I3, sum(m[i] * U[i] for i in every))
    close(found.I4, sum(m[i] * skew(f[i]) @ U[i] + J[i] @ V[i] for i in every))
    close(found.I6, sum(m[i] * U[i].T @ U[i] + V[i].T @ J[i] @ V[i] for i in every))
    close(found.I7, sum(J[i] - m[i] * skew(f[i]) @ skew(f[i]) for i in every))
    for j in modes:
        close(found.I5[j], sum(m[i] * skew(U[i][:, j]) @ U[i] for i in every))
        close(found.I8[j], -sum(m[i] * skew(f[i]) @ skew(U[i][:, j]) for i in every))
        for k in modes:
            close(found.N[j, k], -sum(m[i] * skew(U[i][:, j]) @ skew(U[i][:, k]) for i in every))


def test_energy_is_that_of_the_points():
    rng = np.random.default_rng(1)
    points = random_points(rng)
    body = from_points(**points)
    for _ in range(3):
        state = [jnp.asarray(rng.normal(size=3)) for _ in range(4)]
        close(body.kinetic_energy(*state), energy(points, *state), 1e-14 * 40)


def test_a_mass_matrix_is_a_sum_over_pairs():
    """A bar with linear displacements: the consistent mass matrix is exact, the lumped one not."""
    length, mass = 2.0, 3.0
    places = np.array([[0.0, 0, 0], [length, 0, 0]])
    modes = np.zeros((2, 3, 2))
    modes[1, 1, 0], modes[0, 2, 1], modes[1, 2, 1] = 1.0, 1.0, -1.0
    matrix = mass / 6 * np.array([[2.0, 1], [1, 2]])
    x, weight = np.polynomial.legendre.leggauss(3)
    s, weight = (x + 1) / 2, weight / 2
    fine = np.stack([1 - s, s], 1)
    exact = inertia_invariants(mass * weight, fine @ places, np.einsum("pn,naj->paj", fine, modes))
    for given in (matrix, sp.csr_array(matrix)):
        for a, b in zip(inertia_invariants(given, places, modes), exact, strict=True):
            close(a, b)


def test_inertias_that_turn_with_their_points():
    """The first-order terms against the exact energy of rotated inertias, by differences."""
    rng = np.random.default_rng(2)
    points = random_points(rng, n=4)
    body = from_points(**points, turn_inertias=True)
    V, J = points["rotation_modes"], points["inertias"]
    w, q, qd = (rng.normal(size=3) for _ in range(3))

    def spin_energy(q):
        out = 0.0
        for i in range(4):
            phi = V[i] @ q
            R = np.asarray(so3.exp(phi))
            turn = w + np.asarray(so3.left_jacobian(phi)) @ V[i] @ qd
            out += turn @ R @ J[i] @ R.T @ turn / 2 - (V[i] @ qd) @ J[i] @ (V[i] @ qd) / 2
        return out

    # the modal mass is constant: only the terms with w can agree to first order
    def with_w(q):
        nonlocal w
        full = spin_energy(q)
        w, kept = 0 * w, w
        rest = spin_energy(q)
        w = kept
        return full - rest

    h = 1e-5
    slope = (with_w(h * q) - with_w(-h * q)) / (2 * h)
    heavy = body.replace(inertia1=body.inertia1 - from_points(**points).inertia1)
    c1 = body.coupling1 - from_points(**points).coupling1
    got = np.einsum("a,jab,b,j", w, heavy.inertia1, w, q) / 2 + w @ (np.asarray(c1) @ q) @ qd
    close(got, slope, 1e-9)  # differences of step 1e-5: truncation 1e-10, rounding 1e-11


def test_second_order_displacements():
    """Second-order places of points: energy to second order in q against the sum over points."""
    rng = np.random.default_rng(3)
    points = random_points(rng, n=10)
    points["rotation_modes"] *= 0
    A = 0.1 * rng.normal(size=(10, 3, 3, 3))
    A = A + A.transpose(0, 1, 3, 2)
    body = from_points(**points, second_modes=A, frames=[7])
    m, f, U, _, J = points.values()
    w, v, q, qd = (rng.normal(size=3) for _ in range(4))

    def exact(s):
        x = f + U @ (s * q) + np.einsum("najk,j,k->na", A, s * q, s * q) / 2
        u = v + np.cross(w, x) + U @ qd + np.einsum("najk,j,k->na", A, s * q, qd)
        return (m * (u**2).sum(-1)).sum() / 2 + w @ J.sum(0) @ w / 2

    def ours(s):
        return float(body.kinetic_energy(*map(jnp.asarray, (w, v, s * q, qd)), True))

    # both are polynomials in s. The terms that the body leaves out are A.U q' and A.A q' (order 1)
    # and A.U, A.A of higher order: with q' = 0 both agree to order 2.
    assert abs(ours(0.0) - exact(0.0)) < 1e-13 * abs(exact(0.0))
    qd = 0 * qd
    h = 1e-3
    for f_ in ((lambda g: g(h) - g(-h)), (lambda g: g(h) + g(-h) - 2 * g(0.0))):
        a, b = f_(ours), f_(exact)
        assert abs(a - b) < 1e-5 * abs(b) + 1e-11


def test_subset_of_modes_damping_and_names():
    rng = np.random.default_rng(4)
    points = random_points(rng, m=3)
    K = np.diag([1.0, 4.0, 9.0])
    body = from_points(**points, stiffness=K, frames=[0, 5])
    part = body.with_modes([2, 0])
    points["modes"], points["rotation_modes"] = (
        points["modes"][:, :, [2, 0]],
        points["rotation_modes"][:, :, [2, 0]],
    )
    direct = from_points(**points, stiffness=K[[2, 0]][:, [2, 0]], frames=[0, 5])
    names = ("first_moment1", "inertia1", "inertia2", "coupling", "coupling1", "modal_mass")
    for name in (*names, "modes"):
        close(getattr(part, name), getattr(direct, name))
    damped = body.with_damping(0.02)
    M, D = np.asarray(body.modal_mass), np.asarray(damped.damping)
    pole = np.linalg.eigvals(
        np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    )
    close(-pole.real / np.abs(pole), 0.02, 1e-12)
    assert body.frame("5") == 1
    with pytest.raises(UnknownName, match="'5'"):
        body.frame("6")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(places=np.zeros((3, 2))), "places"),
        (dict(masses=np.ones(4)), "masses"),
        (dict(masses=np.zeros(40)), "mass is 0"),
        (dict(modes=np.full((40, 3, 3), np.nan)), "not finite"),
        (dict(inertias=np.zeros((40, 3))), "inertias"),
        (dict(frames=[40]), "frames"),
        (dict(stiffness=np.zeros((2, 2))), "stiffness"),
    ],
)
def test_wrong_input_is_a_sentence(change, message):
    points = random_points(np.random.default_rng(0)) | change
    with pytest.raises(InputError, match=message):
        from_points(**points)
