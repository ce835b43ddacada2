"""diffrax on a thread: each sample of a batch takes its own adaptive steps."""

from __future__ import annotations

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
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


def test_saved_times_are_written_in_place():
    """Code and copies do not grow with the number of times that are kept."""
    from rbjax.threads.program import Loop, While, walk

    def loops_inside_loops(times: int) -> int:
        program, _, _ = written(*simulation("double_pendulum", times=times))
        whiles = [s for s in walk(program.builder.block) if isinstance(s, While)]
        return sum(isinstance(s, Loop) and s.count >= times for w in whiles for s in walk(w.body))

    assert loops_inside_loops(1000) == 0
