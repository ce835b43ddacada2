"""What `identify` does by default: float64, initial states, steps, other starts, verdict."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import Channel, Grid, Recording, Setup, Unknown, identify
from rbjax.sysid.estimators.staged_fit import start_grid
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.runs import default_grid, make_run
from rbjax.sysid.statistics.precision import cast

MODEL = rb.load("pendulum")
MASS = {"mass": Unknown("bodies.mass", 0, positive=True)}
T, START = 0.01, rb.State(np.array([0.3]), np.array([0.4]))


@functools.cache
def motion(mass=1.4, count=150):
    """Times, commands and angles of a heavier pendulum."""
    model = MODEL.replace(bodies=MODEL.bodies.replace(mass=jnp.array([mass])))
    t = np.arange(count + 1) * T
    ctrl = 3 * np.sin(2.0 * t[:-1])[:, None]
    path = rb.rollout(model, START, ctrl, T, integrator="rk4", kernel=False)
    return t, ctrl, np.asarray(path.q), np.asarray(path.v)


def seen(seed=0, noise=2e-3, stated=False, **more):
    t, ctrl, q, _ = motion()
    q = q + noise * np.random.default_rng(seed).normal(size=q.shape)
    sigma = noise if stated else None
    return Recording(
        f"run {seed}", {"q": Channel(t, q, noise=sigma), "ctrl": Channel(t[:-1], ctrl)}, **more
    )


def test_float32_is_fitted_in_float64():
    """Both precisions find the same numbers and intervals; the model comes back in its own."""
    motion()  # recorded in float64
    with jax.enable_x64(False):
        narrow = cast(MODEL, np.float32)
        assert narrow.gravity.dtype == np.float32
        found = identify(narrow, seen(), MASS)
        assert found.model.gravity.dtype == np.float32 and found.model.bodies.mass.dtype == "f4"
        unseen = found.validate([seen(1)])
    with jax.enable_x64(True):
        wide = identify(cast(MODEL, np.float64), seen(), MASS)
        assert wide.model.bodies.mass.dtype == np.float64
    np.testing.assert_allclose(found.values["mass"], wide.values["mass"], rtol=1e-6)
    np.testing.assert_allclose(found.estimates.sigma, wide.estimates.sigma, rtol=1e-4)
    assert found.identifiable.rank == 1 and found.success and 0.8 < unseen.ratio < 1.25
    assert all(x.dtype == np.float64 for x in found.error.runs.values.values())


@pytest.mark.slow
def test_the_initial_state_is_fitted_unless_it_is_known():
    """Six draws: no bias beyond the intervals. A start that is said is not sought, in each of the
    ways to say it; and a wrong one is heeded."""
    z = []
    for seed in range(6):
        found = identify(MODEL, seen(seed), MASS)
        span = found.estimates.interval("mass")
        z.append((span.value - 1.4) / span.sigma)
        assert found.error.own == 2 and len(found.estimates.names) == 3
    assert np.sqrt(np.mean(np.square(z))) < 2
    told = identify(MODEL, seen(initial_state=START), MASS)
    assert told.error.own == 0
    assert told.estimates.interval("mass").sigma < found.estimates.interval("mass").sigma
    assert abs(told.values["mass"] - 1.4) < 4 * told.estimates.interval("mass").sigma
    np.testing.assert_allclose(told.traces["run 0"]["q"].simulated[0], START.q, rtol=1e-12)
    t, _, _, v = motion()
    first = np.where(np.arange(len(t))[:, None] == 0, v, np.nan)
    by_v = Recording("v", seen().channels | {"v": Channel(t, first, dropped="nan")})
    assert by_v.start_is_known and identify(MODEL, by_v, MASS).error.own == 0
    assert identify(MODEL, by_v, MASS, estimate_initial_state=True).error.own == 2
    assert identify(MODEL, seen(), MASS, estimate_initial_state=False).error.own == 0
    wrong = identify(MODEL, seen(initial_state=rb.State(START.q, -START.v)), MASS)
    assert not wrong.verdict.success and abs(wrong.values["mass"] - 1.4) > 0.01


def test_a_known_initial_state_is_not_fitted():
    found = identify(MODEL, seen(initial_state=START), MASS)
    assert found.error.own == 0 and identify(MODEL, seen(), MASS).error.own == 2
    assert abs(found.values["mass"] - 1.4) < 4 * found.estimates.interval("mass").sigma


@pytest.mark.slow
def test_known_and_unknown_initial_states_side_by_side():
    found = identify(MODEL, [seen(initial_state=START), seen(1)], MASS)
    assert found.error.own == 2
    p = found.estimates.values
    assert (p[1:3] == 0).all() and (p[3:] != 0).all()  # of the first run nothing is corrected
    assert abs(found.values["mass"] - 1.4) < 4 * found.estimates.interval("mass").sigma
    with pytest.raises(rb.InputError, match="initial_state whose q"):
        identify(MODEL, seen(initial_state=rb.State(np.zeros(2), np.zeros(1))), MASS)
    with pytest.raises(rb.InputError, match="expected a State"):
        seen(initial_state=np.zeros(2))
    assert seen(initial_state=START).segment(0.0, 0.5).initial_state is START
    assert seen(initial_state=START).segment(0.2, 0.5).initial_state is None


@pytest.mark.slow
def test_steps_are_the_finest_clock_and_halved_until_nothing_changes():
    t, _, _, _ = motion()
    ctrl = Channel([0.0, 1.0], [[1.0], [2.0]])
    coarse = Recording("c", {"q": Channel(t, t[:, None]), "ctrl": ctrl})
    assert default_grid([coarse], Setup.of(MODEL)).period == pytest.approx(T, rel=1e-9)
    # a damped pendulum read each 0.3 s: one step of RK4 a sample is too long
    stiff = MODEL.replace(joints=MODEL.joints.replace(damping=jnp.array([4.0])))
    t = np.arange(21) * 0.3
    ctrl = 5 * np.sin(1.3 * t[:-1])[:, None]
    path = rb.rollout(stiff, START, np.repeat(ctrl, 100, 0), 0.003, integrator="rk4")
    q = np.asarray(path.q)[::100] + 1e-4 * np.random.default_rng(0).normal(size=(21, 1))
    run = Recording("slow", {"q": Channel(t, q), "ctrl": Channel(t[:-1], ctrl)})
    guess = MODEL.replace(joints=MODEL.joints.replace(damping=jnp.array([3.0])))
    found = identify(guess, run, {"damping": Unknown("joints.damping", 0, positive=True)})
    assert found.grid.period < 0.1 and any("steps of 0.3 s were too long" in n for n in found.notes)
    span = found.estimates.interval("damping")
    assert abs(span.value - 4.0) < 4 * span.sigma


LATE = Unknown("delay", bounds=(0.0, 0.055))


@pytest.mark.parametrize(
    ("delay", "grid", "unknown", "periods"),
    [
        (None, None, MASS, 0),
        (0.0, None, MASS, 4),  # three periods, and one in which it ends
        (0.012, None, MASS, 5),  # three times the delay
        (0.012, None, {"delay": LATE}, 7),  # its upper bound
        (0.012, Grid(T, 0, longest_delay=2), MASS, 2),
        (0.012, Grid(T, longest_delay=2), MASS, None),
    ],
)
def test_the_grid_to_begin_with(delay, grid, unknown, periods):
    setup = Setup.of(MODEL, delay=delay)
    sought = Unknowns.of("identify", unknown, setup)
    found, checked = start_grid(setup, sought, [seen()], grid)
    assert checked == (periods is not None)
    assert found.period == pytest.approx(T, rel=1e-9) and found.substeps == 1
    if checked:
        assert found.longest_delay == periods
    make_run(setup, seen(), found)  # no delay is cut


def test_a_delay_that_the_grid_would_cut_is_an_error():
    """It was ignored in silence."""
    late = Setup.of(MODEL, delay=0.025)
    with pytest.raises(rb.InputError, match=r"0\.025 s late, .* longest_delay 3 or more"):
        make_run(late, seen(), Grid(T))
    with pytest.raises(rb.InputError, match="longest_delay 2, which are"):
        make_run(late, seen(), Grid(T, longest_delay=2))
    make_run(late, seen(), Grid(T, longest_delay=3))
    make_run(Setup.of(MODEL, delay=0.0), seen(), Grid(T))
    with pytest.raises(rb.InputError, match="substeps of the grid is 0"):
        make_run(Setup.of(MODEL), seen(), Grid(T, 0))


@pytest.mark.slow
def test_a_delay_is_found_by_default():
    t, ctrl, _, _ = motion()
    heavy = MODEL.replace(bodies=MODEL.bodies.replace(mass=jnp.array([1.4])))
    fine = np.repeat(ctrl, 100, 0)
    late = np.vstack([np.zeros((230, 1)), fine])[: len(fine)]  # 23 ms
    path = rb.rollout(heavy, START, late, T / 100, integrator="rk4", kernel=False)
    q = np.asarray(path.q)[::100] + 1e-4 * np.random.default_rng(0).normal(size=(len(t), 1))
    run = Recording("late", {"q": Channel(t, q), "ctrl": Channel(t[:-1], ctrl)})
    sought = MASS | {"delay": Unknown("delay", bounds=(0.0, 0.05))}
    found = identify(Setup.of(MODEL, delay=0.01), run, sought)
    assert found.verdict.success
    for name, truth in (("mass", 1.4), ("delay", 0.023)):
        span = found.estimates.interval(name)
        assert abs(span.value - truth) < 4 * span.sigma


@pytest.mark.slow
def test_a_poor_fit_is_tried_from_other_starts_and_said():
    """A motion of six seconds that a mass of a tenth loses; no such try, and no such sentence,
    without a reason."""
    t, ctrl, q, _ = motion(count=600)
    q = q + 2e-3 * np.random.default_rng(0).normal(size=q.shape)
    run = Recording("long", {"q": Channel(t, q), "ctrl": Channel(t[:-1], ctrl)})
    guess = MODEL.replace(bodies=MODEL.bodies.replace(mass=jnp.array([0.15])))
    lost = identify(guess, run, MASS, restarts=0)
    found = identify(guess, run, MASS)
    assert abs(found.values["mass"] - 1.4) < 4 * found.estimates.interval("mass").sigma
    assert found.verdict.success and found.verdict.r_squared["q"] > 0.99
    assert not identify(MODEL, seen(), MASS).notes
    if not lost.verdict.success:  # the guess alone may be enough
        assert "the fit from the first guess was poor" in found.notes[0]
        assert "is better" in found.notes[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, "the fit is good"),
        ({"wrong_noise": True}, "times its stated noise"),
        ({"model": "heavy damping"}, "is not white"),
        ({"shuffled": True}, "R2 of q"),
        ({"steps": 1}, "not converged"),
    ],
)
def test_the_verdict_names_each_check_that_fails(change, said):
    t, ctrl, q, _ = motion()
    q = q + 2e-3 * np.random.default_rng(0).normal(size=q.shape)
    if "shuffled" in change:
        q = np.random.default_rng(1).permutation(q)
    channel = Channel(t, q, noise=[2e-4] if "wrong_noise" in change else None)
    run = Recording("run", {"q": channel, "ctrl": Channel(t[:-1], ctrl)})
    model = MODEL
    if "model" in change:
        model = MODEL.replace(joints=MODEL.joints.replace(damping=jnp.array([0.8])))
    if "steps" in change:
        model = MODEL.replace(bodies=MODEL.bodies.replace(mass=jnp.array([20.0])))
    found = identify(model, run, MASS, restarts=0, max_evaluations=change.get("steps", 100))
    assert found.verdict.success == (not change) and said in found.verdict.summary()
    assert found.verdict.summary() in found.summary() and "mass = " in found.summary()
