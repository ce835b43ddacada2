"""`threads.explain`: numbers that can be counted by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.compiler.ir.statements import Unsupported
from tests.compiler.host import GPU_ASKED

X = np.ones(3, np.float32)
explain = rb.compiler.explain


def test_statements_are_counted_once_and_operations_as_they_run():
    def f(x):
        return jax.lax.fori_loop(0, 10, lambda _, s: s * x[0] + x[1], x[2])

    alone = explain(lambda x: x[2] * x[0] + x[1], X)
    looped = explain(f, X)
    assert alone.statements == alone.operations == 2
    assert looped.statements < 10
    assert looped.operations - looped.statements == 9 * alone.operations


def test_a_scan_s_operations_grow_with_its_length():
    def steps(count):
        def f(x):
            return jax.lax.scan(lambda s, _: (jnp.sin(s) * s, None), x, None, length=count)[0]

        return explain(f, X)

    few, many = steps(10), steps(30)
    assert few.statements == many.statements
    assert many.operations - few.operations == 20 * 2 * 3


def test_the_longer_branch_counts():
    def f(x):
        return jax.lax.cond(x[0] > 0, lambda x: jnp.sin(x[1]), lambda x: x[1] * x[2] + x[0], x)

    found = explain(f, X)
    assert found.statements - found.operations == 1


def test_bytes_of_a_sample():
    assert explain(lambda x: (2 * x, x.sum()), X).moved_bytes == 4 * (3 + 3 + 1)
    assert explain(lambda x: (2 * x, x.sum()), X.astype(float)).moved_bytes == 8 * (3 + 3 + 1)
    assert explain(lambda x: 2 * x, X).array_bytes == 0
    i = jnp.array([1, 2])
    held = explain(lambda x, i: jnp.zeros(20).at[i].set(x[0]).at[i[0]].add(1).sum(), X, i)
    assert held.array_bytes >= 20 * 8


def test_trees_of_arguments():
    found = explain(lambda tree: {"sum": tree["a"] + tree["b"][0]}, {"a": X, "b": [X]})
    assert found.statements == 3 and found.moved_bytes == 4 * 9


def test_it_prints():
    text = str(explain(lambda x: jnp.tanh(x).sum(), X, batch=1000))
    assert text.splitlines()[0] == "5 statements, 5 operations run"
    assert "16 bytes read and written" in text and ("no GPU" in text or GPU_ASKED)
    found = rb.compiler.explain(lambda x: x, X)
    measured = type(found)(
        5, 7, 0, 16, 1000, registers=40, local_bytes=8, shared_bytes=512, seconds=1e-5,
        of_instructions=0.25, of_bandwidth=0.5,
    )  # fmt: skip
    for words in (
        "7 operations",
        "40 registers, 8 bytes",
        "512 bytes",
        "100 million",
        "25%",
        "50%",
    ):
        assert words in str(measured)


def test_what_no_thread_knows_is_named():
    with pytest.raises(Unsupported, match="igamma"):
        explain(lambda x: jax.scipy.special.gammainc(x, x), X)


def test_a_robot():
    model = rb.load("cart_pole")
    q = jnp.zeros(2)
    found = explain(lambda q, v, a: rb.forward_dynamics(model, q, v, a), q, q, q)
    assert 10 < found.statements == found.operations < 300
    assert found.array_bytes == 0 and found.moved_bytes == 8 * 8


def test_zeros_of_a_nested_jacobian_vanish():
    """A batch of a program inside a program keeps entries that are zero in all samples."""

    def times_jacobian(f):
        def run(x, M):
            return (M[:, :, None] * jax.jacfwd(f)(x)).sum(1)

        return explain(run, X, np.ones((2, 3), np.float32))

    def f(x):
        return 3 * x + 1

    assert times_jacobian(rb.threads(f)).operations == times_jacobian(f).operations
