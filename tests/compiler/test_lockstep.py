"""Loops that the warps of a block run in step: which loops, and their results."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.compiler.cuda import kernels, lockstep
from rbjax.compiler.cuda.kernels import kernel
from rbjax.compiler.ir.program import BatchLayout, batch_first
from rbjax.compiler.ir.statements import Loop, While, walk
from rbjax.compiler.lower.write import write_program
from tests.compiler.block import emulated
from tests.compiler.host import COMPILER, written
from tests.tolerances import F64_TRANSFORM, relative_error

RNG = np.random.default_rng(0)
BALL = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 .1">
  <freejoint/><geom type="sphere" size=".1" mass="1"/></body></worldbody></mujoco>"""


def halve(x):
    """A `while` loop with as many iterations as the sample needs."""
    return jax.lax.while_loop(lambda y: y > 1.0, lambda y: y / 2.0, x)


def steps(x, w):
    """A rollout with a solver in each step, and a loop in a branch of it."""

    def step(c, _):
        c = halve(jnp.abs(c).sum() * 7.0) * jnp.sin(c + w) + 3.0
        c = jax.lax.cond(c[0] > 3.0, lambda: c * halve(c[0]), lambda: c)
        return c, c

    end, path = jax.lax.scan(step, x, None, length=5)
    return [end, path, (end * end).sum()]


def adaptive(x, w):
    """A loop whose number of turns is the sample's, with a counted loop in it."""

    def turn(c):
        y = jax.lax.scan(lambda y, _: (jnp.sin(y + w), None), c[0], None, length=3)[0]
        return y, c[1] - 1.0

    return [jax.lax.while_loop(lambda c: c[1] > 0, turn, (x, jnp.abs(x[0]) * 9.0))[0]]


def program(f, size, summed=()):
    x, w = jax.ShapeDtypeStruct((3,), np.float64), jax.ShapeDtypeStruct((3,), np.float64)
    closed = jax.make_jaxpr(f)(x, w)
    outs = [
        BatchLayout(a.shape, ()) if k in summed else batch_first(a.shape, (size,))
        for k, a in enumerate(closed.out_avals)
    ]
    flags = tuple(k in summed for k in range(len(outs)))
    ins = [batch_first(x.shape, (size,)), BatchLayout((3,), (None,))]
    shapes = [
        jax.ShapeDtypeStruct(a.shape if s else (size, *a.shape), a.dtype)
        for a, s in zip(closed.out_avals, flags, strict=True)
    ]
    return write_program(closed, (size,), ins, outs, flags), shapes


@pytest.fixture
def short(monkeypatch):
    """Short programs run in step, on one multiprocessor."""
    for name in ("LONG_PROGRAM", "LONG_ITERATION", "LONG_LOOP", "LONG_WHILE"):
        monkeypatch.setattr(lockstep, name, 0)
    monkeypatch.setattr(lockstep, "MULTIPROCESSORS", 1)


def test_which_loops_are_in_step(short):
    found, _ = program(steps, 64)
    chosen = lockstep.loops_in_step(found)
    every = [s for s in walk(found.builder.block) if isinstance(s, Loop | While)]
    kinds = [type(s) for s in every if id(s) in chosen]
    assert kinds == [Loop, While]  # not the one in the branch
    assert sum(isinstance(s, While) for s in every) == 2
    found, _ = program(adaptive, 64)
    assert not lockstep.loops_in_step(found)


def test_the_two_kinds_of_loops_have_their_own_bounds(short, monkeypatch):
    found, _ = program(steps, 64)
    every = [s for s in walk(found.builder.block) if isinstance(s, Loop | While)]
    for name, kept in (("LONG_LOOP", While), ("LONG_WHILE", Loop)):
        with monkeypatch.context() as bound:
            bound.setattr(lockstep, name, 10**6)
            chosen = lockstep.loops_in_step(found)
        assert [type(s) for s in every if id(s) in chosen] == [kept]


def test_short_programs_and_small_batches_have_blocks_of_one_warp(monkeypatch):
    assert kernel(program(steps, 64)[0]).block == 32
    for name in ("LONG_ITERATION", "LONG_LOOP", "LONG_WHILE"):
        monkeypatch.setattr(lockstep, name, 0)
    code = kernel(program(steps, 64)[0])
    assert (code.block, code.grid, code.parts) == (32, 2, 2) and "__syncthreads" not in code.source
    code = kernel(program(steps, 65536)[0])
    assert (code.block, code.grid, code.parts) == (256, 256, 2048)
    assert code.source.count("__syncthreads") == 2
    code = kernel(program(steps, 8192)[0])
    assert (code.block, code.grid, code.parts) == (64, 128, 256)


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("size", [300, pytest.param(250, marks=pytest.mark.slow)])
def test_results_are_those_of_samples(short, size):
    """The last block lacks warps, or its last warp lacks samples."""
    found, shapes = program(steps, size, summed={2})
    code = kernel(found)
    assert code.block == 256 and code.parts == -(-size // 32)
    x, w = 5.0 * RNG.normal(size=(size, 3)), RNG.normal(size=3)
    want = jax.vmap(steps, (0, None))(x, w)
    want[2] = want[2].sum()
    for got, due in zip(emulated(code, [x, w], shapes), want, strict=True):
        assert relative_error(got, due) <= F64_TRANSFORM


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*biased at any step size")
def test_a_rollout_with_contacts_and_its_gradient(short, monkeypatch):
    """Balls that fall, roll and jump, with different numbers of Newton steps; with their arrays in
    shared memory."""
    monkeypatch.setattr(kernels, "FILLS_REGISTERS", 0)
    model = rb.load(BALL)
    q = np.tile(model.default_state().q, (300, 1))
    q[:, 2] += 0.01 * RNG.normal(size=300)
    v = RNG.normal(size=(300, model.nv))

    def end(q, v):
        return rb.rollout(model, rb.State(q, v), None, 0.002, steps=12, save_every=4).v.ravel()

    for f in (end, lambda q, v: jax.grad(lambda v: (end(q, v) ** 2).sum())(v)):
        want = np.asarray(jax.jit(jax.vmap(f))(q, v))
        code = kernel(written(f, q, v)[0])
        assert code.block == 256 and "__syncthreads_or" in code.source and code.shared_bytes
        (got,) = emulated(code, [q, v], [jax.ShapeDtypeStruct(want.shape, want.dtype)])
        assert relative_error(got, want) <= F64_TRANSFORM
