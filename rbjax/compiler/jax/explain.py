"""`rb.compiler.explain`: the program of a function, and the limits of its speed."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from rbjax.compiler.cuda import driver
from rbjax.compiler.cuda.kernels import kernel
from rbjax.compiler.cuda.nvrtc import ptx
from rbjax.compiler.ir.program import batch_first
from rbjax.compiler.jax import launch
from rbjax.compiler.jax.function import compile_threads, flatten_call
from rbjax.compiler.lower.write import write_program
from rbjax.compiler.passes.analysis import count_operations


@dataclass(frozen=True)
class Explanation:
    """The program of a function of one sample, and the limits of its speed.

    Values from `registers` on are None without a GPU.

    statements: arithmetic operations in the code.
    operations: executed operations: all iterations of a loop, one of a `while` loop.
    array_bytes: bytes of the program's local arrays.
    moved_bytes: bytes of the operands and results of one sample.
    batch: number of samples in the timed batch.
    registers: registers per thread.
    local_bytes: bytes of a thread's local memory (arrays and spilled registers).
    shared_bytes: bytes of shared memory per block.
    seconds: time of a batch.
    of_instructions: fraction of the device's peak instruction rate (one instruction per operation).
    of_bandwidth: fraction of the device's peak memory bandwidth.
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


def explain(f: Callable, *args: object, batch: int = 65_536) -> Explanation:
    """Compile f as a GPU thread, and report its statements, registers, memory and speed.

    Args:
        f: function of one sample, as for `threads`.
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
    leaves, flat, _ = flatten_call(f, args, {})
    closed = jax.make_jaxpr(flat)(*leaves)
    ins = [batch_first(x.shape, (batch,)) for x in leaves]
    outs = [batch_first(a.shape, (batch,)) for a in closed.out_avals]
    program = write_program(closed, (batch,), ins, outs)
    arrays = (*program.operands, *program.results)
    found = Explanation(
        program.statements, count_operations(program.builder.block), program.array_bytes,
        sum(a.size * a.dtype.itemsize for a in arrays), batch,
    )  # fmt: skip
    if not (launch.has_gpu() and launch.kernels_work()):
        return found
    code = kernel(program, multiprocessor_bytes=launch.multiprocessor_bytes)
    capability, ordinal = launch.capability(), launch.ordinal()
    used = driver.resources(ptx(code.source, capability), code.name, ordinal)
    limits = driver.limits(capability, ordinal)
    many = [jnp.broadcast_to(x, (batch, *x.shape)) + jnp.zeros_like(x) for x in leaves]
    seconds = _seconds(jax.jit(jax.vmap(compile_threads(flat))), many)
    return dataclasses.replace(
        found, registers=used.registers, local_bytes=used.local_bytes,
        shared_bytes=used.shared_bytes + code.shared_bytes, seconds=seconds,
        of_instructions=batch * found.operations / seconds / limits.instructions,
        of_bandwidth=batch * found.moved_bytes / seconds / limits.bandwidth,
    )  # fmt: skip


def _seconds(run: Callable, args: list[jax.Array]) -> float:
    """Return the seconds of one call: the median over seven series of ten calls."""
    jax.block_until_ready(run(*args))
    times = []
    for _ in range(7):
        start = time.perf_counter()
        for _ in range(10):
            out = run(*args)
        jax.block_until_ready(out)
        times.append((time.perf_counter() - start) / 10)
    return statistics.median(times)
