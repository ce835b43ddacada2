"""The line of a long search."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.control import Control, Equations, Problem, solve
from rbjax.control.optimal import solver


@pytest.mark.slow
def test_each_iteration_is_said_and_a_program_ignores_it(monkeypatch):
    said = []

    @contextlib.contextmanager
    def line(label, show=True):
        said.append(label)
        yield said.append

    monkeypatch.setattr(solver, "progress_line", line)
    system = Equations(lambda t, x, u: x + u - 0.1 * x**3, 1, 1, discrete=True)
    problem = Problem(system, 4, 1.0, running=[Control()], terminal=[lambda t, x, u: x])
    s = solve(problem, jnp.ones(1), progress=True)
    assert said[0] == "solve (ddp)" and len(said) == 1 + int(s.iterations)
    assert said[-1].startswith(f"iteration {int(s.iterations)}, cost ")
    inside = jax.jit(lambda x: solve(problem, x, progress=True).cost)(jnp.ones(1))
    np.testing.assert_allclose(inside, s.cost, rtol=1e-12)
    assert len(said) == 1 + int(s.iterations)
