"""Single steps of the estimators, each against a closed form or a recorder of its calls."""

from __future__ import annotations

import contextlib
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import Channel, Grid, Identified, Recording, Setup, Unknown, squares
from rbjax.sysid.estimators import identification, identified, staged_fit
from rbjax.sysid.estimators.identified import FitOptions
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation import objective
from rbjax.sysid.simulation.jacobian_colouring import compile_time_constants
from rbjax.sysid.simulation.runs import Run
from rbjax.sysid.simulation.setup import SimulatedPath
from rbjax.sysid.simulation.simulation_error import HUBER, make_programs
from rbjax.sysid.simulation.traces import Trace, make_traces
from rbjax.sysid.torque import select, selection

MODEL = rb.load("pendulum")
T = 0.1 * np.arange(30)
SWING = Recording("swing", {"q": Channel(T, np.sin(T)), "v": Channel(T, np.cos(T))})
MASS = {"mass": Unknown("bodies.mass", 0, positive=True)}


class Reached(Exception):
    """The end of the part that a test looks at."""


@pytest.mark.parametrize(("memory", "due"), [(None, 7.0), (123.0, 123.0)])
def test_reverse_mode_has_the_memory_that_is_given_or_a_share_of_the_device(
    monkeypatch, memory, due
):
    asked = []
    monkeypatch.setattr(objective, "memory_share", lambda: 7.0)
    monkeypatch.setattr(objective, "_keep", lambda *how: asked.append(how[-1]) or 1)
    squares(MODEL, SWING, MASS, mode="reverse", memory=memory)
    assert asked == [due]


def test_traces_hold_recorded_and_simulated_values_each_in_its_place():
    setup, seen = Setup.of(MODEL), {"q": np.sin(T)[None, :, None]}
    weights = {"q": np.where(np.arange(30) == 4, 0.0, 1.0)[None, :, None]}
    run = Run(None, None, {"q": T[None]}, seen, weights)
    error = types.SimpleNamespace(runs=run, readings=lambda x: {"q": seen["q"] + 1})
    trace = make_traces(setup, error, np.zeros(0), [SWING])["swing"]["q"]
    np.testing.assert_array_equal(trace.simulated[:, 0], np.sin(T) + 1)
    np.testing.assert_array_equal(
        trace.recorded[:, 0], np.where(np.arange(30) == 4, np.nan, np.sin(T))
    )
    assert trace.names == MODEL.joint_names


def test_a_free_run_weighs_each_sample_that_arrived_by_the_noise(monkeypatch):
    def stop(setup, unknowns, data, grid, **how):
        raise Reached(data.weights)

    monkeypatch.setattr(identified, "SimulationError", stop)
    q = np.sin(T)
    q[3] = np.nan
    run = Recording("gap", {"q": Channel(T, q, dropped="nan")})
    with pytest.raises(Reached) as found:
        identified.free_run(MODEL, run, noise={"q": [0.25]})
    due = np.where(np.isnan(q), 0.0, 4.0)
    np.testing.assert_array_equal(found.value.args[0]["q"][0, :, 0], due)


def test_constants_are_computed_while_a_program_is_traced():
    assert isinstance(compile_time_constants(), contextlib.nullcontext)

    @jax.jit
    def traced(x):
        with compile_time_constants():
            known = np.asarray(jnp.ones(3) + 1)
        return x * known.sum()

    assert float(traced(2.0)) == 12.0


def fit(loss: str, seen: dict, unseen: dict) -> types.SimpleNamespace:
    """The fields of a fit that its validation reads."""
    return types.SimpleNamespace(
        judged_sensor="q", rms={"q": np.ones(1)}, traces=seen, options=FitOptions(loss=loss),
        setup=Setup.of(MODEL), simulated=lambda recordings, estimate_initial_state: unseen,
    )  # fmt: skip


