"""Warm starts: a solution by its gains, controls alone, and what is wrong with a guess."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.control import Constraint, Control, Cost, Equations, Problem, solve
from rbjax.errors import InputError

#: x'' = 9 sin x + u: over 6 s an error grows by e^18 without feedback
UNSTABLE = Equations(lambda t, x, u: jnp.stack([x[1], 9 * jnp.sin(x[0]) + u[0]]), 2, 1)
START, NEAR = jnp.array([0.5, 0.0]), jnp.array([0.55, 0.1])


def balance(steps=60, **more):
    return Problem(
        UNSTABLE, steps, 0.1, running=[Cost(Control(), 0.01), lambda t, x, u: x],
        bounds=(-30.0, 30.0), **more,
    )  # fmt: skip


def test_a_solution_follows_an_unstable_plant_from_another_start():
    first = solve(balance(), START)
    cold, warm = solve(balance(), NEAR), solve(balance(), NEAR, guess=first)
    assert warm.success and cold.success
    assert float(warm.costs[0]) < 1.001 * float(cold.cost)  # already the first motion is good
    assert int(warm.iterations) < int(cold.iterations)
    assert abs(float(warm.cost - cold.cost)) < 1e-9


def test_controls_alone_are_rolled_out():
    first = solve(balance(), START)
    again = solve(balance(), START, ctrl=first.ctrl)
    assert int(again.iterations) <= 2 and float(again.costs[0]) < 1.001 * float(first.cost)
    # from another start the plant carries them away: the guess is to stand at the start
    other = solve(balance(), NEAR, ctrl=first.ctrl)
    assert other.success
    assert abs(float(other.cost - solve(balance(), NEAR).cost)) < 1e-9


@pytest.mark.slow
def test_multipliers_of_the_guess_are_those_to_begin_with():
    held = {
        "constraints": [
            Constraint(lambda t, x, u: x, where="end", name="rest"),
            Constraint(lambda t, x, u: x[1:], -0.3, 0.3, name="speed"),
        ]
    }
    first = solve(balance(**held), START)
    again = solve(balance(**held), START, guess=first)
    assert first.success and again.success
    assert int(again.iterations) < int(first.iterations)
    assert solve(balance(), START, guess=first).success  # of no constraints: none


@pytest.mark.slow
def test_single_precision():
    with jax.enable_x64(False):
        start, near = (jnp.asarray(x, jnp.float32) for x in (START, NEAR))
        first = solve(balance(), start)
        warm = solve(balance(), near, guess=first)
        assert first.cost.dtype == jnp.float32 and warm.success
        assert float(warm.costs[0]) < 1.01 * float(warm.cost)


@pytest.mark.parametrize(("said", "given"), [
    (r"guess and \['ctrl'\]", lambda s: {"guess": s, "ctrl": s.ctrl}),
    ("shape", lambda s: {"guess": solve(balance(5), START)}),
])  # fmt: skip
def test_a_guess_that_does_not_fit_is_rejected(said, given):
    first = solve(balance(), START)
    with pytest.raises(InputError, match=said):
        solve(balance(), START, **given(first))


def test_a_guess_that_diverges_leaves_a_finite_answer():
    s = solve(balance(), START, ctrl=jnp.full((60, 1), 1e300))
    assert np.isfinite(s.states).all() and s.success
