"""Derivatives equation by equation against JAX's own, of values and of what a program can hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import check_jaxpr, jaxpr_as_fun

from rbjax.compiler.jax.derivatives import LinearisedJaxpr
from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import traced
from rbjax.lanes import fusion_barrier, sincos

X = jnp.array([0.3, -1.2, 0.7])
Y = jnp.array([[0.5, 0.1, -0.4], [1.1, 0.9, 0.2]])


@jax.custom_jvp
def cubed(x, k):
    return x**3 + k


@cubed.defjvp
def _(primals, tangents):
    (x, k), (dx, _) = primals, tangents
    return cubed(x, k), 7.0 * dx  # not the derivative: only the rule gives it


def arithmetic(x, y):
    c, s = sincos(x[1])
    a = jnp.where(x > 0, x * y[0], y[1] / (1.0 + x**2))
    return [jnp.sqrt(a * a + 1.0) * c - s, jnp.concatenate([x, a])[::-1], y.T.sum(0)]


def calls(x, y):
    inner = jax.jit(lambda a, b: jnp.sin(a) * b)
    x, z = fusion_barrier((x, inner(x, y[0])))
    return [cubed(z, 1.0), inner(z, x), jnp.floor(x), jnp.argmax(x)]


def indexed(x, y):
    return [y[jnp.array([1, 0, 1]), :2].sum(1) * x, x.at[1].add(y[0, 0]), jnp.linalg.norm(x)]


def looped(x, y):
    return [jax.lax.scan(lambda c, row: (jnp.sin(c) + row, c * row), x, y)[1]]


CASES = {"arithmetic": arithmetic, "calls": calls, "indexed": indexed, "looped": looped}


def of_floats(found):
    return [x for x in found if jnp.issubdtype(x.dtype, jnp.floating)]


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("moving", [(True, True), (True, False), (False, True)])
def test_tangents_are_those_of_jax(name, moving):
    f = CASES[name]
    linear = LinearisedJaxpr.of(traced(f, X, Y).closed, moving)
    closed = linear.tangent([])
    check_jaxpr(closed.jaxpr)
    given = [x for x, m in zip((jnp.cos(X), jnp.sin(Y)), moving, strict=True) if m]
    got = of_floats(jaxpr_as_fun(closed)(X, Y, *given))
    every = [x if m else 0 * x for x, m in zip((jnp.cos(X), jnp.sin(Y)), moving, strict=True)]
    want = jax.jvp(lambda *a: of_floats(f(*a)), (X, Y), tuple(every))[1]
    floats = [a for a in closed.jaxpr.outvars if jnp.issubdtype(a.aval.dtype, jnp.floating)]
    assert len(got) == len(floats) >= len(want)
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-14)  # rounding of some operations


@pytest.mark.parametrize("name", ["arithmetic", "calls", "indexed"])
def test_cotangents_are_those_of_jax(name):
    f = CASES[name]
    program = traced(f, X, Y)
    weighed = tuple(jnp.issubdtype(a.dtype, jnp.floating) for a in program.outputs)
    back = LinearisedJaxpr.of(program.closed, (True, True)).transposed(weighed)
    assert back is not None
    closed = back()
    check_jaxpr(closed.jaxpr)
    found, pull = jax.vjp(lambda *a: of_floats(f(*a)), X, Y)
    bars = [jnp.cos(1.0 + x) for x in found]
    for a, b in zip(jaxpr_as_fun(closed)(X, Y, *bars), pull(bars), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-14)


def test_a_loop_of_values_and_rates_is_left_to_jax():
    program = traced(looped, X, Y)
    assert LinearisedJaxpr.of(program.closed, (True, True)).transposed((True,)) is None
    back = program.transposed((True, False), (True,))
    found, pull = jax.vjp(lambda x: looped(x, Y), X)
    (got,), (want,) = back(X, Y, found[0]), pull(found)
    np.testing.assert_allclose(got, want, rtol=1e-14)


def test_a_loop_whose_result_decides_is_left_to_jax():
    """Of a condition that only seems to depend on the rates of a loop no cotangent is taken."""

    def f(x, y):
        (end,) = looped(x, y)
        done = jnp.abs(jax.lax.stop_gradient(end[-1])).max() < 1.0
        return [jnp.where(done, end, jnp.nan)]

    linear = LinearisedJaxpr.of(traced(f, X, Y).closed, (True, True))
    assert linear.transposed([True]) is None


def test_a_value_that_is_given_is_not_computed():
    program = traced(lambda x: [jnp.sin(jnp.exp(x))], X)
    linear = LinearisedJaxpr.of(program.closed, (True,))
    made = next(e.outvars[0] for e in linear.eqns.eqns if e.primitive.name == "exp")
    closed = linear.transposed((True,))([made])
    assert "exp" not in {e.primitive.name for e in closed.jaxpr.eqns}
    (got,) = jaxpr_as_fun(closed)(X, jnp.exp(X), jnp.ones(3))
    np.testing.assert_allclose(got, jnp.cos(jnp.exp(X)) * jnp.exp(X), rtol=1e-14)


@pytest.mark.parametrize("mixed", [False, True])
def test_a_program_in_a_derivative_rule_is_transposed(mixed):
    """A program that is linear in rates is one linear equation, unless it returns values too."""

    def rate(x, y, dx):
        return [y @ (jnp.sin(x) * dx), *([x * x] if mixed else [])]

    program = traced(rate, X, Y, X)

    @jax.custom_jvp
    def g(x, y):
        return y @ -jnp.cos(x)

    @g.defjvp
    def _(primals, tangents):
        (x, y), (dx, _) = primals, tangents
        found = run(program, [x, y, dx])
        return g(x, y), found[0] + (jnp.sum(0.0 * found[1]) if mixed else 0.0)

    def plain(x):
        return Y @ -jnp.cos(x)

    transposed = LinearisedJaxpr.of(traced(lambda x: [g(x, Y)], X).closed, (True,)).transposed
    assert (transposed((True,)) is None) == mixed
    for f in (lambda h: h, jax.vmap):
        x = X if f(plain) is plain else jnp.stack([X, 2 * X])
        values, pull = jax.vjp(f(lambda x: g(x, Y)), x)
        want, pull_plain = jax.vjp(f(plain), x)
        np.testing.assert_allclose(values, want)
        np.testing.assert_allclose(pull(values)[0], pull_plain(values)[0], rtol=1e-13)