@pytest.mark.parametrize("loss", ["squares", "huber"])
def test_validation_compares_unseen_with_fitted_errors_and_outliers_count_by_the_loss(loss):
    def trace(size):
        y, off = np.sin(T)[:, None], size * np.where(np.arange(30) % 2, 1.0, -1.0)[:, None]
        off[7] = 100.0
        return {"q": Trace(("hinge",), T, y, y + off)}

    other = Recording("other", dict(SWING.channels))
    found = Identified.validate(fit(loss, {"swing": trace(1.0)}, {"other": trace(2.0)}), [other])
    rms = (
        [1.0, 2.0] if loss == "huber" else [np.sqrt((29 + 1e4) / 30), np.sqrt((29 * 4 + 1e4) / 30)]
    )
    np.testing.assert_allclose([found.rms_fitted, found.rms], rms, rtol=1e-12)
    assert [*found.by_recording] == ["other"]


@pytest.mark.parametrize("prepared", [False, True])
def test_the_stages_of_a_fit_follow_each_other(monkeypatch, prepared):
    done = []

    class Stages:
        def __init__(self, *given, **how):
            self.first = "first"

        def __getattr__(self, stage):
            return lambda *given: done.append(stage) or f"{stage} of {given[0] if given else ''}"

    monkeypatch.setattr(identification, "StagedFit", Stages)
    monkeypatch.setattr(identification, "_result", lambda stages, best, dtype: best)
    options = FitOptions(segments=0.1, multiple_shooting=0.2) if prepared else FitOptions()
    found = identification.fit_in_stages(None, None, [], options)
    due = ["fit_all", "retry_if_poor", "reweigh", "refine_steps"]
    if prepared:
        due = ["fit_segments", "fit_multiple_shooting", "fit_all", "reweigh", "refine_steps"]
    assert done == ["shorten_steps", *due]
    assert found == " of ".join([*due[::-1], "first"])


@pytest.mark.parametrize("grid", [None, Grid(0.1)])
def test_the_steps_are_checked_unless_a_grid_is_given(monkeypatch, grid):
    def stop(*given, **how):
        raise Reached

    monkeypatch.setattr(staged_fit.StagedFit, "error", stop)
    unknowns = Unknowns.of("test", MASS, Setup.of(MODEL))
    stages = staged_fit.StagedFit(Setup.of(MODEL), unknowns, [SWING], FitOptions(grid=grid))
    if grid is not None:
        assert stages.shorten_steps() is None and stages.refine_steps("fit") == "fit"
        return
    with pytest.raises(Reached):
        stages.shorten_steps()


@pytest.mark.parametrize("loss", ["squares", "huber"])
def test_large_residuals_count_by_the_loss(loss):
    setup = Setup.of(MODEL)
    one = make_programs(setup, Unknowns({}, (), ()), Grid(0.1), 0, loss)
    y = np.array([0.0, 5.0])[:, None]  # the first residual is 0.5 sigma, the second -4.5
    path = SimulatedPath(jnp.full((2, 1), 0.5), jnp.zeros((2, 1)), None, jnp.zeros((1, 1)))
    times, weights = {"q": jnp.array([0.0, 0.1])}, {"q": jnp.ones((2, 1))}
    run = Run(None, None, times, {"q": jnp.asarray(y)}, weights)
    found = jax.jit(lambda path: one.compare(setup, path, run))(path)
    far = -4.5 if loss == "squares" else -np.sqrt(HUBER * (9 - HUBER))
    np.testing.assert_allclose(found, [0.5, far], rtol=1e-6)


def test_the_noise_of_exact_torques_is_their_rounding(monkeypatch):
    noises, regress = [], selection.regress
    keep = lambda *given, noise=None: noises.append(noise) or regress(*given, noise=noise)  # noqa: E731
    monkeypatch.setattr(selection, "regress", keep)
    t = np.linspace(0, 1, 50)
    lines = {
        f"degree {n}": (np.stack([t**k for k in range(n + 1)], 1), "ab"[: n + 1]) for n in (0, 1)
    }
    assert select(lines, 1e3 * t).name == "degree 1"
    assert noises[0] is None and all(np.min(noise) >= 1e-11 for noise in noises[1:])
    assert np.max(noises[1]) < 1e-6
