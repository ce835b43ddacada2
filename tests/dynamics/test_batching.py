"""A batch against single samples, under every transformation."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.tracing import algorithm, one_sample
from tests.compilations import compilations
from tests.tolerances import F64_IDENTITY, F64_TRANSFORM, relative_error

MODEL = rb.load("cart_pole")
SIZE = 259
SOME = np.array([0, 1, 127, 128, SIZE - 1])


@pytest.fixture(scope="module")
def given() -> tuple[jax.Array, jax.Array, jax.Array]:
    rng = np.random.default_rng(0)
    return tuple(jnp.asarray(rng.normal(size=(SIZE, 2))) for _ in range(3))


def fd(model, q, v, tau):
    return rb.forward_dynamics(model, q, v, tau)


def loop(f, *xs):
    return np.stack([np.asarray(f(*(x[i] for x in xs))) for i in SOME])


def test_a_batch_under_xla_is_the_samples(given, monkeypatch):
    for module in (algorithm, one_sample):
        monkeypatch.setattr(module, "kernels_available", lambda: False)
    run = functools.partial(fd, MODEL)
    mapped = jax.jit(jax.vmap(run))
    assert "threads" not in jax.make_jaxpr(mapped)(*given).pretty_print()
    assert relative_error(mapped(*given)[SOME], loop(run, *given)) <= F64_TRANSFORM


def test_what_is_not_batched_is_given_whole(given):
    q, v, tau = given
    one = jax.jit(jax.vmap(lambda q: fd(MODEL, q, v[0], tau[0])))(q)
    assert relative_error(one[SOME], loop(lambda q: fd(MODEL, q, v[0], tau[0]), q)) <= F64_TRANSFORM


def test_a_batch_of_robots(given):
    masses = np.asarray(MODEL.bodies.mass) * np.linspace(0.5, 2, SIZE)[:, None]

    def run(mass, q, v, tau):
        return fd(MODEL.replace(bodies=MODEL.bodies.replace(mass=mass)), q, v, tau)

    mapped = jax.jit(jax.vmap(run))(masses, *given)
    assert relative_error(mapped[SOME], loop(run, masses, *given)) <= F64_TRANSFORM


def test_a_batch_of_batches(given):
    nested = [x[: SIZE - 1].reshape(-1, 2, 2).swapaxes(0, 1) for x in given]  # (2, 129, 2)
    run = functools.partial(fd, MODEL)
    mapped = jax.jit(jax.vmap(jax.vmap(run)))(*nested)
    want = jax.jit(jax.vmap(run))(*(x.swapaxes(0, 1).reshape(-1, 2) for x in nested))
    assert relative_error(mapped.swapaxes(0, 1).reshape(-1, 2), want) <= F64_TRANSFORM


def test_derivatives_inside_and_outside_of_the_batch(given):
    """grad under vmap, vmap under grad, forward mode, and the derivative of a derivative."""
    q, v, tau = given

    def energy(q, v, tau):
        return (fd(MODEL, q, v, tau) ** 2).sum()

    @jax.jit
    def every(q):
        inside = jax.vmap(jax.grad(energy))(q, v, tau)
        outside = jax.grad(lambda q: jax.vmap(energy)(q, v, tau).sum())(q)
        forward = jax.vmap(jax.jacfwd(energy))(q, v, tau)
        twice = jax.vmap(jax.hessian(energy))(q, v, tau)
        return inside, outside, forward, twice

    inside, outside, forward, twice = every(q)
    assert relative_error(outside, inside) <= F64_IDENTITY
    assert relative_error(forward, inside) <= F64_IDENTITY
    step = 1e-5
    change = every(q + step * jnp.array([0.0, 1.0]))[0] - every(q - step * jnp.array([0.0, 1.0]))[0]
    assert relative_error(twice[:, :, 1], change / (2 * step)) <= 1e-7


def test_outside_of_jit_nothing_compiles_twice(given):
    """A vmap or grad of a public algorithm runs one compiled program, which is cached."""
    run = functools.partial(fd, MODEL)
    first = jax.vmap(run)(*given)

    def slope(q):
        return jax.grad(lambda q: run(q, given[1][0], given[2][0]).sum())(q)

    slope(given[0][0])
    other = given[0][1]
    with compilations() as compiled:
        again = jax.vmap(run)(*given)
        slope(other)
    assert not compiled
    assert relative_error(again, first) <= F64_TRANSFORM


def test_numbers_of_numpy_are_mapped_over_inside_jit():
    """JAX's custom rules do not accept NumPy arrays there."""
    q = np.random.default_rng(1).normal(size=(3, 2))

    @jax.jit
    def both(scale):
        M, J = (jax.vmap(lambda q, f=f: f(MODEL, q))(q) for f in (rb.mass_matrix, last))
        a = jax.vmap(lambda v: rb.forward_dynamics(MODEL, scale * v, v, v))(q)
        return M, J, a, jax.jvp(lambda q: last(MODEL, q), (q[0],), (q[1],))[1]

    def last(model, q):
        return rb.jacobian(model, q, "pole")

    M, J, a, _ = both(1.0)
    assert M.shape == (3, 2, 2) and J.shape == (3, 6, 2)
    assert relative_error(a[1], rb.forward_dynamics(MODEL, *(q[1],) * 3)) <= F64_TRANSFORM
