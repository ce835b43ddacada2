"""Long code in pieces gives what it gives in one, loops, branches and arrays included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.compiler.ir.program import batch_first
from rbjax.compiler.jax import launch
from rbjax.compiler.llvm.xla_handler import write_handler
from rbjax.compiler.lower.write import write_program
from rbjax.compiler.passes import cutting


def straight(x):
    for k in range(6):
        x = jnp.sin(x) * x[k % 3] + jnp.where(x > 0.2, x, k)
    return [x, x.sum() > 0]


def loops(x):
    def turn(c, k):
        i, y = c
        for _ in range(4):
            y = y * 0.5 + jnp.cos(y) * x
        y = jax.lax.cond(y[0] > y[1], lambda y: y * y, lambda y: y - 1.0, y)
        return (i + 1, y), y[i % 3]

    (i, y), out = jax.lax.scan(turn, (0, x), jnp.arange(5))
    y = jax.lax.while_loop(lambda y: y[0] < 3.0, lambda y: jnp.sqrt(y * y + 1.0), y)
    return [i, y, out, jax.lax.dynamic_slice(out, (i % 4,), (2,))]


def short(x):
    """A branch, a loop and values that several pieces read."""
    y = jnp.sin(x) * x[0]
    y = jax.lax.cond(y[0] > y[1], lambda y: y * y, lambda y: y - 1.0, y)
    (z, _), out = jax.lax.scan(lambda c, k: ((c[0] * 0.5 + y, k), c[0][k]), (x, 0), jnp.arange(2))
    return [y + z, out]


def compared(monkeypatch, f, count, above, each):
    """Compare the machine code of pieces of `each` statements, of code in one, and XLA."""
    x = 0.3 * jnp.array(np.random.default_rng(3).normal(size=(count, 3)))  # not chaotic
    closed = jax.make_jaxpr(f)(x[0])
    ins = [batch_first(x.shape[1:], (count,))]
    outs = [batch_first(a.shape, (count,)) for a in closed.out_avals]

    def kernel():
        program = write_program(closed, (count,), ins, outs, platform="cpu")
        functions = write_handler(program)[0].text.count("define internal")
        made = launch.register_host_kernel(program)
        return functions, jax.jit(lambda x: launch.call_host_kernel(made, [x], shapes))(x)

    shapes = [jax.core.ShapedArray((count, *a.shape), a.dtype) for a in closed.out_avals]
    few, whole = kernel()
    monkeypatch.setattr(cutting, "CUT_ABOVE", above)
    monkeypatch.setattr(cutting, "EACH", each)
    many, pieces = kernel()
    assert many > few
    for a, b, c in zip(pieces, whole, jax.vmap(f)(x), strict=True):
        # sums and products in one rounding or two
        np.testing.assert_allclose(a, b, rtol=1e-12)
        np.testing.assert_allclose(a, c, rtol=1e-12)


@pytest.mark.parametrize("count", [1, 11])
def test_short_pieces_give_the_same(monkeypatch, count):
    compared(monkeypatch, short, count, 6, 4)


@pytest.mark.parametrize("f", [straight, loops])
@pytest.mark.parametrize("count", [1, 11])
def test_pieces_give_the_same(monkeypatch, f, count):
    compared(monkeypatch, f, count, 12, 6)
