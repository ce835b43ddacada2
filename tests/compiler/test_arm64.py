"""Machine code for 64-bit ARM: programs in vectors of 2 doubles and one by one, run by an emulator.

Debian: apt install qemu-user gcc-aarch64-linux-gnu libc6-dev-arm64-cross.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import rbjax as rb
from rbjax.compiler.llvm import jit as llvm_jit
from rbjax.compiler.llvm.batch import BatchParts, write_parts
from rbjax.compiler.llvm.xla_handler import write_handler
from tests.compiler import random_programs
from tests.compiler.host import Case, by_xla, size, written

COMPILER, EMULATOR = shutil.which("aarch64-linux-gnu-gcc"), shutil.which("qemu-aarch64")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        COMPILER is None or EMULATOR is None,
        reason="needs aarch64-linux-gnu-gcc and qemu-aarch64",
    ),
]

#: reads the operands, runs all parts and writes the results
MAIN = """
#include <stdio.h>
#include <stdlib.h>
int part(void **, long);
int main(void) {{
  static const long sizes[] = {{{sizes}}};
  void *buffers[{count}];
  for (int k = 0; k < {count}; k++) {{
    buffers[k] = aligned_alloc(64, (sizes[k] + 127) / 64 * 64);
    if (k < {given} && fread(buffers[k], 1, sizes[k], stdin) != (size_t)sizes[k]) return 2;
  }}
  for (long k = 0; k < {parts}; k++) if (part(buffers, k)) return 3;
  for (int k = {given}; k < {count}; k++) fwrite(buffers[k], 1, sizes[k], stdout);
  return 0;
}}
"""


def machine(triple: str = "aarch64-unknown-linux-gnu", cpu: str = "generic") -> Any:
    llvm = llvm_jit._llvm()
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple)
    return target.create_target_machine(cpu=cpu, opt=llvm_jit.LEVELS.selection, reloc="pic")


def code_of(text: str, machine: Any) -> bytes:
    """The object file of IR, by the passes of `llvm_jit`."""
    return llvm_jit.compile_object(text, llvm_jit.LEVELS.passes, machine)


def emulated(
    made: BatchParts, arrays: list[np.ndarray], results: list[np.ndarray], at: Path
) -> None:
    """Fills the results."""
    (at / "part.o").write_bytes(code_of(made.text, machine()))
    every = [*arrays, *results]
    main = MAIN.format(sizes=", ".join(str(x.nbytes) for x in every), count=len(every),
                       given=len(arrays), parts=made.count)  # fmt: skip
    (at / "main.c").write_text(main)
    names = [str(at / name) for name in ("main.c", "part.o", "run")]
    subprocess.run([str(COMPILER), "-static", *names[:2], "-o", names[2], "-lm"], check=True)
    done = subprocess.run([str(EMULATOR), names[2]], check=True, stdout=subprocess.PIPE,
                          input=b"".join(x.tobytes() for x in arrays))  # fmt: skip
    start = 0
    for x in results:
        x[...] = np.frombuffer(done.stdout, x.dtype, x.size, start).reshape(x.shape)
        start += x.nbytes
    assert start == len(done.stdout)


def compare(cases: list[Case], lanes: int, at: Path, tolerance: float) -> None:
    for (f, args), want in zip(cases, by_xla(cases), strict=True):
        program, tree, avals = written(f, *args, platform="cpu")
        results = [np.full((size(args), *a.shape), 77, a.dtype) for a in avals]
        arrays = [np.ascontiguousarray(x) for x in jax.tree.leaves(args)]
        emulated(write_parts(program, lanes), arrays, results, at)
        for a, b in zip(results, jax.tree.leaves(want), strict=True):
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
        assert jax.tree.structure(want) == tree


def drawn(*shape: int, dtype: Any = np.float64, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, shape).astype(dtype)


def mathematics(x: jax.Array) -> list[jax.Array]:
    y, f = jnp.abs(x) + 0.5, jnp
    return [f.sin(x), f.cos(x), f.tan(x), f.exp(x), f.log(y), f.arctan(x), f.arctan2(x, y), y**x,
            f.tanh(x), f.cbrt(x), jax.scipy.special.erf(x), jax.scipy.special.gammaln(y),
            f.sqrt(y), f.floor(x), f.sin(1e7 * x)]  # fmt: skip


def control(x: jax.Array) -> list[jax.Array]:
    """Loops whose turns differ between samples, branches, a product, integers."""
    turns = lax.while_loop(lambda s: s[0] < 3.0, lambda s: (1.1 * s[0] + 0.1, s[1] + 1),
                           (jnp.abs(x[0]), 0))[1]  # fmt: skip
    chosen = lax.cond(x[1] > 0, lambda: x * 2, lambda: -x)
    square = jnp.outer(x, x) @ jnp.outer(x, jnp.arange(14.0))
    return [turns, chosen, square.sum(0), jnp.argsort(x), lax.dynamic_slice(x, (turns,), (3,))]


@pytest.mark.parametrize("lanes", [1, 2])
def test_mathematics_and_control(lanes, tmp_path):
    both: list[Case] = [(mathematics, (drawn(5, 3),)), (control, (drawn(5, 14),))]
    compare(both, lanes, tmp_path, 1e-13)


def test_single_precision(tmp_path):
    compare([(mathematics, (drawn(7, 3, dtype=np.float32),))], 4, tmp_path, 2e-6)


ALGORITHMS = rb.forward_dynamics, rb.mass_matrix, rb.forward_dynamics_derivatives


@pytest.mark.parametrize("f", ALGORITHMS, ids=lambda f: f.__name__)
def test_algorithms(f: Callable, tmp_path):
    model = rb.load("arm7")
    given = (drawn(5, 7), drawn(5, 7, seed=1), drawn(5, 7, seed=2))
    given = given[:1] if f is rb.mass_matrix else given
    compare([(lambda *x: f(model, *x), given)], 2, tmp_path, 1e-11)


def test_random_programs(tmp_path):
    cases = [(random_programs.program(s), random_programs.arguments(s, 5)) for s in range(8)]
    compare(cases, 2, tmp_path, 1e-8)


@pytest.mark.parametrize("triple, cpu", [
    ("aarch64-unknown-linux-gnu", "neoverse-n1"), ("arm64-apple-macosx14.0.0", "apple-m1")
])  # fmt: skip
def test_what_xla_calls_has_an_object_file(triple, cpu):
    """The handler with its atomic operations; it is not run."""
    program, _, _ = written(lambda x: jnp.sin(x) + 1, drawn(4096, 3), platform="cpu")
    module, _ = write_handler(program)
    code = code_of(module.text, machine(triple, cpu))
    assert b"run" in code and len(code) > 1000
