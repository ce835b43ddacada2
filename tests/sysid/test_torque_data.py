"""`torque_rows` of data as drives give them: gaps, coarse clocks, dry friction, terms of a user."""

import functools
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid
from rbjax.errors import InputError
from rbjax.sysid import Channel, Recording
from rbjax.sysid.torque import regress, torque_rows

DRIVE = """<mujoco><option gravity="0 0 0"/><worldbody><body name="rotor">
<joint name="motor" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1e-2 1e-2 2e-2"/>
</body></worldbody></mujoco>"""
TRUTH = {"rotor.Izz": 0.02, "motor.viscous": 0.02, "motor.coulomb": 0.1}
MODEL = rb.load(DRIVE)


def drive(rate=500.0, fastest=3.0, seconds=20.0, noise=1e-3, seed=0):
    """A motor whose dry friction is a step, F sign(v); torques are read with noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1 / rate)
    w = 2 * np.pi * np.array([0.2, 0.5, 1.1])
    size, phase = fastest * np.array([0.5, 0.3, 0.2]) / w, rng.uniform(0, 6, 3)
    angle = w * t[:, None] + phase
    q, v, a = (
        x.sum(1)
        for x in (size * np.sin(angle), size * w * np.cos(angle), -size * w**2 * np.sin(angle))
    )
    J, d, F = TRUTH.values()
    tau = J * a + d * v + F * np.sign(v) + noise * rng.normal(size=t.size)
    return Recording("run", {"q": Channel(t, q, ["motor"]), "tau": Channel(t, tau, ["motor"])})


def fitted(rows):
    few = rows.only(list(TRUTH))
    return regress(few.W, few.tau, few.names)


@pytest.mark.parametrize("rate", [50.0, 500.0])
@pytest.mark.parametrize("fastest", [0.5, 3.0])
def test_dry_friction_does_not_bias_the_viscous_one(rate, fastest):
    """Nothing is smoothed by default: 1.2 %, of which 1.1 % is the standard error of the viscous
    friction at 50 Hz. A step of 0.01 rad/s makes it 2.4 % too small at 3 rad/s, 63 % at 0.5."""
    run, terms = drive(rate, fastest), ["viscous", "coulomb"]
    found = fitted(torque_rows(MODEL, run, 5.0, joint_terms=terms))
    truth = np.array([*TRUTH.values()])
    assert np.abs(found.beta / truth - 1).max() < 0.012
    wide = fitted(torque_rows(MODEL, run, 5.0, joint_terms=terms, smoothing=1e-2))
    assert wide.beta[1] < 0.985 * found.beta[1]


def test_a_gap_splits_the_recording():
    """Its two stretches give the equations that each gives by itself."""
    whole = drive()
    q, tau = (whole[s] for s in ("q", "tau"))
    gone = (q.t > 8.0) & (q.t < 9.0)
    holed = Recording("run", {"q": q.drop(gone), "tau": tau})
    rows = torque_rows(MODEL, holed, 5.0, joint_terms=["coulomb"])
    assert not ((rows.t > 8.0) & (rows.t < 9.0)).any() and rows.t[-1] > 19
    each = [
        torque_rows(MODEL, whole.segment(a, b), 5.0, joint_terms=["coulomb"])
        for a, b in ((0.0, 8.0), (9.0, 19.998))
    ]
    np.testing.assert_allclose(rows.t, np.concatenate([r.t for r in each]), atol=1e-9)
    for name in ("W", "tau"):
        want = np.concatenate([getattr(r, name) for r in each])
        # the filters leave less than 1 % of the effect of an end, which lies a sample elsewhere
        np.testing.assert_allclose(getattr(rows, name), want, atol=1e-4 * np.abs(want).max())
    assert rows.slopes.shape == (*rows.W.shape, 1)


def test_samples_that_are_missing_here_and_there_are_bridged():
    whole = drive(noise=0.0)
    rng = np.random.default_rng(1)
    channels = {s: whole[s].drop(rng.uniform(size=10_000) < 0.02) for s in ("q", "tau")}
    rows = torque_rows(MODEL, Recording("run", channels), 5.0, joint_terms=["viscous", "coulomb"])
    assert len(rows.t) > 200
    np.testing.assert_allclose(fitted(rows).beta, [*TRUTH.values()], rtol=5e-3)


def test_without_a_stretch_that_is_long_enough_it_is_said():
    whole = drive(seconds=4.0)
    gone = np.arange(2000) % 200 < 100  # 0.2 s of 0.4 s
    channels = {s: whole[s].drop(gone) for s in ("q", "tau")}
    with pytest.raises(InputError, match=r"for longer than 0.198 s, expected more than"):
        torque_rows(MODEL, Recording("run", channels), 1.0)
    with pytest.raises(InputError, match="raise cutoff"):
        torque_rows(MODEL, drive(seconds=0.3), 1.0)


def test_slopes_are_computed_when_they_are_read():
    """W of seven joints needs no derivative: of 7 x 60,000 numbers there is one copy, not eight."""
    rows = torque_rows(MODEL, drive(seconds=4.0), 5.0)
    few = rows.only(["rotor.Izz"]).segment(1.0, 2.0)
    assert "slopes" not in rows.__dict__ and "slopes" not in few.__dict__
    few.residual([0.02]), few.at([0.0])
    assert "slopes" not in rows.__dict__ and "slopes" not in few.__dict__
    assert few.slopes.shape == (*few.W.shape, 1) and "slopes" in rows.__dict__


@pytest.mark.slow
def test_memory_of_a_seven_joint_arm():
    """W of 4,000 samples has 4000 x 7 x 70 numbers, 16 MB. Its filter holds a few copies of it;
    derivatives in all directions were seven more of each."""
    model = rb.load("arm7")
    t = np.arange(4000) / 1000
    q = 0.3 * np.sin(t[:, None] * np.arange(1, 8))
    run = Recording("run", {"q": Channel(t, q), "tau": Channel(t, np.cos(q))})
    tracemalloc.start()
    rows = torque_rows(model, run, 5.0)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 8 * 4000 * 7 * 70 * 8 and rows.W.nbytes < 1e6


def test_a_term_that_is_defined_again_has_the_new_column(monkeypatch):
    run = drive(seconds=4.0)
    for value in (3.0, 7.0):
        f = functools.partial(lambda value, v, a, tau, s: 0 * v + value, value)
        monkeypatch.setitem(sysid.torque.JOINT_TERMS, "mine", f)
        rows = torque_rows(MODEL, run, 5.0, joint_terms=["mine"])
        np.testing.assert_allclose(rows.W[:, 0, -1], value, rtol=1e-6)


def test_float32_gives_the_equations_of_float64():
    """JAX's default: the rows, and so the rank, are those of float64."""
    want = torque_rows(MODEL, drive(), 5.0, joint_terms=["viscous"], zeros=[0.1])
    with jax.enable_x64(False):
        single = rb.load(DRIVE)
        assert single.gravity.dtype == jnp.float32
        rows = torque_rows(single, drive(), 5.0, joint_terms=["viscous"], zeros=[0.1])
        found, slopes = regress(rows.W, rows.tau, rows.names), rows.slopes
    assert rows.W.dtype == np.float64 and slopes.dtype == np.float64
    np.testing.assert_allclose(rows.W, want.W, rtol=1e-6, atol=1e-9)
    assert found.combinations.kept == regress(want.W, want.tau, want.names).combinations.kept


def test_columns_go_to_the_joints_of_their_names():
    model = rb.load("double_pendulum")
    t = np.arange(0.0, 4.0, 0.002)
    x = np.stack([np.sin(t), np.cos(2 * t)], 1)
    a, b = model.joint_names
    run = Recording("run", {"q": Channel(t, x, (a, b)), "tau": Channel(t, x, (a, b))})
    turned = Recording("run", {"q": Channel(t, x[:, ::-1], (b, a)), "tau": run["tau"]})
    want, found = (torque_rows(model, r, 5.0) for r in (run, turned))
    np.testing.assert_array_equal(found.W, want.W)
    one = Recording("run", {"q": Channel(t, x[:, :1], (a,)), "tau": run["tau"]})
    with pytest.raises(InputError, match=f"q of run has 1 columns, expected 2.*missing: {b}"):
        torque_rows(model, one, 5.0)
