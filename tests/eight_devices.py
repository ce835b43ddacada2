"""Tests on eight simulated devices: functions that a child process runs, and their checks."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from tests.robots import QUICK
from tests.tolerances import F64_TRANSFORM, relative_error

MOVES = re.compile(r" (all-gather|all-to-all|collective-permute|all-reduce|reduce-scatter)\S*\(")


def on_eight_devices(f: Callable[[], None]) -> None:
    """f() in a process that has eight devices."""
    setup = "import jax; jax.config.update('jax_enable_x64', True)"
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    child = subprocess.run(
        [sys.executable, "-c", f"{setup}; from {f.__module__} import {f.__name__} as f; f()"],
        capture_output=True, text=True, cwd=Path(__file__).parents[1],
        env={**os.environ, "XLA_FLAGS": flags.strip(), "JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    assert child.returncode == 0, child.stderr


def mesh() -> Mesh:
    """Eight devices on two axes."""
    return Mesh(np.array(jax.devices()).reshape(4, 2), ("a", "b"))


def check(
    what: str, f: Callable, args: tuple, want: Callable | None = None, sharding: Any = None,
    sums: int | None = None, spread: int | None = None, mesh: Mesh | None = None,
) -> None:  # fmt: skip
    """f(args) = want(args on one device), without all-gather.

    want: f itself if None. sharding: of the first `spread` arrays of the result, or of all. sums:
    how often something is summed over devices, outside of any loop. mesh: set while f runs.
    """
    with jax.set_mesh(mesh) if mesh else nullcontext():
        compiled = jax.jit(f, compiler_options=QUICK).lower(*args).compile()
        text, got = compiled.as_text(), compiled(*args)
    expected = jax.jit(want or f, compiler_options=QUICK)(*jax.tree.map(np.asarray, args))  # on one
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert relative_error(a, b) <= F64_TRANSFORM, what
    found = [m[1] for m in MOVES.finditer(text)]
    assert set(found) <= {"all-reduce"}, (what, found)
    if sums is not None:
        at_the_end = MOVES.findall(text[text.index("\nENTRY") :])
        assert len(found) == len(at_the_end) == sums, (what, found, at_the_end)
    if sharding is not None:
        for x in filter(np.size, jax.tree.leaves(got)[:spread]):  # an empty one has no shards
            assert x.sharding.is_equivalent_to(sharding, x.ndim), (what, x.sharding)
