"""The recommended formulation has the requested accuracy over the horizon, and says why."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import rbjax as rb
from benchmarks.cases.mechanisms import four_bars, pendulum, spatial_slider_crank, tilted_four_bar
from rbjax import constraints as rc
from rbjax.constraints.formulation import formulation_of
from rbjax.recommend import FormulationRecommendation

FIGURES = Path(__file__).parent.parent / "oracles" / "loops.json"
slow = pytest.mark.slow
SOFT = """<mujoco><worldbody><body name="a"><joint name="x" type="slide"/><geom size="0.1"/></body>
  </worldbody><equality><joint joint1="x"/></equality></mujoco>"""
LEFT = rb.State(jnp.array([-1.0, 0.0]), jnp.zeros(2))


def delivered(model: rb.Model, state: rb.State, r: FormulationRecommendation, horizon: float):
    """The path of the user, and the largest residual of rows and their rates on it."""
    steps = round(horizon / r.dt / 20) * 20
    path = rb.rollout(
        model, state, None, r.dt, steps=steps, save_every=steps // 20, integrator="rk4",
        constraints=r.formulation,
    )  # fmt: skip
    off = [rc.residual(model, path.state(i)) for i in range(21)]
    return path, max(float(np.abs(x).max()) for each in off for x in each)


def check(r: FormulationRecommendation, accuracy: float) -> None:
    """The cheapest of the good ones, with its numbers in the sentence."""
    best = min((x for x in r.candidates if x.success), key=lambda x: x.cost)
    assert (r.name, r.dt, r.gap, r.error) == (best.name, best.dt, best.gap, best.error)
    assert r.formulation is rc.formulations()[r.name]
    assert max(r.gap, r.error) <= accuracy
    assert f"steps of {r.dt:.2g} s leaves a gap of {r.gap:.1e} and an error of {r.error:.1e}" in (
        r.reason
    )


def test_cost_decides_where_nothing_drifts(capfd: pytest.CaptureFixture) -> None:
    model = pendulum()
    r = rb.recommend.formulation(model, LEFT, 1e-6)
    check(r, 1e-6)
    assert r.reason.startswith("cost decides: ") and r.redundant == 0
    assert {x.name for x in r.candidates} >= {"multipliers", "projected", "null_space_qr"}
    assert delivered(model, LEFT, r, 1.0)[1] <= 1e-6
    assert capfd.readouterr() == ("", "")


@slow
def test_beyond_the_trial_run() -> None:
    """Ten seconds, of which two are run: against the closed form."""
    model = pendulum()
    r = rb.recommend.formulation(model, LEFT, 1e-7, horizon=10.0)
    check(r, 1e-7)
    path, gap = delivered(model, LEFT, r, 10.0)
    assert gap <= 1e-7
    want = json.loads(FIGURES.read_text())["pendulum"]["samples"]["10.0"]
    assert abs(path.ts[-1] - 10.0) < 1e-9
    np.testing.assert_allclose(path.q[-1], [want["x"], want["y"]], atol=1e-7)


@slow
def test_drift_decides() -> None:
    model, start = spatial_slider_crank()
    r = rb.recommend.formulation(model, start, 1e-6, horizon=5.0)
    check(r, 1e-6)
    assert (r.name, r.redundant) == ("projected", 0) and r.reason.startswith("drift decides: ")
    assert delivered(model, start, r, 5.0)[1] <= 1e-6


@slow
def test_redundant_rows() -> None:
    model = tilted_four_bar("0.8 0.3 -0.2 0.4")
    r = rb.recommend.formulation(model, model.default_state(), 1e-4)
    check(r, 1e-4)
    assert r.reason.startswith("3 of 5 rows are redundant, so only proximal multipliers")
    assert {x.name for x in r.candidates} == {"multipliers", "baumgarte", "projected"}


@slow
@pytest.mark.parametrize("n", [1, 2])
def test_a_singular_position_is_met(n: int) -> None:
    """Flat, where theta is 90 degrees; not reached in half a second."""
    model, start = four_bars(n)
    c = 9.81 * ((n + 1) / 2 + n) / ((n + 1) / 3 + n)
    met = quad(lambda theta: 1 / np.sqrt(1 + 2 * c * (1 - np.cos(theta))), 0, np.pi / 2)[0]
    r = rb.recommend.formulation(model, start, 1e-6)
    check(r, 1e-6)
    assert r.reason.startswith(f"a singular position is met at {met:.2g} s")
    assert r.closest < 5e-3 and r.redundant == n and r.name in ("baumgarte", "projected")
    short = rb.recommend.formulation(model, start, 1e-6, horizon=0.5)
    assert short.reason.startswith(f"{n} of {3 * n} rows are redundant")


def test_without_rows() -> None:
    r = rb.recommend.formulation(rb.load("pendulum"), rb.load("pendulum").default_state(), 1e-6)
    assert (r.formulation, r.name, r.candidates) == (None, "none", ())
    assert "the model has 0 rows" in r.reason


@pytest.mark.parametrize(
    "given, message",
    [
        ({"accuracy": "fine"}, "accuracy is 'fine', expected a number"),
        ({"accuracy": 1e-12}, "accuracy is 1e-12, expected at least 1e-10"),
        ({"horizon": -1.0}, "horizon is -1.0, expected a positive time"),
        ({"dt": 0.0}, "dt is 0.0, expected a positive time"),
        ({"ctrl": lambda t: None}, "ctrl"),
        ({"state": rb.State(jnp.array([-1.0, 0.1]), jnp.zeros(2))}, "off the constraints by 0.005"),
        ({"state": jnp.zeros(2)}, "expected rbjax.State"),
    ],
)
def test_wrong_inputs(given: dict, message: str) -> None:
    given = {"state": LEFT, "accuracy": 1e-6} | given
    with pytest.raises(rb.InputError, match=message):
        rb.recommend.formulation(pendulum(), **given)


def test_the_default_is_the_one_of_any_motion() -> None:
    """That of `rollout` and `simulate`, with its reason."""
    r = rb.recommend.formulation(pendulum())
    assert r.formulation is formulation_of("simulate", pendulum(), None)
    assert r.name == "projected" and "decides no rank" in r.reason and np.isnan(r.gap)
    soft = rb.load(SOFT, compliant=True)
    r = rb.recommend.formulation(soft)
    assert r.formulation is formulation_of("simulate", soft, None)
    assert r.name == "compliant" and "yield" in r.reason
    assert rb.recommend.formulation(rb.load("pendulum")).formulation is None
    with pytest.raises(rb.InputError, match="accuracy is given and state is not"):
        rb.recommend.formulation(pendulum(), accuracy=1e-6)
