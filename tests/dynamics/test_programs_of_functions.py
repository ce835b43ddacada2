"""Programs of a user's functions are let go with them: a loop of fresh lambdas does not grow."""

import gc
import weakref

import jax
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.tracing import algorithm as entry

KEPT = 2


def alive(run, count: int) -> int:
    """The functions that are still referenced after calls with `count` fresh ones."""
    seen = []
    for k in range(count):
        law = lambda model, t, state, tau, wrenches, k=k: tau + k  # noqa: E731
        run(law)
        seen.append(weakref.ref(law))
        del law
    gc.collect()
    return sum(ref() is not None for ref in seen)


def test_an_algorithm_keeps_a_few_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(entry, "PROGRAMS_OF_FUNCTIONS", KEPT)

    @entry.algorithm("q")
    def applied(model: rb.Model, q: jax.Array, dynamics=None) -> jax.Array:
        return dynamics(model, 0.0, None, q, None)

    model, q = rb.load("pendulum"), np.ones(1)
    assert [float(applied(model, q, dynamics=lambda *a, k=k: a[3] * k)[0]) for k in range(4)] == [
        0.0, 1.0, 2.0, 3.0,
    ]  # fmt: skip
    assert alive(lambda law: applied(model, q, dynamics=law), 6) <= KEPT


@pytest.mark.slow
@pytest.mark.parametrize("function", [rb.step, rb.linearise])
def test_steps_and_linearisations_do_not_grow(function) -> None:
    model = rb.load("pendulum")
    state = model.default_state()
    limit = entry.PROGRAMS_OF_FUNCTIONS
    found = alive(lambda law: function(model, state, None, 0.01, dynamics=law), limit + 8)
    assert found <= limit
