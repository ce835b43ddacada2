"""`squares`: the gradient in both modes, beside the Jacobian of `identify` and differences."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.errors import InputError, UnknownName
from rbjax.sysid import Channel, Grid, Recording, Setup, Unknown, squares
from rbjax.sysid.simulation import objective
from rbjax.sysid.simulation.objective import _keep, faster

MODEL = rb.load("cart_pole")
SOUGHT = {
    "mass": Unknown("bodies.mass", positive=True),
    "delay": Unknown("delay", bounds=(0.0, 0.04)),
}
T, N = 0.01, 23


def recorded(seed, count=N):
    rng = np.random.default_rng(seed)
    t = np.arange(count) * T
    q = 0.3 * rng.normal(size=2) + np.cumsum(0.02 * rng.normal(size=(count, 2)), 0)
    return Recording(f"run {seed}", {
        "q": Channel(t, q), "v": Channel(t, rng.normal(size=(count, 2))),
        "ctrl": Channel(t, rng.normal(size=(count, 1))),
    })  # fmt: skip


class Servo(rb.model.record.Record):
    """A servo of the cart."""

    kp: jnp.ndarray

    def __call__(self, t, seen, command):
        return self.kp * (command - seen.q[:1])


SETUP = Setup.of(MODEL, Servo(jnp.array([5.0])), delay=0.012)
RUNS = [recorded(0), recorded(1, 18)]
GRID = Grid(T, 1, "rk4", 4)


@pytest.fixture(scope="module")
def forward():
    of = squares(SETUP, RUNS, SOUGHT, grid=GRID, estimate_initial_state=True, mode="forward")
    return of, *of.value_and_grad(of.x)


@pytest.mark.slow
def test_forward_is_twice_the_jacobian_by_the_residual(forward):
    of, value, slope = forward
    R = of._of.triangle(of.x)
    np.testing.assert_allclose(value, R[:, -1] @ R[:, -1], rtol=1e-12)
    np.testing.assert_allclose(slope, 2 * R[:, :-1].T @ R[:, -1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(of.value(of.x), value, rtol=1e-13)
    way, h = np.random.default_rng(0).normal(size=of.x.size), 1e-5
    way[of.names.index("delay")] *= 0.01
    both = (of.value(of.x + h * way) - of.value(of.x - h * way)) / (2 * h)
    np.testing.assert_allclose(slope @ way, both, rtol=1e-6)


@pytest.mark.parametrize("memory", [None, 1000])
def test_states_are_kept_within_the_memory_that_is_given_or_there(memory, monkeypatch):
    asked = []
    monkeypatch.setattr(objective, "_keep", lambda setup, runs, grid, budget: asked.append(budget))
    monkeypatch.setattr(objective, "memory_share", lambda: 12345)
    how = {"grid": GRID, "estimate_initial_state": False, "mode": "reverse"}
    squares(SETUP, RUNS, SOUGHT, memory=memory, **how)
    assert asked == [memory or 12345]


@pytest.mark.parametrize("memory", [pytest.param(None, marks=pytest.mark.slow), 1000])
def test_reverse_is_forward(forward, memory):
    """Whether each state is kept, or every fourth."""
    _, value, slope = forward
    of = squares(
        SETUP, RUNS, SOUGHT, grid=GRID, estimate_initial_state=True, mode="reverse", memory=memory
    )
    found = of.value_and_grad(of.x)
    np.testing.assert_allclose(found[0], value, rtol=1e-12)
    np.testing.assert_allclose(found[1], slope, rtol=1e-9, atol=1e-9)


def test_what_reverse_mode_keeps():
    """Every state where there is room, and never fewer than sqrt(N) of N."""
    of = squares(SETUP, RUNS, SOUGHT, grid=GRID, estimate_initial_state=True, mode="forward")._of
    each = 2 * (4 + 6) * 8  # two runs, a state and the commands that wait, f64
    assert _keep(SETUP, of.runs, GRID, each * N) == 1
    assert _keep(SETUP, of.runs, GRID, each * N / 2) == 2
    assert _keep(SETUP, of.runs, GRID, 1.0) == 4


def test_the_mode_is_that_of_the_shape():
    assert faster(1, 1, 8) == "forward" == faster(4, 16, 8)
    assert faster(2, 1, 8) == "reverse" == faster(14, 16, 8)


def test_arguments():
    with pytest.raises(UnknownName, match="mode of squares 'both'"):
        squares(MODEL, RUNS, SOUGHT, mode="both")
    with pytest.raises(InputError, match="memory is -1"):
        squares(MODEL, RUNS, SOUGHT, memory=-1)
