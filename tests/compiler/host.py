"""Emitted programs compiled by the host's C++ compiler, and by LLVM, and run on numpy arrays.

Where JAX has a GPU beside the CPU (`make test-gpu`), they run as its kernels.
"""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.shared.part_function import part_function
from rbjax.compiler.cuda.c_source import PREAMBLE, Printer, offset, parameters, sample_index, table
from rbjax.compiler.ir.c_text import c_type
from rbjax.compiler.ir.program import Written, batch_first, batch_last
from rbjax.compiler.ir.statements import Loop, walk
from rbjax.compiler.ir.verify import verify
from rbjax.compiler.jax.function import compile_threads
from rbjax.compiler.jax.native import compile
from rbjax.compiler.llvm.batch import write_parts
from rbjax.compiler.lower.write import write_program

COMPILER = shutil.which("g++") or shutil.which("c++") or shutil.which("clang++")
FLAGS = ("-O1", "-ffp-contract=off")
Case = tuple[Callable, tuple]  # a function of one sample, and its arguments, batch first
GPU_ASKED = "cuda" in (jax.config.jax_platforms or "").split(",")


HOST_HEAD = """
#include <cmath>
#include <math.h>
#define QUALIFIED static inline
#define RSQRTf(x) (1.0f/sqrtf(x))
#define RSQRT(x) (1.0/sqrt(x))
typedef float c_float;
typedef double c_double;
using std::isfinite;
"""


def host_source(program: Written, name: str = "run") -> str:
    """A C++ function over the whole batch, for a host's compiler: name(pointers)."""
    ops, outs = program.layouts
    index = sample_index(program.batch)
    names, body = {}, []
    for k, (array, layout) in enumerate(zip(program.operands, ops, strict=True)):
        names[array.id] = f"x{k}"
        body.append(f"const {c_type(array.dtype)}* x{k}=p{k}+({offset(layout, index)});")
    after = []
    for k, (array, layout) in enumerate(zip(program.results, outs, strict=True)):
        names[array.id] = f"y{k}"
        if program.summed[k]:
            n = max(array.size, 1)
            body.append(f"{c_type(array.dtype)} y{k}[{n}];")
            after.append(f"for(int i=0;i<{array.size};i++)r{k}[i]+=y{k}[i];")
        else:
            body.append(f"{c_type(array.dtype)}* y{k}=r{k}+({offset(layout, index)});")
    lines = Printer(names).lines(program.builder.block)
    tables = [table(a, "static const") for a in program.builder.tables]
    clear = [
        f"for(int i=0;i<{a.size};i++)r{k}[i]=0;"
        for k, a in enumerate(program.results) if program.summed[k]
    ]  # fmt: skip
    head = f'extern "C" void {name}({parameters(program, "")}){{'
    loop = f"for(long long b=0;b<{math.prod(program.batch)}ll;b++){{"
    write_parts = [HOST_HEAD, PREAMBLE, *tables, head, *clear, loop, *body, *lines, *after, "}}"]
    return "\n".join(write_parts)


def library(source: str, flags: Sequence[str] = FLAGS) -> ctypes.CDLL:
    """The functions of a C++ source."""
    folder = Path(tempfile.mkdtemp())
    (folder / "f.cpp").write_text(source)
    command = [str(COMPILER), "-std=c++17", *flags, "-w", "-shared", "-fPIC", "-o"]
    subprocess.run([*command, str(folder / "f.so"), str(folder / "f.cpp")], check=True)
    out = ctypes.CDLL(str(folder / "f.so"))
    shutil.rmtree(folder)
    return out


def compiled(source: str, flags: Sequence[str] = FLAGS) -> Any:
    """The function `run` of a C++ source."""
    return library(source, flags).run


def written(
    f: Callable,
    *args: Any,
    layout: Callable = batch_first,
    platform: str = "cuda",
    team: bool = False,
) -> tuple[Written, Any, list]:
    """The program of f, the tree of its results, and their shapes and types."""
    leaves, tree = jax.tree.flatten(args)
    leaves = [np.asarray(x) for x in leaves]
    size = leaves[0].shape[0]
    one = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in leaves]
    shape: list = []

    def flat(*xs):
        out, treedef = jax.tree.flatten(f(*jax.tree.unflatten(tree, xs)))
        shape.append(treedef)
        return [jnp.asarray(x) for x in out]

    closed = jax.make_jaxpr(flat)(*one)
    ins = [layout(x.shape, (size,)) for x in one]
    outs = [layout(v.aval.shape, (size,)) for v in closed.jaxpr.outvars]
    program = write_program(closed, (size,), ins, outs, platform=platform, team=team)
    verify(program)
    return program, shape[0], closed.out_avals


