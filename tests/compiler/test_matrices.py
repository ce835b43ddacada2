"""Products of matrices that fill a CPU's vectors, in programs of one sample, against numpy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.compiler.jax import launch
from rbjax.compiler.jax.function import compile_threads
from rbjax.control.products import in_registers
from tests.tolerances import F64_TRANSFORM, relative_error

RNG = np.random.default_rng(0)
A, B, C = (RNG.normal(size=shape) for shape in ((12, 9), (9, 13), (13, 12)))
MANY = RNG.normal(size=(5, 4, 6)), RNG.normal(size=(5, 6, 7))

PRODUCTS = {
    "rows": (lambda a, b, c: a @ b, A @ B),
    "columns": (lambda a, b, c: c.T @ b.T, C.T @ B.T),
    "a part of a row": (lambda a, b, c: a @ b[:, :-1], A @ B[:, :-1]),
    "every second column": (lambda a, b, c: a @ b[:, ::2], A @ B[:, ::2]),
    "from the last row on": (lambda a, b, c: a @ b[::-1], A @ B[::-1]),
    "three": (lambda a, b, c: jnp.tanh(a @ b) @ c, np.tanh(A @ B) @ C),
    "with itself": (lambda a, b, c: a @ a.T, A @ A.T),
    "vectors": (lambda a, b, c: a @ (b @ c[:, 0]), A @ (B @ C[:, 0])),
    "values": (lambda a, b, c: in_registers(a) @ in_registers(b), A @ B),
    "two axes": (lambda a, b, c: jnp.einsum("ij,kj->ki", a, c[:, :9]), C[:, :9] @ A.T),
}


@pytest.fixture(autouse=True)
def _by_machine_code(monkeypatch):
    monkeypatch.setattr(launch, "uses_llvm", lambda: True)


@functools.cache
def found():
    """All of them by one program."""
    products = lambda *x: {name: f(*x) for name, (f, _) in PRODUCTS.items()}  # noqa: E731
    every = compile_threads(products, team=True)
    return jax.jit(every)(A, B, C)


@pytest.mark.parametrize("name", PRODUCTS)
def test_products(name):
    assert relative_error(found()[name], PRODUCTS[name][1]) < F64_TRANSFORM


def test_a_batch_within_a_sample():
    """Both matrices have an axis in common; the second one's columns lie apart."""
    x, y = MANY
    f = compile_threads(lambda x, y: jnp.einsum("nij,nkj->nik", x, y), team=True)
    far = np.ascontiguousarray(y.swapaxes(1, 2))
    assert relative_error(jax.jit(f)(x, far), x @ y) < F64_TRANSFORM


def test_samples_of_a_batch():
    f = jax.jit(jax.vmap(compile_threads(lambda a, b: a @ b.T, team=True)))
    x, y = RNG.normal(size=(19, 8, 6)), RNG.normal(size=(19, 9, 6))
    assert relative_error(f(x, y), x @ y.swapaxes(1, 2)) < F64_TRANSFORM
