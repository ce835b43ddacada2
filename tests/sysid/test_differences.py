"""`identify` by differences in place of derivatives, for errors that are rough."""

from __future__ import annotations

import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases import cube
from rbjax.errors import InputError
from rbjax.status import Status
from rbjax.sysid import Channel, Recording, Unknown, identify
from rbjax.sysid.estimators.least_squares import minimise_by_differences
from rbjax.sysid.parameters.divergence import Divergence
from tests.sysid.test_contact_cube import tossed


class Rough:
    """Residuals p - (2, 5) with ripples of 1 %, whose derivatives are of any sign."""

    best = np.array([2.0, 5.0])

    def __init__(self, step):
        self.step = step

    def residuals(self, p):
        return p - self.best + 0.01 * self.best * np.sin(3e3 * p)

    def divergence(self, x, x0):
        return Divergence.positive(x, x0)

    def cost(self, x):
        r = self.residuals(x)
        return float(r @ r) + 1.0

    def triangle(self, x):
        moves = self.divergence(x, x).moves(self.step)
        J = np.stack(
            [(self.residuals(x + d) - self.residuals(x - d)) / (2 * d.sum()) for d in moves], -1
        )
        rows = np.zeros((3, 3))
        rows[:2, :2], rows[:2, 2], rows[2, 2] = J, self.residuals(x), 1.0
        return np.linalg.qr(rows)[1]


@pytest.mark.parametrize("start", [[0.5, 20.0], [2.0, 5.0], [8.0, 1.0]])
def test_a_rough_error_converges(start):
    found = minimise_by_differences(Rough(0.1), np.array(start), step=0.1)
    assert found.status == Status.CONVERGED
    np.testing.assert_allclose(found.x, Rough.best, rtol=0.03)  # to the ripples


class Cubic(Rough):
    """Residuals (p / best)^3 - 1, which need many steps."""

    def residuals(self, p):
        return (p / self.best) ** 3 - 1


def test_a_budget_is_a_status():
    found = minimise_by_differences(Cubic(0.1), np.array([0.5, 20.0]), step=0.1, max_evaluations=2)
    assert found.status == Status.BUDGET
    assert found.evaluations <= 2 + 4  # the last steps, without a prior


def swing():
    """A pendulum of 1.3 kg, and its recording."""
    model, t = rb.load("pendulum"), np.arange(51) * 0.02
    heavier = model.replace(bodies=model.bodies.replace(mass=np.array([1.3])))
    push = np.ones((50, 1))
    seen = rb.rollout(heavier, model.default_state(), push, 0.02, integrator="rk4")
    channels = {
        "q": Channel(t, seen.q, noise=1e-3),
        "v": Channel(t, seen.v, noise=1e-3),
        "ctrl": Channel(t[:-1], push),
    }
    return model, Recording("swing", channels)


@pytest.mark.slow
def test_differences_find_what_derivatives_find():
    model, run = swing()
    mass = {"mass": Unknown("bodies.mass", 0, positive=True)}
    found = identify(model, run, mass, estimate_initial_state=False, difference_step=0.03)
    assert found.success
    assert found.values["mass"] == pytest.approx(1.3, rel=3e-3)  # a tenth of the step


def test_bad_arguments():
    model, run = swing()
    mass = {"mass": Unknown("bodies.mass", 0, positive=True)}
    for given, words in [
        ({"difference_step": 0.0}, "difference_step is 0"),
        ({"difference_step": 0.03}, "initial states that are estimated"),
        ({"difference_step": 0.03, "multiple_shooting": 0.2}, "segments= works"),
    ]:
        with pytest.raises(InputError, match=words):
            identify(model, run, mass, **given)


@pytest.mark.slow
def test_tosses_with_several_impacts():
    """60 samples of a cube that tumbles, from a guess 40 % off, where derivatives stall."""
    truth = cube.model(0.25, 0.05, (0.012, 0.8), impedance=0.1)
    seen = tossed(truth, 60)
    names = ("friction", "half side")
    found = identify(
        cube.model(0.35, 0.055, (0.012, 0.8), impedance=0.1), cube.recordings(seen),
        {k: u for k, u in cube.unknowns().items() if k in names}, grid=cube.GRID, loss="huber",
        restarts=1, difference_step=0.03,
    )  # fmt: skip
    assert found.success
    assert found.values["friction"] == pytest.approx(0.25, rel=0.02)
    assert found.values["half side"] == pytest.approx(0.05, rel=0.01)