def many_on_host(
    cases: Sequence[Case], flags: Sequence[str] = FLAGS, team: bool = False, backwards: bool = False
) -> list:
    """Each function's results for its batch, by the emitted C of all in one translation unit. team:
    of a team's programs, the turns of its loops one after the other, or backwards."""
    if GPU_ASKED:
        return [as_kernel(f, *args, team=team) for f, args in cases]
    programs = [written(f, *args, team=team) for f, args in cases]
    if backwards:
        for program, _, _ in programs:
            for s in walk(program.builder.block):
                if isinstance(s, Loop) and s.team:
                    s.reverse = True
    head = f"{HOST_HEAD}\n{PREAMBLE}"
    texts = [head]
    for k, (program, _, _) in enumerate(programs):
        body = host_source(program, f"run{k}").removeprefix(head)
        texts.append(f"namespace n{k} {{ {body} }}")
    found = library("\n".join(texts), flags)
    out = []
    for k, ((program, tree, avals), (_, args)) in enumerate(zip(programs, cases, strict=True)):
        leaves = [np.ascontiguousarray(x) for x in jax.tree.leaves(args)]
        # poisoned, so that an entry that is not written shows
        results = [np.full((*program.batch, *a.shape), 77, a.dtype) for a in avals]
        run = getattr(found, f"run{k}")
        run(*(ctypes.c_void_p(x.ctypes.data) for x in (*leaves, *results)))
        out.append(jax.tree.unflatten(tree, results))
    return out


def as_kernel(f: Callable, *args: Any, team: bool = False) -> Any:
    """f of each sample of a batch, batch first, by a kernel of the GPU."""
    placed = jax.device_put(args, jax.devices("cuda")[0])
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(compile_threads(f, team=team)))(*placed))


def by_xla(cases: Sequence[Case]) -> list:
    """The same by XLA on the CPU (on a GPU its products have ten bits, and of several writes to one
    place any may be the last), in one program that is compiled with little effort."""
    fs = [jax.vmap(f) for f, _ in cases]
    every = jax.jit(
        lambda *args: [f(*xs) for f, xs in zip(fs, args, strict=True)],
        compiler_options={"xla_backend_optimization_level": 0},
    )
    with jax.default_device(jax.devices("cpu")[0]):
        return jax.tree.map(np.asarray, every(*(args for _, args in cases)))


def by_llvm(cases: Sequence[Case]) -> list:
    """The same by `rb.compile`, sample by sample."""
    out = []
    for f, args in cases:
        samples = [jax.tree.map(lambda x, k=k: x[k], args) for k in range(size(args))]
        run = compile(f, *samples[0])
        assert run.native
        every = [run(*sample) for sample in samples]
        out.append(jax.tree.map(lambda *ys: np.stack(ys), *every))
    return out


def size(args: tuple) -> int:
    """The samples of a batch."""
    return jax.tree.leaves(args)[0].shape[0]


def on_host(f: Callable, *args: Any) -> Any:
    """f of each sample of a batch, batch first, by the emitted C."""
    return many_on_host([(f, args)])[0]


# ------------------------------------------------------------------- vectors


def by_vectors(cases: Sequence[Case], lanes: int = 4, samples: int = 5) -> list:
    """The same by vectors of samples. Few samples are repeated; the batch is first or last."""
    return [_by_vectors(f, args, lanes, samples, bool(k % 2)) for k, (f, args) in enumerate(cases)]


def _by_vectors(f: Callable, args: tuple, lanes: int, samples: int, last: bool) -> Any:
    many = max(samples, size(args))
    args = jax.tree.map(lambda x: np.resize(x, (many, *np.shape(x)[1:])), args)
    layout = batch_last if last else batch_first
    program, tree, avals = written(f, *args, layout=layout, platform="cpu")
    leaves = [np.asarray(x) for x in jax.tree.leaves(args)]
    if last:
        leaves = [np.moveaxis(x, 0, -1) for x in leaves]
    shapes = [layout.shape for layout in program.layouts[1]]
    # poisoned, so that an entry that is not written shows
    results = [np.full(s, 77, a.dtype) for s, a in zip(shapes, avals, strict=True)]
    run, _ = part_function(write_parts(program, lanes))
    run([*map(np.ascontiguousarray, leaves), *results])
    if last:
        results = [np.moveaxis(x, -1, 0) for x in results]
    return jax.tree.unflatten(tree, results)
