"""Compiled loops of a training: chunks of iterations, on one device or several.

    x_0 = begin(...),    x_{k+1}, figures_k = turn(x_k)

A chunk is one program of `lax.scan`. Between chunks the training reports its progress, and may stop
at a limit of time. On several devices each has a part of the samples (`shard_map`).
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from rbjax.arguments import instance
from rbjax.compiler import fast_compile
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_several

AXIS = "samples"  # of the mesh of devices
SAME, EACH = PartitionSpec(), PartitionSpec(AXIS)

#: On a GPU, XLA autotunes matrix products for 5 s and optimises kernels for 3 s. That is longer
#: than a short training of a small policy.
UNMEASURED = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}
OPTIMISED_FROM = 2000


def devices_of(where: str, given: int | Sequence[Any] | None, batch: int) -> tuple[Any, ...]:
    """Return the devices of a training.

    Args:
        where: function, for the message.
        given: number of devices, the devices themselves, or None for one.
        batch: number of samples; each device has an equal part of them.

    Raises:
        InputError: more devices than there are, or a batch that they do not divide.
    """
    present = jax.devices()
    if given is None or isinstance(given, int):
        count = 1 if given is None else given
        if not 1 <= count <= len(present):
            raise InputError(
                f"{where}: devices is {given}, expected 1 to {len(present)}, the number of devices "
                f"of the {present[0].platform} platform"
            )
        found = tuple(present[:count])
    else:
        found = check_several(where, "devices", given, "devices of JAX, such as jax.devices()")
        for one in found:
            instance(where, "devices", one, jax.Device, "devices of JAX, such as jax.devices()")
    if not found or batch % len(found):
        raise InputError(
            f"{where}: a batch of {batch} on {len(found)} devices, expected a multiple of their "
            "number"
        )
    return found


def over_devices(devices: Sequence[Any]) -> tuple[Callable, Callable]:
    """Return the mean of a value over the devices, and the part of a key that each has."""
    if len(devices) == 1:
        return lambda x: x, lambda key: key
    return (
        lambda x: jax.lax.pmean(x, AXIS),
        lambda key: jax.random.fold_in(key, jax.lax.axis_index(AXIS)),
    )


def run_iterations(
    turn: Callable,
    begin: Callable,
    given: tuple,
    iterations: int,
    *,
    layout: Any,
    devices: Sequence[Any],
    chunks: int,
    report: Callable[[int, Any, dict[str, np.ndarray]], None],
    seconds: float | None = None,
) -> tuple[Any, dict[str, np.ndarray]]:
    """Run a training.

    Args:
        turn: (state, iteration) -> (state, figures), with figures a dict name -> number.
        begin: given -> state.
        given: arguments of `begin`.
        iterations: number of iterations.
        layout: a tree prefix of the state: `EACH` for arrays that are split over the devices by
            their first axis, `SAME` for arrays that all devices have.
        devices: where to run.
        chunks: largest number of programs one after the other, each with a report. They have equal
            lengths but for the last one, which may be shorter and is then compiled, too.
        report: function (iterations so far, state, figures of the chunk).
        seconds: limit of time; the training ends with the chunk that crosses it.

    Returns:
        The last state, and the figures of all iterations, each (iterations,).
    """
    started = time.perf_counter()
    quick = devices[0].platform == "gpu" and iterations < OPTIMISED_FROM
    jit: Any = functools.partial(jax.jit, compiler_options=UNMEASURED if quick else None)
    length = -(-iterations // chunks)
    mesh = Mesh(np.array(devices), (AXIS,))
    placed = jax.tree.map(lambda axes: NamedSharding(mesh, axes), layout)

    def several(state: Any, numbers: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        return jax.lax.scan(turn, state, numbers)

    if len(devices) > 1:
        shard = functools.partial(jax.shard_map, mesh=mesh, check_vma=False)
        begin = shard(begin, in_specs=SAME, out_specs=layout)
        several = shard(several, in_specs=(layout, SAME), out_specs=(layout, SAME))
    run = jit(several, in_shardings=(placed, NamedSharding(mesh, SAME)))
    with fast_compile(quick), ThreadPoolExecutor(1) as aside:
        first = jit(begin, out_shardings=placed).lower(*given)
        # XLA compiles `begin` while Python traces `several`
        compiled = aside.submit(first.compile)
        numbers = np.arange(length)
        program = run.lower(first.out_info, numbers).compile()
        state = compiled.result()(*given)
        rows: list[dict[str, np.ndarray]] = []
        done = 0
        while done < iterations:
            last = min(done + length, iterations)
            if last - done < len(numbers):
                program = run.lower(state, numbers[: last - done]).compile()
            numbers = np.arange(done, last)
            state, figures = program(state, numbers)
            rows.append(jax.tree.map(np.asarray, figures))
            done = last
            report(done, state, rows[-1])
            if seconds is not None and time.perf_counter() - started > seconds:
                break
    return state, {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
