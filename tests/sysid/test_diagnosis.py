"""Wrong data are named, and mended they give the truth."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.wrong_data import NOISE, TRUTH, UNKNOWNS, WRONG, T, leg
from rbjax.sysid import PD, Channel, Grid, Recording, Setup, Unknown, diagnose, identify
from rbjax.sysid.judgement.corrections import drop_samples, estimate_clock_rate, flip, stretch, swap
from rbjax.sysid.simulation.setup import simulate_motion
from rbjax.sysid.simulation.traces import Trace


def seen(q):
    t = np.arange(len(q)) * T
    return Recording("a", {"q": Channel(t, q), "ctrl": Channel(t, q)})


def test_a_mend_undoes_the_mistake():
    x = np.random.default_rng(0).normal(size=(20, 3))
    run = seen(x)
    np.testing.assert_array_equal(flip(("q",), 1)(run)["q"].values, x * [1, -1, 1])
    both = swap(("q", "ctrl"), 0, 2)(run)
    np.testing.assert_array_equal(both["ctrl"].values, x[:, [2, 1, 0]])
    slow = stretch(0.02)(run)
    np.testing.assert_allclose(slow["q"].t, 1.02 * run["q"].t)
    np.testing.assert_array_equal(slow["ctrl"].t, run["ctrl"].t)
    rows = np.arange(20) == 7
    left = drop_samples([run], {("a", "q", 1, "1"): rows})[0]["q"].arrived
    assert not left[7, 1] and left.sum() == left.size - 1


@pytest.mark.parametrize("rate", [0.02, 0.0, -0.01])
def test_the_rate_of_a_clock_is_read_off_positions(rate):
    t = np.arange(600) * T
    turn = lambda t: np.stack([np.sin(9 * t), np.sin(2 * t + t**2)], 1)  # noqa: E731
    # wrong numbers of the first guess: a gain (of one a sign), a lag, an offset
    q = np.array([0.8, -1.1]) * turn(t * (1 + rate) - 0.01) + np.array([0.1, 0.0])
    q += 5e-4 * np.random.default_rng(0).normal(size=q.shape)
    q[100:150, 0] = np.nan
    trace = Trace(("a", "b"), t, q, turn(t))
    assert abs(estimate_clock_rate({"a": {"q": trace}}) - rate) < 6e-4


def test_a_clock_is_not_read_off_steady_turning():
    t = np.arange(600) * T
    noise = 5e-4 * np.random.default_rng(0).normal(size=(600, 1))
    trace = Trace(("a",), t, 1.02 * t[:, None] + noise, t[:, None])
    assert estimate_clock_rate({"a": {"q": trace}}) == 0


@pytest.mark.slow
def test_right_data_have_no_cause():
    setup, run = leg(1.0)
    found = identify(setup, run, UNKNOWNS, grid=Grid(T))
    assert diagnose(found).causes == ()
    assert "no flipped sign" in diagnose(found).summary()


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_wrong_data_are_named(name):
    wrong, kind, channels, columns = WRONG[name]
    setup, run = leg()
    # no other start explains data that are wrong
    found = identify(setup, wrong(run), UNKNOWNS, grid=Grid(T), max_evaluations=40, restarts=0)
    said = diagnose(found)
    assert {cause.kind for cause in said.causes} == {kind}
    assert {cause.channels for cause in said.causes} == {channels}
    assert {column for cause in said.causes for column in cause.columns} == set(columns)
    mended = identify(setup, said.recordings, UNKNOWNS, grid=Grid(T))
    np.testing.assert_allclose(mended.rms["q"], NOISE, rtol=0.15)
    p = np.array([*mended.values.values()])
    # a clock's rate that is not known takes its share of the information
    assert np.abs((p - TRUTH) / mended.estimates.sigma).max() < (6 if kind == "clock" else 4)


@pytest.mark.slow
def test_outliers_hardly_move_a_robust_fit():
    setup, run = leg()
    bad = WRONG["5 % outliers"][0](run)
    plain, robust = (
        identify(setup, bad, UNKNOWNS, grid=Grid(T), loss=loss) for loss in ("squares", "huber")
    )
    off = [np.abs(np.array([*f.values.values()]) - TRUTH).max() for f in (plain, robust)]
    assert off[1] < 0.02 and off[1] < off[0] / 10


@pytest.mark.slow
def test_a_clock_that_like_joints_and_friction_hide_is_named():
    """Commands that are alike, and a fit that takes the lag for friction and bias."""
    one = """<body><joint name="{}" axis="0 1 0"/>
      <inertial pos="0 0 -0.1" mass="0.5" diaginertia="3e-3 3e-3 3e-3"/></body>"""
    with warnings.catch_warnings(action="ignore"):
        model = rb.load(f"""<mujoco><worldbody>{"".join(map(one.format, "abc"))}</worldbody>
          <actuator><motor joint="a"/><motor joint="b"/><motor joint="c"/></actuator></mujoco>""")

    def setup(friction):
        joints = model.joints.replace(damping=jnp.full(3, friction), armature=jnp.full(3, 0.01))
        return Setup.of(model.replace(joints=joints), PD(jnp.full(3, 20.0), jnp.full(3, 1.5)))

    t = np.arange(401) * T
    asked = 0.4 * np.sin(2 * np.pi * (0.1 * t + 0.25 * t**2))[:, None] * np.array([1, 1, 1])
    start = rb.State(jnp.asarray(asked[0]), jnp.zeros(3))
    path = simulate_motion(
        lambda p: setup(0.2), jnp.zeros(1), start, jnp.asarray(asked[:-1]), Grid(T)
    )
    q = path.q + NOISE * np.random.default_rng(0).normal(size=path.q.shape)
    q = q.at[0].set(path.q[0])
    v = np.full(q.shape, np.nan)
    v[0] = 0.0
    run = Recording("alike", {
        "q": Channel(1.02 * t, q), "v": Channel(t, v, dropped="nan"),
        "ctrl": Channel(t[:-1], asked[:-1]),
    })  # fmt: skip
    unknowns = {
        "viscous": Unknown("joints.damping", positive=True),
        "bias": Unknown("sensors.q.bias", scale=0.1),
    }
    said = diagnose(identify(setup(0.1), run, unknowns, grid=Grid(T)))
    assert [(cause.kind, cause.channels) for cause in said.causes] == [("clock", ("q",))]
    mended = said.recordings[0]["q"].t[-1]
    assert abs(mended / t[-1] - 1) < 1e-3
