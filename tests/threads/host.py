"""Emitted programs compiled by the host's C++ compiler and run on numpy arrays."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.threads.frame import batch_first, host_source, write_program

COMPILER = shutil.which("g++") or shutil.which("c++") or shutil.which("clang++")


def compiled(source: str, flags: tuple[str, ...] = ("-O1", "-ffp-contract=off")) -> Any:
    """The function `run` of a C++ source."""
    folder = Path(tempfile.mkdtemp())
    (folder / "f.cpp").write_text(source)
    command = [COMPILER, "-std=c++17", *flags, "-w", "-shared", "-fPIC", "-o"]
    subprocess.run([*command, folder / "f.so", folder / "f.cpp"], check=True)
    run = ctypes.CDLL(str(folder / "f.so")).run
    shutil.rmtree(folder)
    return run


def on_host(f: Callable, *args: Any) -> Any:
    """f of each sample of a batch, batch first, by the emitted C."""
    leaves, tree = jax.tree.flatten(args)
    leaves = [np.ascontiguousarray(x) for x in leaves]
    size = leaves[0].shape[0]
    one = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in leaves]
    shape: list = []

    def flat(*xs):
        out, treedef = jax.tree.flatten(f(*jax.tree.unflatten(tree, xs)))
        shape.append(treedef)
        return [jnp.asarray(x) for x in out]

    closed = jax.make_jaxpr(flat)(*one)
    ins = [batch_first(x.shape, (size,)) for x in one]
    outs = [batch_first(v.aval.shape, (size,)) for v in closed.jaxpr.outvars]
    program = write_program(closed, (size,), ins, outs)
    run = compiled(host_source(program))
    # poisoned, so that an entry that is not written shows
    results = [
        np.full((size, *v.aval.shape), 77, v.aval.dtype) for v in closed.jaxpr.outvars
    ]
    run(*(ctypes.c_void_p(x.ctypes.data) for x in (*leaves, *results)))
    return jax.tree.unflatten(shape[0], results)
