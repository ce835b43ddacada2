"""Filtered torque equations and the zeros of encoders, on motions in closed form."""

import functools

import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid
from rbjax.errors import InputError, UnknownName

MODEL = rb.load("double_pendulum")
TERMS = ("armature", "viscous", "coulomb", "gear_loss")
SMOOTHING = 0.5
STRAIGHT = tuple(
    n for n in sysid.torque.parameter_names(MODEL, TERMS) if not n.endswith((".hx", ".hy"))
)
LOST = np.array([0.15, 0.1])


@functools.cache
def truth():
    pi = np.array(sysid.torque.parameter_values(MODEL, TERMS), float)
    pi[20:] = [0.02, 0.01, 0.1, 0.05, 0.3, 0.2, *LOST]
    return pi


@functools.cache
def run(name, zeros=(0.0, 0.0), seed=0, rate=250.0, seconds=6.0):
    """Sines below 1.5 Hz; encoders that read less than the angles by `zeros`."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1 / rate)
    w = 2 * np.pi * rng.uniform(0.3, 1.5, (3, 2))
    A, phase = rng.uniform(0.2, 0.6, (3, 2)), rng.uniform(0, 6, (3, 2))
    angle = w * t[:, None, None] + phase
    q, v, a = ((A * x).sum(1) for x in (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle)))
    W = sysid.torque.regressor(
        MODEL, q, v, a, joint_terms=TERMS, smoothing=SMOOTHING, tau=np.zeros_like(q)
    )
    rest = np.asarray(W, float) @ truth()
    tau = rest / (1 - LOST * np.tanh(v / SMOOTHING) * np.sign(rest))  # tau = rest + mu |tau| tanh
    channels = {"q": sysid.Channel(t, q - np.array(zeros)), "tau": sysid.Channel(t, tau)}
    return sysid.Recording(name, channels)


@functools.cache
def rows(name, zeros=(0.0, 0.0), seed=0, about=(0.0, 0.0)):
    made = run(name, zeros, seed)
    return sysid.torque.torque_rows(
        MODEL, made, 5.0, signal_cutoff=60.0, joint_terms=TERMS, smoothing=SMOOTHING, zeros=about
    )


def test_the_truth_leaves_little():
    """What is left is the differences' error of order h^2: 1e-3 of the torque."""
    r = rows("still")
    assert r.W.shape == (len(r.t), 2, 28) and r.slopes.shape == (*r.W.shape, 2)
    assert np.abs(r.residual(truth())).max() < 3e-3 * np.abs(r.tau).max()
    assert np.diff(r.t).min() > 0.05  # thinned out to the cut-off


def test_slopes_are_those_of_other_zeros():
    """Central differences over 1e-2 rad, with an error of order 1e-4."""
    r, made, h = rows("still"), run("still"), 1e-2
    for k, e in enumerate(np.eye(2)):
        a, b = (
            sysid.torque.torque_rows(
                MODEL, made, 5.0, signal_cutoff=60.0, joint_terms=TERMS, smoothing=SMOOTHING,
                zeros=s * h * e,
            ).W
            for s in (1, -1)
        )  # fmt: skip
        off = (a - b) / (2 * h) - r.slopes[..., k]
        assert np.abs(off).max() < 1e-3 * np.abs(r.slopes).max()
    np.testing.assert_allclose(r.at([h, 0]), r.W + h * r.slopes[..., 0])


def test_zeros_and_parameters_together():
    """Two runs with their own zeros; without zeros the same regression errs ten times as much.
    Centres of mass lie on the links: off them, they would be an angle like the elbow's zero.

    The first pass is right to second order in the zeros, a second one from there to fourth."""
    zeros = {"a": (0.03, -0.05), "b": (-0.02, 0.04)}
    both = [rows(n, z, seed).only(STRAIGHT) for seed, (n, z) in enumerate(zeros.items(), 1)]
    first = sysid.torque.regress_with_zeros(both, noise=1e-3, spread=1.0)
    for name, z in zeros.items():
        np.testing.assert_allclose(first.zeros[name], z, atol=8e-3)
    both = [
        rows(n, z, seed, tuple(first.zeros[n])).only(STRAIGHT)
        for seed, (n, z) in enumerate(zeros.items(), 1)
    ]
    found = sysid.torque.regress_with_zeros(both, noise=1e-3, spread=1.0)
    assert found.success and found.steps < 15
    for name, z in zeros.items():
        np.testing.assert_allclose(found.zeros[name], z, atol=2e-3)
    W = np.concatenate([r.at((0.0, 0.0)) for r in both])
    plain = sysid.torque.regress(W, np.concatenate([r.tau for r in both]), both[0].names)
    left = np.sqrt(np.mean(np.concatenate(
        [r.residual(found.parameters, found.zeros[r.name]) for r in both]) ** 2
    ))  # fmt: skip
    assert left < 0.1 * np.sqrt(np.mean(plain.residual**2))
    lost = found.parameters[-2:]
    np.testing.assert_allclose(lost, LOST, atol=0.02)


def test_zeros_of_a_run_that_was_not_fitted():
    """From its first three seconds."""
    r = rows("c", (0.02, 0.03), 5)
    z = r.segment(end=3.0).encoder_zeros(truth(), noise=1e-3)
    np.testing.assert_allclose(z, (0.02, 0.03), atol=3e-3)


def test_fewer_columns():
    r = rows("still")
    few = r.only(r.names[:20])
    np.testing.assert_array_equal(few.W, r.W[:, :, :20])
    assert few.names == r.names[:20]
    with pytest.raises(UnknownName, match="column"):
        r.only(["nose.m"])
    with pytest.raises(InputError, match="no equation"):
        r.segment(50.0, 60.0)
