"""Model predictive control with constraints and goals that move: what the result of a tick says."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.control import Constraint, Control, Cost, Equations, Problem, StateError, mpc
from rbjax.control.optimal.ticks import KEPT, PLANNED, VIOLATED

LIMIT, OFF = 0.2, 1e-4  # m/s, and the default violation


def slider(horizon=12):
    """To 1 m, with a limit on the speed that binds most of the way."""
    system = Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)
    return Problem(
        system, horizon, 0.1, running=[lambda t, x, u: 10 * (x - jnp.array([1.0, 0.0])), Control()],
        constraints=[Constraint(lambda t, x, u: x[1:], -LIMIT, LIMIT, "all", "speed")],
    )  # fmt: skip


def silent(run):
    """Ticks that end above the limit and do not say so."""
    off = np.abs(run.states[1:, 1]) - LIMIT > OFF
    return int((off & (np.asarray(run.statuses) == PLANNED)).sum())


def test_the_limit_is_held_at_default_settings():
    run = mpc(slider()).closed_loop(jnp.zeros(2), 25)
    assert np.abs(run.states[:, 1]).max() <= LIMIT + OFF
    assert (run.statuses == PLANNED).all()
    assert np.abs(run.states[:, 1]).max() > 0.999 * LIMIT  # it binds


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ddp", "sqp"])
@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("iterations", [1, 3, None])
def test_a_tick_above_the_limit_says_so(method, delay, iterations):
    controller = mpc(slider(20), method=method, delay=delay, iterations=iterations)
    run = controller.closed_loop(jnp.zeros(2), 60)
    assert silent(run) == 0
    assert iterations is not None or np.abs(run.states[:, 1]).max() <= LIMIT + OFF


def test_a_start_beyond_the_limit_is_said_and_led_back():
    controller = mpc(slider(), delay=0)
    run = controller.closed_loop(jnp.array([0.0, 0.3]), 8)
    assert int(run.statuses[0]) == VIOLATED
    assert abs(float(run.states[-1, 1])) <= LIMIT + OFF and KEPT not in run.statuses.tolist()


@pytest.mark.parametrize("delay", [0, pytest.param(1, marks=pytest.mark.slow),
                                   pytest.param(3, marks=pytest.mark.slow), 6])  # fmt: skip
@pytest.mark.parametrize("form", ["function", "absolute", "reference"])
def test_goals_that_move_are_those_of_the_time_of_the_control(delay, form):
    """x' = u to sin 2t: a goal d ticks old would cost 0.14 d in the mean square."""
    line = Equations(lambda t, x, u: u, 1, 1)
    small = lambda s, x, u: 0.01 * u  # noqa: E731

    def ahead(t):
        return Problem(line, 10, 0.1, running=[lambda s, x, u: 30 * (x - jnp.sin(2 * (t + s))),
                                               small])  # fmt: skip

    if form == "function":
        given = ahead
    elif form == "absolute":
        given = ahead(0.0)
    else:
        goal = Cost(StateError(lambda t: jnp.sin(2 * t)[None]), 900.0)
        given = Problem(line, 10, 0.1, running=[goal, small])
    run = jax.jit(functools.partial(mpc(given, delay=delay).closed_loop, steps=60))(jnp.zeros(1))
    late = slice(30, None)
    off = run.states[late, 0] - jnp.sin(2 * run.ts[late])
    assert float(jnp.sqrt(jnp.mean(off**2))) < 1e-3
