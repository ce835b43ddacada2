"""diffrax on a thread: each sample of a batch takes its own adaptive steps."""

from __future__ import annotations

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import rbjax as rb
from rbjax.compiler.ir.program import Written
from rbjax.compiler.ir.statements import Loop, While, walk
from tests.compiler.host import COMPILER, many_on_host, on_host, written
from tests.robots import QUICK
from tests.tolerances import relative_error

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")

# A step's size follows from an estimate of 1e-8, in which rounding is 1e-8; a gradient goes through
# it. Measured: 2e-11.
ADAPTIVE = 1e-9


def simulation(scene: str, solver: diffrax.AbstractSolver | None = None, times: int = 4):
    model = rb.load(scene)
    if scene == "arm7":
        model = model.replace(driver="rolled")

    def f(q, v):
        ts = jnp.linspace(0, 0.3, times)
        out = rb.simulate(model, rb.State(q, v), ts, solver=solver, throw=False)
        return out.q, out.v, out.success, out.stats["num_steps"], out.stats["num_rejected_steps"]

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


@pytest.mark.parametrize(
    "adjoint",
    [
        diffrax.RecursiveCheckpointAdjoint(),
        pytest.param(diffrax.DirectAdjoint(), marks=pytest.mark.slow),
        pytest.param(diffrax.ForwardMode(), marks=pytest.mark.slow),
    ],
    ids=lambda adjoint: type(adjoint).__name__,
)
def test_a_gradient_is_a_thread_too(adjoint):
    """Where `max_steps` is small enough for what it keeps to be arrays of a thread."""
    model = rb.load("pendulum")

    def last(q, v):
        out = rb.simulate(model, rb.State(q, v), jnp.linspace(0, 0.3, 4), adjoint=adjoint,
                          max_steps=64, throw=False)  # fmt: skip
        return (out.q[-1] ** 2).sum()

    def along(q, v):
        if isinstance(adjoint, diffrax.ForwardMode):
            return jax.jvp(last, (q, v), (v, q))
        return jax.value_and_grad(last, (0, 1))(q, v)

    _, q, v = simulation("pendulum")
    (got,) = many_on_host([(along, (q, v))], ("-O0",))
    want = jax.jit(jax.vmap(along), compiler_options=QUICK)(q, v)
    for g, w in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert relative_error(g, w, batch_dims=1).max() <= ADAPTIVE


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
