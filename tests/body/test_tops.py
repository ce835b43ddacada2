"""Spinning tops against Jacobi's elliptic functions and integrations in higher precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

from rbjax import body, spatial
from rbjax.body import Body, Situation, formulations
from rbjax.rotations import quaternion
from tests.body.motion import ATTITUDE_FREE, motion
from tests.oracles import load

FREE, HEAVY = load("torque_free_top"), load("heavy_top")
# The fast Dzhanibekov top magnifies what it finds in its first flip 3,000 times (its initial data:
# 20 times), so that half a unit in the last place of omega there, 4.4e-16, makes 1.4e-12 at 20 s,
# and the plain additions of 2,000 steps 2e-11. Compensated ones (`motion`) leave 1e-13 to 1e-12,
# and 4e-12 where R^T takes momentum or twist from world axes: rounding of the rates themselves,
# which falls with the root of the step.
TOLERANCE = 1e-11
STEP = 0.0025


class Pivot(eqx.Module):
    """The weight of a body that turns about a fixed point, seen from there: a couple c x m R^T g.

    The reaction of the pivot holds the point; the body is one with its centre of mass at the pivot
    and the inertia about it.
    """

    weight: jax.Array  # m g (3,), world
    arm: jax.Array  # c (3,), body

    def __call__(self, t, body, T, V):
        couple = jnp.cross(self.arm, (T[:3, :3].T * self.weight).sum(-1))
        return jnp.concatenate([couple, jnp.zeros(3)])

    def potential(self, body, T):
        return -(self.weight * (T[:3, :3] * self.arm).sum(-1)).sum()


def top_of(inertia, weight: float = 0.0) -> Situation:
    """A body that rotates about its origin; m g along -z acts at the arm e_y."""
    pull = Pivot(np.array([0.0, 0.0, -weight]), np.array([0.0, 1.0, 0.0]))
    return Situation(Body(np.array(1.0), np.zeros(3), np.asarray(inertia, float)), (pull,))


# A program each; the equations of these are those of others, about another point or in other axes
# (test_formulations.py runs every one).
ALIKE = {
    "newton_euler_origin", "spatial_body", "spatial_world", "momentum_body", "momentum_world",
    "quasi_lagrange", "newton_euler",
}  # fmt: skip
TOPS = [pytest.param(n, marks=pytest.mark.slow if n in ALIKE else ()) for n in ATTITUDE_FREE]


@pytest.mark.parametrize("name", TOPS)
def test_torque_free_and_heavy_top(name: str) -> None:
    """One program for both: the free top is one without weight.

    Torque-free: four cases at five times up to 20 s. Heavy (Geradin & Cardona): m = 15, 150 rad/s
    about its axis, after 2 s and some 48 turns.
    """
    f = formulations()[name]
    for label, case in FREE["cases"].items():
        V = np.r_[np.array(case["omega0"], float), 0, 0, 0]
        ts = [0.0, *map(float, case["samples"])]
        step = STEP if "fast" in label else np.inf
        T, V, _ = motion(f, top_of(np.diag(case["I"])), np.eye(4), V, ts, longest=step)
        for k, sample in enumerate(case["samples"].values(), 1):
            want = np.array(sample["omega_body"], float)
            assert np.abs(T[k, :3, :3] - sample["R"]).max() <= TOLERANCE, (label, ts[k])
            assert np.abs(V[k, :3] - want).max() <= TOLERANCE, (label, ts[k])

    inertia = spatial.parallel_axes(np.diag([0.234375, 0.46875, 0.234375]), 15.0, [0.0, 1.0, 0.0])
    top = top_of(inertia, 15 * 9.81)
    times = ("0.1", "0.5", "1.0", "1.5", "2.0")
    V = np.array([0.0, 150.0, -4.61538, 0, 0, 0])
    T, V, _ = motion(f, top, np.eye(4), V, [0.0, *map(float, times)])
    for k, t in enumerate(times, 1):
        sample = HEAVY["samples"][t]
        assert np.abs(T[k, :3, 1] - sample["x"]).max() <= 1e-9, t  # the centre of mass, R e_y
        assert np.abs(T[k, :3, :3] - sample["R"]).max() <= 1e-9, t
        assert np.abs(V[k, :3] - sample["Omega_body"]).max() <= 1e-9 * 150, t
    energy = [
        body.kinetic_energy(top.body, v) + body.potential_energy(top, t)
        for v, t in zip(V, T, strict=True)
    ]
    assert np.ptp(energy) <= 1e-11 * 5435.7


@pytest.mark.parametrize("spin", [1.0, 5.0])
def test_dzhanibekov_flips_in_time(spin: float) -> None:
    """omega_2 changes its sign every 2 K(k^2) / lambda, Landau & Lifshitz 37."""
    I = np.array([1.0, 2.0, 3.0])
    omega = np.array([1e-3, 1.0, 1e-3]) * spin
    twoE, L2 = I @ omega**2, I**2 @ omega**2
    A, B, C = I  # L2 < 2 E B or not decides about which axis it circles
    if twoE * B > L2:
        A, C = C, A
    rate = np.sqrt((C - B) * (L2 - twoE * A) / (A * B * C))
    k2 = (B - A) * (twoE * C - L2) / ((C - B) * (L2 - twoE * A))
    half = 2 * ellipk(k2) / rate
    V0, ts = np.r_[omega, 0, 0, 0], np.linspace(0, 100 / spin, 5001)
    _, V, _ = motion(formulations()["kirchhoff"], top_of(np.diag(I)), np.eye(4), V0, ts)
    w = V[:, 1]
    at = np.flatnonzero(np.sign(w[1:]) != np.sign(w[:-1]))
    assert len(at) >= 2
    zeros = []
    for i in at:  # Hermite: the crossing, to the fourth power of the step
        h = ts[i + 1] - ts[i]
        slope = [(I[2] - I[0]) * V[j, 0] * V[j, 2] / I[1] for j in (i, i + 1)]
        c = [w[i], h * slope[0], 0, 0]
        c[2] = 3 * (w[i + 1] - w[i]) - h * (2 * slope[0] + slope[1])
        c[3] = 2 * (w[i] - w[i + 1]) + h * (slope[0] + slope[1])
        roots = np.roots(c[::-1])
        roots = roots[np.isreal(roots)].real
        zeros.append(ts[i] + h * roots[(roots >= 0) & (roots <= 1)][0])
    assert np.abs(np.diff(zeros) - half).max() <= 1e-7 * half


def test_symmetric_top_has_a_closed_form() -> None:
    """omega turns about the axis at s = (I - J)/I omega_z, the attitude at two constant rates."""
    I, J = 2.0, 3.0
    wx, wy, wz = 0.4, -0.3, 1.2
    t, V0 = np.linspace(0, 10, 6), np.array([wx, wy, wz, 0, 0, 0])
    T, V, _ = motion(formulations()["kirchhoff"], top_of(np.diag([I, I, J])), np.eye(4), V0, t)
    s = (I - J) / I * wz
    want = np.stack([
        wx * np.cos(s * t) + wy * np.sin(s * t), -wx * np.sin(s * t) + wy * np.cos(s * t),
        np.full_like(t, wz),
    ], -1)  # fmt: skip
    assert np.abs(V[:, :3] - want).max() <= 1e-12
    p = np.sqrt(wx**2 + wy**2 + (wz * J / I) ** 2)
    half, turn = np.sin(p * t / 2) / p, s * t / 2
    e = np.stack([
        -(wz * J / I) * half * np.sin(turn) + np.cos(p * t / 2) * np.cos(turn),
        half * (wx * np.cos(turn) + wy * np.sin(turn)),
        half * (-wx * np.sin(turn) + wy * np.cos(turn)),
        (wz * J / I) * half * np.cos(turn) + np.cos(p * t / 2) * np.sin(turn),
    ], -1)  # fmt: skip
    assert np.abs(T[:, :3, :3] - quaternion.to_matrix(e)).max() <= 1e-12
