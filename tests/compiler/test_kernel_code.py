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
from rbjax.compiler.jax import kernel_code, launch
from rbjax.compiler.jax.function import compile_threads
from tests.compiler.lowering import lowered

X = np.random.default_rng(0).normal(size=(50, 3))


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
        if not inner:
            inner.append("")
            inner[0] = lowered(launched, np.zeros(32, np.float32))
        return True

    monkeypatch.setattr(launch, "kernels_work", works)
    monkeypatch.setattr(launch, "ptx", lambda source, capability: f"PTX {len(source)}")
    outer = lowered(jax.vmap(compile_threads(lambda x: jnp.sinh(x) - 2)), X)
    for text in (outer, *inner):
        assert text.count('"PTX ') == 1 and "rbjax kernel" not in text
    assert f'"PTX {len(SELF_TEST)}"' in inner[0]


SELF_TEST = launch.SELF_TEST + "// of a test"


def launched(x):
    """Launch a kernel while the function is traced, as a self-test does."""
    test = Kernel(SELF_TEST, "self_test", 32, 1, 1, (False,))
    return launch.launch_kernel(test, [x], [ShapedArray(x.shape, x.dtype)])[0]


def test_a_kernel_of_a_trace_that_is_rejected_is_an_error(gpu, monkeypatch):
    """Another lowering would have the same kernel again. The next program tries again."""
    tried = []

    def code(source, capability):
        tried.append(source)
        if len(tried) == 1:
            raise nvrtc.CompileError("found no libnvrtc")
        return "PTX"

    monkeypatch.setattr(launch, "ptx", code)
    x = np.zeros(32, np.float32)
    with pytest.raises(nvrtc.CompileError, match="found no libnvrtc"):
        lowered(launched, x)
    assert len(tried) == 1
    assert '"PTX"' in lowered(lambda x: launched(x) + 1, x)


def test_a_rejected_kernel_is_tried_again_by_the_next_program(gpu, monkeypatch):
    answers = iter(["found no libnvrtc", None])

    def code(source, capability):
        message = next(answers)
        if message:
            raise nvrtc.CompileError(message)
        return "PTX"

    monkeypatch.setattr(launch, "ptx", code)
    g = jax.vmap(compile_threads(lambda x: jnp.arcsinh(x) + 3))
    with pytest.warns(UserWarning, match="found no libnvrtc"):
        assert launch.GPU_KERNEL not in lowered(g, X)
    assert '"PTX"' in lowered(lambda x: g(x) + 1, X)


def test_without_the_end_of_a_lowering_kernels_compile_at_once(gpu, monkeypatch):
    """A JAX whose function is not there."""
    monkeypatch.setattr(kernel_code, "LOWERING_IS_WRAPPED", False)

    def rejects(source, capability):
        raise nvrtc.CompileError("error C2143")

    monkeypatch.setattr(launch, "ptx", rejects)
    with pytest.warns(UserWarning, match="C2143"):
        assert launch.GPU_KERNEL not in lowered(jax.vmap(compile_threads(jnp.arccosh)), X)


def test_a_fast_kernel_is_not_the_one_for_speed(gpu, monkeypatch):
    monkeypatch.setattr(launch, "ptx", lambda *_: f"PTX fast={nvrtc.compiles_fast()}")
    one, other = (jax.vmap(compile_threads(jnp.expm1)) for _ in range(2))
    with nvrtc.fast_compile():
        fast = lowered(one, X)
    assert '"PTX fast=True"' in fast and '"PTX fast=False"' in lowered(lambda x: other(x) + 0, X)
