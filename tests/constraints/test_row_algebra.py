"""Sums, products and functions of rows against the same of scalars, differentiated: random
expressions of holonomic rows and of rows that have only a rate."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rbjax as rb
from rbjax.constraints.equations.model_rows import gradient_matrix
from rbjax.constraints.rows.geometry import time
from rbjax.constraints.rows.row import Row, angle, function_of
from rbjax.forces import Context

MODEL = rb.load("double_pendulum")
T = 0.3
Q, V, A = np.array([0.4, -0.7]), np.array([0.9, 0.6]), np.array([-1.1, 0.8])
#: f32 rounds to 6e-8; an expression has up to a hundred roundings of numbers up to about ten
ATOL = {jnp.float64: 1e-12, jnp.float32: 1e-4}


@dataclass
class Pair:
    """A row, and the scalar s(t, q, v) that it stands for."""

    row: Row
    scalar: Callable

    @property
    def level(self) -> bool:
        return self.row.value is not None


def atoms(context: Context) -> list[Pair]:
    x, y, t = (
        rb.constraints.coordinate(context, 0),
        rb.constraints.coordinate(context, 1),
        time(context),
    )
    return [
        Pair(x, lambda t, q, v: q[0]),
        Pair(y, lambda t, q, v: q[1]),
        Pair(t, lambda t, q, v: t),
        Pair(Row.constant(0.7), lambda t, q, v: 0.7 + 0 * t),
        Pair(x.time_derivative, lambda t, q, v: v[0]),
        Pair(y.time_derivative, lambda t, q, v: v[1]),
    ]


def checked(context: Context, pair: Pair, dtype: type) -> None:
    row, s = pair.row, pair.scalar
    q, v, a = (jnp.asarray(x) for x in (Q, V, A))

    def along(h):
        return s(T + h, q + h * v + h * h / 2 * a, v + h * a)

    def slope(h):
        return jax.jvp(along, (h,), (1.0,))

    (value, rate), (_, bent) = jax.jvp(slope, (0.0,), (1.0,))
    if pair.level:
        G = jax.grad(lambda q: s(T, q, v))(q)
        own, due = (row.value, row.rate, row.acceleration), (value, rate, bent)
    else:
        G = jax.grad(lambda v: s(T, q, v))(v)
        own, due = (row.rate, row.acceleration), (value, rate)
    np.testing.assert_allclose(np.array(own), np.array(due), rtol=0, atol=ATOL[dtype])
    np.testing.assert_allclose(gradient_matrix(context, [row])[0], G, rtol=0, atol=ATOL[dtype])


def instant(dtype: type) -> Context:
    state = rb.State(jnp.asarray(Q, dtype), jnp.asarray(V, dtype))
    return Context.of(MODEL, jnp.asarray(T, dtype), state, None).accelerating(jnp.asarray(A, dtype))


def combined(what: str, one: Pair, two: Pair, c: float) -> Pair:
    f, g = one.scalar, two.scalar
    made: dict[str, Callable[[], tuple[Row, Callable]]] = {
        "+": lambda: (one.row + two.row, lambda *x: f(*x) + g(*x)),
        "-": lambda: (one.row - two.row, lambda *x: f(*x) - g(*x)),
        "+c": lambda: (one.row + c, lambda *x: f(*x) + c),
        "c-": lambda: (c - one.row, lambda *x: c - f(*x)),
        "*c": lambda: (c * one.row, lambda *x: f(*x) * c),
        "*": lambda: (one.row * two.row, lambda *x: f(*x) * g(*x)),
        "f": lambda: (one.row.apply(jnp.tanh), lambda *x: jnp.tanh(f(*x))),
    }
    return Pair(*made[what]())


@pytest.mark.parametrize("dtype", ATOL)
@given(data=st.data())
@settings(max_examples=12, deadline=None, derandomize=True)
def test_expressions(dtype: type, data: st.DataObject) -> None:
    context = instant(dtype)
    known = atoms(context)
    for _ in range(data.draw(st.integers(1, 6))):
        one, two = (data.draw(st.sampled_from(known)) for _ in range(2))
        what = data.draw(st.sampled_from(["+", "-", "+c", "c-", "*c", "*", "f"]))
        given_ = what, one, two, data.draw(st.sampled_from([-1.5, 0.0, 0.25, 2.0]))
        if (what == "*" and not one.level and not two.level) or (what == "f" and not one.level):
            with pytest.raises(rb.InputError, match="only a rate"):
                combined(*given_)
            continue
        known.append(combined(*given_))
    checked(context, known[-1], dtype)


@pytest.mark.parametrize("dtype", ATOL)
def test_functions_of_several_rows(dtype: type) -> None:
    context = instant(dtype)
    x, y, *_ = atoms(context)
    turned = angle(x.row, y.row)
    checked(context, Pair(turned, lambda t, q, v: jnp.arctan2(q[0], q[1])), dtype)
    both = lambda z: jnp.stack([z[0] * jnp.sin(z[1]), z[1] ** 2])  # noqa: E731
    for k, row in enumerate(function_of([x.row, y.row], both, dtype)):
        checked(context, Pair(row, lambda t, q, v, k=k: both(q)[k]), dtype)


def test_functions_of_rates_are_refused() -> None:
    context = instant(jnp.float64)
    x, rate = atoms(context)[0].row, atoms(context)[4].row
    for f in (
        lambda: rate * rate,
        lambda: rate.apply(jnp.sin),
        lambda: rate.time_derivative,
        lambda: angle(x, rate),
        lambda: function_of([x, rate], jnp.sin, jnp.float64),
    ):
        with pytest.raises(rb.InputError, match="only a rate"):
            f()


class Speed(rb.constraints.Constraint):
    """v = wanted: the row of a rate that the algebra makes."""

    wanted: jax.Array
    size = 1

    def rows(self, context: Context) -> list[Row]:
        return [rb.constraints.coordinate(context, "slider").time_derivative - self.wanted]


@pytest.mark.parametrize("dtype", ATOL)
def test_a_rate_is_held(dtype: type) -> None:
    model = rb.load("cart_pole").with_constraints(Speed(jnp.asarray(0.3, dtype)))
    state = model.default_state()
    state = rb.State(state.q.astype(dtype), jnp.asarray([0.3, 0.0], dtype))
    path = rb.rollout(model, state, None, 0.01, steps=20)
    np.testing.assert_allclose(path.v[:, 0], 0.3, rtol=0, atol=1e-6)
    still = rb.constraints.assemble(model, state.replace(v=0 * state.v))
    np.testing.assert_allclose(still.state.v[0], 0.3, rtol=0, atol=1e-6)
