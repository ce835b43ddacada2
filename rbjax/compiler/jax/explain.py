"""`rb.compiler.explain`: a function as a GPU thread, and the limits of its speed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiler.cuda import device
from rbjax.compiler.cuda.kernels import kernel
from rbjax.compiler.cuda.nvrtc import ptx
from rbjax.compiler.ir.program import Written, batch_first
from rbjax.compiler.jax import backend
from rbjax.compiler.jax.function import flattened, threaded
from rbjax.compiler.jax.launch import capability, ordinal, works
from rbjax.compiler.lower.write import write_program
from rbjax.compiler.passes.counting import operations


@dataclass(frozen=True)
class Explanation:
    """A function of one sample as a thread.

    statements: arithmetic operations in the code; operations: those executed, with those of a loop
    once per iteration (of a `while` once); array_bytes: local arrays of the program; moved_bytes:
    reads and writes of one sample. On a GPU: registers and local_bytes of a thread (arrays and
    spilled registers), seconds of a batch, and the shares of the device's limits of instructions
    (one per operation) and of bandwidth. Without a GPU these are None.
    """

    statements: int
    operations: int
    array_bytes: int
    moved_bytes: int
    batch: int
    registers: int | None = None
    local_bytes: int | None = None
    shared_bytes: int | None = None
    seconds: float | None = None
    of_instructions: float | None = None
    of_bandwidth: float | None = None

    def __str__(self) -> str:
        lines = [
            f"{self.statements} statements, {self.operations} operations run",
            f"{self.array_bytes} bytes of local arrays, {self.moved_bytes} bytes read and written",
        ]
        if self.seconds is None:
            lines.append("no GPU: registers, memory and times are not known")
        else:
            rate = self.batch / self.seconds / 1e6
            lines += [
                f"{self.registers} registers, {self.local_bytes} bytes of local memory, "
                f"{self.shared_bytes} bytes of shared memory a block",
                f"{rate:.0f} million samples a second in a batch of {self.batch}: "
                f"{self.of_instructions:.0%} of the device's instructions, "
                f"{self.of_bandwidth:.0%} of its bandwidth",
            ]
        return "\n".join(lines)


def explain(f: Callable, *args: Any, batch: int = 65_536) -> Explanation:
    """f as a GPU thread: statements, registers, memory, and the shares of the device's limits.

    Args:
        f: a function of one sample, as for `threads`.
        args: one sample: arrays, or pytrees of arrays.
        batch: the number of samples to time, on a GPU.

    Returns:
        `Explanation`, which prints as a few lines.

    Raises:
        Unsupported: f has a primitive that threads do not support; the message names it.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> found = rb.compiler.explain(lambda x: jnp.tanh(x).sum(), jnp.ones(3))
        >>> found.statements
        5
    """
    leaves, flat, _ = flattened(f, args, {})
    closed = jax.make_jaxpr(flat)(*leaves)
    one = [jnp.asarray(x) for x in leaves]
    ins = [batch_first(x.shape, (batch,)) for x in one]
    outs = [batch_first(v.aval.shape, (batch,)) for v in closed.jaxpr.outvars]
    program = write_program(closed, (batch,), ins, outs)
    block = program.builder.block
    found = {
        "statements": program.statements,
        "operations": operations(block),
        "array_bytes": program.array_bytes,
        "moved_bytes": _moved(program),
        "batch": batch,
    }
    if not (backend.gpu() and works()):
        return Explanation(**found)
    code = kernel(program)
    used = device.resources(ptx(code.source, capability()), code.name, ordinal())
    many = [jnp.broadcast_to(x, (batch, *x.shape)) + jnp.zeros_like(x) for x in one]
    seconds = _seconds(jax.jit(jax.vmap(threaded(flat))), many)
    limits = device.limits(capability(), ordinal())
    return Explanation(
        **found, registers=used.registers, local_bytes=used.local_bytes,
        shared_bytes=used.shared_bytes, seconds=seconds,
        of_instructions=batch * found["operations"] / seconds / limits.instructions,
        of_bandwidth=batch * found["moved_bytes"] / seconds / limits.bandwidth,
    )  # fmt: skip


def _moved(program: Written) -> int:
    return sum(a.size * a.dtype.itemsize for a in (*program.operands, *program.results))


def _seconds(run: Callable, args: list[Any], calls: int = 10) -> float:
    """Seconds of one call, from several in a row; the median of seven."""
    jax.block_until_ready(run(*args))
    times = []
    for _ in range(7):
        start = time.perf_counter()
        for _ in range(calls):
            out = run(*args)
        jax.block_until_ready(out)
        times.append((time.perf_counter() - start) / calls)
    return statistics.median(times)
