"""Derivatives that read saved values, against the plain derivatives."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.extend.core.primitives import closed_call_p

import rbjax as rb
from rbjax.compiler.ir.program import batch_first
from rbjax.compiler.jax import saved
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Program, traced
from rbjax.compiler.jax.saved import HELD_UP_TO, SavedVjp, without_nested
from rbjax.compiler.lower.write import write_program
from rbjax.lanes import fusion_barrier
from tests.tolerances import F64_IDENTITY

X, Y = np.array([0.3, -1.2, 0.7]), np.array([1.5, 0.2, -0.4])
BOTH = (True, True)
ENTRIES = {"equations": 4, "loop": 3, "unread": 0, "none": 0}


def equations(x, y):
    """Saves three real numbers and an integer, and not a value that no derivative reads."""
    z = checkpoint_name(jnp.log(x * x + 2.0) + y, "factors")
    count = checkpoint_name(jnp.argmax(x), "contacts")
    unread = checkpoint_name(jnp.cosh(x) + 1.0, "acceleration")
    kept = jnp.take(y, count)
    return [jnp.sin(z) * kept, unread, z.sum() * count]


def loop(x, y):
    """The derivative of a loop is left to JAX."""
    z = checkpoint_name(jnp.log(x * x + 2.0) + y, "factors")
    turn = lambda c, k: (jnp.sin(c) * z + k, None)  # noqa: E731
    return [jax.lax.scan(turn, x, jnp.arange(3.0, dtype=x.dtype))[0]]


def unread(x, y):
    return [checkpoint_name(2.0 * x, "factors") + y]


def none(x, y):
    return [jnp.exp(x) * jnp.sin(y)]


FUNCTIONS = {"equations": equations, "loop": loop, "unread": unread, "none": none}


def program_of(f, dtype=np.float64) -> Program:
    """A program that saves."""
    return dataclasses.replace(traced(f, X.astype(dtype), Y.astype(dtype)), saves=True)


def call(program, x, y):
    return run(program, [jnp.asarray(x), jnp.asarray(y)])


def loss(f):
    """A sum of real results with different weights."""

    def total(x, y):
        real = [z for z in f(x, y) if jnp.issubdtype(z.dtype, jnp.floating)]
        return sum((jnp.cos(jnp.arange(z.size)) * z.ravel()).sum() for z in real).astype(x.dtype)

    return total


def count(jaxpr, name) -> int:
    """The number of equations of a primitive, with those of programs, loops and calls."""
    total = 0
    for eqn in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        params = list(eqn.params.values())
        if eqn.primitive.name == "custom_jvp_call":
            params = [eqn.params["call_jaxpr"]]
        inner = [x for x in jax.tree.leaves(params) if isinstance(x, Jaxpr | ClosedJaxpr)]
        inner += [x.closed for x in params if isinstance(x, Program)]
        total += (eqn.primitive.name == name) + sum(count(x, name) for x in inner)
    return total


@pytest.mark.parametrize("name", FUNCTIONS)
def test_residuals_and_cotangents(name):
    """The vector of residuals has the entries that the cotangents need."""
    f = FUNCTIONS[name]
    vjp = SavedVjp.of(program_of(f), BOTH)
    assert vjp.residuals.shape == (ENTRIES[name],) and vjp.bytes == 8 * ENTRIES[name]
    *values, left = vjp.forward(X, Y)
    for a, b in zip(values, f(X, Y), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)
    found, pull = jax.vjp(lambda x, y: f(x, y), X, Y)
    bars = [jnp.cos(jnp.arange(1.0 * z.size)).reshape(z.shape).astype(z.dtype) for z in found]
    for a, b in zip(vjp((X, Y), left, bars), pull(bars), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)


def test_values_that_are_saved_are_not_computed_again():
    vjp = SavedVjp.of(program_of(equations), BOTH)
    *values, left = vjp.forward(X, Y)
    back = jax.make_jaxpr(lambda *at: vjp(*at))((X, Y), left, values)
    assert count(back, "log") == 0 and count(back, "argmax") == 0
    # the derivative by x alone reads no less
    assert SavedVjp.of(program_of(equations), (True, False)).residuals.shape == (4,)


def test_rows_of_a_loop_are_saved_without_a_copy():
    """A thread holds only the rows that its loop reads, none that it writes."""

    def f(x, y):
        made = jax.lax.scan(lambda c, k: (c * k, c * jnp.exp(k)), x[0], jnp.arange(40.0))[1]
        made = checkpoint_name(made, "factors")
        return [jax.lax.scan(lambda c, z: (jnp.sin(c) * z, None), y[0], made)[0]]

    forward = SavedVjp.of(program_of(f), (False, True)).forward
    layouts = [[batch_first(a.shape, (64,)) for a in x] for x in (forward.inputs, forward.outputs)]
    assert forward.outputs[-1].size == 40
    assert write_program(forward.closed, (64,), *layouts).array_bytes == 0


def test_a_value_that_only_a_fusion_barrier_reads_is_not_saved():
    def f(x, y):
        z, u = (checkpoint_name(jnp.exp(a), "factors") for a in (x, y))
        return [fusion_barrier((z * y, u * x))[0]]

    assert SavedVjp.of(program_of(f), BOTH).residuals.shape == (3,)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_batches_and_modes(name, dtype):
    """Gradients of none, 0, 1 and 3 samples, forward mode and the second derivative."""
    f, program = FUNCTIONS[name], program_of(FUNCTIONS[name], dtype)
    plain, own = loss(f), loss(lambda x, y: call(program, x, y))
    x, y = X.astype(dtype), Y.astype(dtype)
    tight = 1e-12 if dtype == np.float64 else 1e-5
    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=tight, atol=tight)  # noqa: E731
    jax.tree.map(same, jax.grad(own, (0, 1))(x, y), jax.grad(plain, (0, 1))(x, y))
    for size in (0, 1, 3):
        xs, ys = np.stack([x] * 3 + [y])[:size], np.stack([y, x, x + y])[:size]
        for g in (jax.grad(own, (0, 1)), jax.grad(rb.threads(own), (0, 1))):
            found = jax.jit(jax.vmap(g))(xs, ys)
            want = jax.vmap(jax.grad(plain, (0, 1)))(xs, ys)
            jax.tree.map(same, found, want)
            assert found[0].dtype == dtype
    same(jax.jvp(own, (x, y), (y, x))[1], jax.jvp(plain, (x, y), (y, x))[1])
    along = lambda g: jax.jvp(jax.grad(g), (x, y), (y, x))[1]  # noqa: E731
    jax.tree.map(same, along(own), along(plain))


def test_loops_inside_of_a_thread_save_what_fits_into_its_memory():
    """A loop of few turns saves the values of each turn, a loop of many turns computes them again,
    a loop outside of programs saves."""
    program = program_of(equations)
    most = HELD_UP_TO // (8 * ENTRIES["equations"])

    def turns(n, f):
        return lambda x: jax.lax.scan(lambda c, _: (f(c, Y)[0], None), x, None, length=n)[0].sum()

    own = lambda x, y: call(program, x, y)  # noqa: E731
    for n in (1, 3):
        want = jax.grad(turns(n, equations))(X)
        for f in (turns(n, own), rb.threads(turns(n, own))):
            np.testing.assert_allclose(jax.grad(f)(X), want, rtol=1e-12)

    def computed(f):  # the number of times that the slope computes the logarithm
        return count(jax.make_jaxpr(jax.grad(f))(X), "log")

    in_thread = [computed(rb.threads(turns(n, own))) for n in (2, most, most + 1)]
    assert in_thread == [2, 2, 3]  # forward, forward of the slope, and again
    assert computed(turns(most + 1, own)) == 1
    # of a slope inside of a program the number of turns is not known
    assert count(jax.make_jaxpr(rb.threads(jax.grad(turns(2, own))))(X), "log") == 2


def test_programs_of_programs_that_save_do_so_if_they_run_once():
    program = program_of(equations)
    own = lambda x, y: call(program, x, y)[0]  # noqa: E731
    once = traced(lambda x, y: [own(own(x, y), y)], X, Y)
    twice = traced(lambda x, y: [jax.lax.fori_loop(0, 2, lambda _, z: own(z, y), x)], X, Y)
    many = traced(lambda x, y: [jax.vmap(own, (0, None))(jnp.stack([x, y]), y)], X, Y)
    for p, saves in ((once, True), (twice, False), (many, False)):
        assert saved.has_saving(p.closed.jaxpr) == saves
    names = {eqn.primitive.name for eqn in without_nested(once.closed).jaxpr.eqns}
    assert not names & {"threads", closed_call_p.name}
    nested = dataclasses.replace(once, saves=True)
    assert SavedVjp.of(nested, BOTH).residuals.shape == (8,)
    slope = jax.grad(lambda x: run(nested, [x, jnp.asarray(Y)])[0].sum())(X)
    plain = jax.grad(lambda x: equations(equations(x, Y)[0], Y)[0].sum())(X)
    np.testing.assert_allclose(slope, plain, rtol=F64_IDENTITY)
