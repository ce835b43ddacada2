"""Kernels that compile while JAX lowers the rest of their program, with a stand-in for NVRTC."""

from __future__ import annotations

import re
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import ShapedArray

from rbjax.compiler.cuda import nvrtc
from rbjax.compiler.cuda.kernels import Kernel
from rbjax.compiler.jax import launch, primitive
from rbjax.compiler.jax.function import compile_threads

X = np.random.default_rng(0).normal(size=(50, 3))


@pytest.fixture
def gpu(monkeypatch):
    """A process that assumes that kernels work."""
    monkeypatch.setattr(launch, "capability", lambda: "9.0")
    monkeypatch.setattr(launch, "ordinal", lambda: 0)
    monkeypatch.setattr(launch, "kernels_work", lambda: True)
    primitive._warn.cache_clear()


def lowered(g, *args) -> str:
    return jax.jit(g).trace(*args).lower(lowering_platforms=("cuda",)).as_text()


def test_kernels_of_one_program_compile_at_the_same_time(gpu, monkeypatch):
    """Each of two kernels waits for the other, the second use of one for none."""
    meeting, made = threading.Barrier(2, timeout=60), []

    def code(source, capability):
        meeting.wait()
        made.append(source)
        return f"PTX {len(source)}"

    monkeypatch.setattr(launch, "ptx", code)
    one, other = (jax.vmap(compile_threads(h)) for h in (jnp.cosh, jnp.arctan))
    text = lowered(lambda x: one(x) + other(x) + one(2 * x), X)
    assert text.count(launch.GPU_KERNEL) == 3 and len(made) == 2
    assert {f"PTX {len(x)}" for x in made} == set(re.findall(r'"(PTX \d+)"', text))
    assert "rbjax kernel" not in text  # a placeholder


def test_one_of_two_kernels_is_rejected(gpu, monkeypatch):
    def code(source, capability):
        if "atan(" in source:
            raise nvrtc.CompileError("NVRTC does not compile a kernel: error C2143")
        return "PTX"

    monkeypatch.setattr(launch, "ptx", code)
    one, other = (jax.vmap(compile_threads(h)) for h in (jnp.sinh, lambda x: jnp.arctan(x) + 1))
    with pytest.warns(UserWarning, match=r"rejects .*error C2143.*runs under XLA"):
        text = lowered(lambda x: one(x) + other(x) + other(2 * x), X)
    assert text.count(launch.GPU_KERNEL) == 1 and '"PTX"' in text
    assert "rbjax kernel" not in text


def test_a_program_that_is_lowered_while_another_one_is(gpu, monkeypatch):
    """The first kernel of a process runs a self-test while JAX lowers its program."""
    inner = []

    def works():
        run = lambda x: launch.launch_kernel(test, [x], [ShapedArray(x.shape, x.dtype)])[0]  # noqa: E731
        if not inner:
            inner.append("")
            inner[0] = lowered(run, np.zeros(32, np.float32))
        return True

    test = Kernel(launch.SELF_TEST, "self_test", 32, 1, 1, (False,))
    monkeypatch.setattr(launch, "kernels_work", works)
    monkeypatch.setattr(launch, "ptx", lambda source, capability: f"PTX {len(source)}")
    outer = lowered(jax.vmap(compile_threads(lambda x: jnp.sinh(x) - 2)), X)
    for text in (outer, *inner):
        assert text.count('"PTX ') == 1 and "rbjax kernel" not in text
    assert f'"PTX {len(launch.SELF_TEST)}"' in inner[0]
