"""The recommended solver has the requested accuracy, and the sentence has the number."""

import re
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rbjax as rb
from rbjax import stability
from rbjax.recommend import solvers

slow = pytest.mark.slow
TS = np.linspace(0.0, 1.0, 24)  # not the times that it was chosen at


def delivered(model, state, r, truth) -> float:
    """The largest error of a configuration coordinate in the user's simulation."""
    path = rb.simulate(model, state, TS, solver=r.solver, dt=r.dt)
    gap = jax.jit(jax.vmap(lambda a, b: rb.difference(model, a, b)))(truth, path.q)
    return float(np.abs(np.asarray(gap)).max())


def fine(model, state):
    tight = diffrax.PIDController(rtol=1e-12, atol=1e-12)
    return rb.simulate(
        model, state, TS, solver=diffrax.Dopri8(), stepsize_controller=tight, max_steps=10**6
    ).q


def test_a_smooth_motion_is_decided_by_accuracy(capfd: pytest.CaptureFixture) -> None:
    """A pendulum, against SciPy on its own equation; no output if there is no terminal."""
    model = rb.load("pendulum")
    state = rb.State(np.array([0.5]), np.zeros(1))
    still = rb.State(*np.zeros((2, 9, 1)))
    slope, damping = stability.motion_matrices(model, still)[0, 1]
    found = solve_ivp(
        lambda t, y: [y[1], slope * np.sin(y[0]) + damping * y[1]],
        (0.0, 1.0), [0.5, 0.0], method="DOP853", t_eval=TS, rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    for accuracy in (1e-4, 1e-8):
        r = rb.recommend.solver(model, state, accuracy)
        assert (r.name, type(r.solver)) == ("rk4", rb.solvers.RK4)
        path = rb.simulate(model, state, TS, solver=r.solver, dt=jnp.asarray(r.dt))
        error = np.abs(path.q[:, 0] - found.y[0]).max()
        assert accuracy / 100 < error < 2 * accuracy, (error, r.reason)
        assert r.predicted_error < accuracy
        assert r.reason.startswith("accuracy decides: stability would allow rk4 steps of 0.74 s")
        assert f"steps of {r.dt:.2g} s has an error of {r.predicted_error:.1e}" in r.reason
    assert capfd.readouterr() == ("", "")


@slow
def test_a_stiff_motion_is_decided_by_stability() -> None:
    """A double pendulum whose elbow is a spring of 1e6 N m / rad: a stiff stick that swings."""
    model = rb.load("double_pendulum")
    model = model.replace(joints=model.joints.replace(stiffness=jnp.array([0.0, 1e6])))
    state = rb.State(np.array([0.8, 0.0]), np.zeros(2))
    M = np.asarray(rb.mass_matrix(model, state.q))
    fastest = np.sqrt(1e6 * np.linalg.inv(M)[1, 1])
    truth = fine(model, state)
    for accuracy in (1e-2, 1e-4):
        r = rb.recommend.solver(model, state, accuracy)
        assert r.name == ("ros34pw2" if accuracy > 1e-3 else "radau_iia3"), r.reason
        assert delivered(model, state, r, truth) < 10 * accuracy
        said = re.match(
            r"stability decides: the fastest eigenvalue, (\S+) 1/s, limits rk4 to steps of (\S+) s",
            r.reason,
        )
        assert said is not None, r.reason
        assert float(said[1]) == pytest.approx(fastest, rel=0.05)
        assert float(said[2]) == pytest.approx(2.83 / fastest, rel=0.05)
        assert r.dt > 10 * float(said[2])


@slow
def test_an_arm_falls(capfd: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tried with the driver that compiles fastest, run with the usual one; shown on a terminal."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    model = rb.load("arm7")
    state = model.default_state()
    r = rb.recommend.solver(model, state, 1e-5)
    assert "recommend: rk4 with steps of" in capfd.readouterr().err
    assert r.name == "rk4"
    assert delivered(model, state, r, fine(model, state)) < 2e-5


@slow
def test_a_tumbling_body_stays_on_its_group() -> None:
    """About the middle axis of a free body, which turns over."""
    model = rb.load("free_body")
    state = rb.State(model.default_state().q, np.array([0.1, 0.0, 0.3, 0.1, 6.0, 0.2]))
    truth = fine(model, state)
    for accuracy in (1e-3, 1e-6):
        r = rb.recommend.solver(model, state, accuracy)
        assert r.name == "rkmk4"
        assert delivered(model, state, r, truth) < 10 * accuracy
        assert "accuracy decides" in r.reason


@slow
def test_a_long_conservative_motion_is_decided_by_the_horizon() -> None:
    model = rb.load("pendulum")
    model = model.replace(joints=model.joints.replace(damping=jnp.zeros(1)))
    state = rb.State(np.array([0.5]), np.zeros(1))
    r = rb.recommend.solver(model, state, 1e-4, horizon=1000.0)
    assert r.name == "yoshida4"
    assert r.reason.startswith("the horizon decides: over 1000 s")
    assert "grows with t, the error of rk4 with t^2" in r.reason
    ts = np.array([0.0, 999.0, 1000.0])
    path = rb.simulate(model, state, ts, solver=r.solver, dt=r.dt, max_steps=10**7)
    slope = float(stability.state_matrix(model, model.default_state())[1, 0])
    found = solve_ivp(
        lambda t, y: [y[1], slope * np.sin(y[0])],
        (0.0, 1000.0), [0.5, 0.0], method="DOP853", t_eval=ts, rtol=1e-13, atol=1e-13,
    )  # fmt: skip
    assert np.abs(path.q[:, 0] - found.y[0]).max() < 10 * 1e-4


def test_what_cannot_be_had_is_refused_in_a_sentence() -> None:
    model = rb.load("pendulum")
    state = model.default_state()
    for accuracy, horizon, words in (
        (1e-13, 1.0, "accuracy is 1e-13, expected at least 1e-10"),
        (1e-3, -1.0, r"horizon is -1.0, expected a positive time"),
    ):
        with pytest.raises(rb.InputError, match=words):
            rb.recommend.solver(model, state, accuracy, horizon=horizon)
    for start, accuracy, words in (
        (rb.State(np.array([np.nan]), np.zeros(1)), 1e-6, r"recommend: q\[0\] is nan"),
        ((np.zeros(1), np.zeros(1)), 1e-6, "expected rbjax.State"),
        (rb.State(np.zeros(2), np.zeros(1)), 1e-6, r"q has shape \(2,\), expected \(1,\)"),
        (state, "1e-6", "accuracy is '1e-6', expected a number"),
        (state, None, "accuracy is None, expected a number"),
    ):
        with pytest.raises(rb.InputError, match=words):
            rb.recommend.solver(model, start, accuracy)


def test_a_candidate_without_an_accurate_step() -> None:
    found = solvers._trial("rk4", None)
    assert not found.success and np.isinf(found.cost)
