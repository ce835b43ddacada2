"""diffrax on a thread: each sample of a batch takes its own adaptive steps."""

from __future__ import annotations

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import rbjax as rb
from rbjax.threads.frame import Written
from rbjax.threads.program import Loop, While, walk
from tests.threads.host import COMPILER, on_host, written

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")


def simulation(scene: str, solver: diffrax.AbstractSolver | None = None, times: int = 4):
    model = rb.load(scene)
    if scene == "arm7":
        model = model.replace(driver="rolled")

    def f(q, v):
        ts = jnp.linspace(0, 0.3, times)
        out = rb.simulate(model, rb.State(q, v), ts, solver=solver, throw=False)
        return out.q, out.v, out.ok, out.stats["num_steps"], out.stats["num_rejected_steps"]

    state = jax.vmap(model.random_state)(jax.random.split(jax.random.key(0), 3))
    return f, state.q, state.v


SOLVED = [
    ("double_pendulum", None),
    pytest.param("cart_pole", None, marks=pytest.mark.slow),
    pytest.param("arm7", None, marks=pytest.mark.slow),
    pytest.param("double_pendulum", diffrax.Kvaerno3(), marks=pytest.mark.slow),
    pytest.param("cart_pole", diffrax.Kvaerno3(), marks=pytest.mark.slow),
    pytest.param("cart_pole", rb.solvers.radau_iia(2), marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("scene", "solver"), SOLVED)
def test_each_sample_takes_its_own_steps(scene, solver):
    f, q, v = simulation(scene, solver)
    got, want = on_host(f, q, v), jax.jit(jax.vmap(f))(q, v)
    for g, w in zip(got[:2], want[:2], strict=True):
        np.testing.assert_allclose(g, w, atol=1e-12)
    for g, w in zip(got[2:], want[2:], strict=True):
        np.testing.assert_array_equal(g, w)
    assert len({*got[3].tolist()}) > 1


def copies(program: Written, size: int) -> int:
    """Loops over an array of this size, or more, that run at each turn of another loop."""
    loops = [s for s in walk(program.builder.block) if isinstance(s, While | Loop)]
    return sum(isinstance(s, Loop) and s.count >= size for loop in loops for s in walk(loop.body))


def test_saved_times_are_written_in_place():
    program, _, _ = written(*simulation("double_pendulum", times=1000))
    assert copies(program, 1000) == 0


def test_an_array_is_updated_in_place_under_a_condition():
    def f(x, n):
        def turn(k, c):
            rows, last = c
            new = lax.cond(x[k % 3] > 0, lambda r: r.at[k].set(x.sum() + k), lambda r: r, rows)
            return new, new[k] + last

        return lax.fori_loop(0, n, turn, (jnp.zeros(1000), 0.0))

    x, n = np.random.default_rng(0).normal(size=(4, 3)), np.array([0, 1, 8, 1000])
    assert copies(written(f, x, n)[0], 1000) == 0
    for got, want in zip(on_host(f, x, n), jax.vmap(f)(x, n), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-13)
