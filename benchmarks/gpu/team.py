"""The backward pass of DDP on a GPU: a team of threads a problem against one thread a problem.

`python -m benchmarks.gpu.team` writes results/gpu-team-<device>.json. Random linear-quadratic
problems in f32: 12 states and 6 bounded controls, 14 states and 7 controls without bounds; both
with dq+ = dq + h dv+. A row has the time of one form, and the largest difference from the same in
f64 under XLA on the CPU, relative to the largest entry, of V and of K. With `--teams` each batch is
timed with teams of 32, 64 and 128 threads, and registers for several numbers of blocks.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.shared.gpu_timing import timed
from benchmarks.shared.timing import markdown_table, save
from rbjax.compiler import threads
from rbjax.compiler.cuda import driver, team
from rbjax.compiler.cuda.nvrtc import ptx
from rbjax.compiler.jax import primitive
from rbjax.compiler.jax.launch import capability, ordinal
from rbjax.control.optimal.shooting.backward_pass import Bounds, backward_pass
from rbjax.control.optimal.shooting.expansion import Quadratic

COLUMNS = (
    "what", "size", "horizon", "batch", "lower_s", "compile_s", "run_s", "of V", "of K", "note",
)  # fmt: skip
SIZES = {"12/6 bounded": (12, 6, True), "14/7": (14, 7, False)}


def problem(n: int, m: int, bounded: bool, N: int, batch: int) -> tuple:
    """Arguments of the backward pass; a few problems are repeated."""
    few, r = 64, np.random.default_rng(n)
    f = lambda *s: r.normal(size=(few, *s))  # noqa: E731

    def definite(*shape: int) -> np.ndarray:
        x = f(*shape)
        return x @ x.swapaxes(-1, -2) / shape[-1] + np.eye(shape[-1])

    k, h = n // 2, 0.01
    moves = np.concatenate([np.zeros((k, k)), np.eye(k)], 1) + h * f(N, k, n)
    stays = np.concatenate([np.eye(k), np.zeros((k, k))], 1)
    E = 0.1 * f(N, k, m)
    low = -np.abs(f(N, m)) - 0.05
    args = (
        np.concatenate([stays + h * moves, moves], 2), np.concatenate([h * E, E], 2),
        0.1 * f(N + 1, n),
        Quadratic(f(N), f(N, n), definite(N, n, n), f(N, m), definite(N, m, m), 0.1 * f(N, n, m)),
        Quadratic(f(), f(n), definite(n, n), f(m), definite(m, m), f(n, m)),
        Bounds(low, low + 1.2) if bounded else None, None, np.full(few, 1e-6), np.full(few, h),
    )  # fmt: skip
    return jax.tree.map(lambda x: np.resize(x, (batch, *x.shape[1:])).astype(np.float32), args)


def exact(args: tuple) -> Any:
    """V and K of the first problems in f64, on the CPU."""
    few = jax.tree.map(lambda x: np.resize(x, (8, *x.shape[1:])).astype(np.float64), args)
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        found = under_xla(*few)
        return np.asarray(found.V), np.asarray(found.K)


under_xla = jax.jit(jax.vmap(backward_pass))


def difference(got: Any, want: np.ndarray) -> float:
    few = np.asarray(got)[: len(want)]
    return float(np.abs(few - want[: len(few)]).max() / np.abs(want).max())


def row_of(what: str, size: str, N: int, batch: int, by_team: bool, args: tuple, want: Any) -> dict:
    """Times of one form, and its differences."""
    run = jax.vmap(threads(backward_pass, team=by_team))
    about: dict[str, Any] = {"what": what, "size": size, "horizon": N, "batch": batch}
    try:
        found = jax.jit(run)(*args)
        about |= {"of V": difference(found.V, want[0]), "of K": difference(found.K, want[1])}
    except Exception as error:  # the other rows go on
        about |= {"note": f"{type(error).__name__}: {str(error)[:300]}"}
        print(json.dumps(about), flush=True)
        return about
    return timed(about, run, *args, work=batch, budget_s=0.2)


def used(args: tuple) -> str:
    """Registers and memory of the last kernel of a team."""
    codes: list = []
    build = team.kernel

    def seen(*a: Any, **k: Any) -> Any:
        codes.append(build(*a, **k))
        return codes[-1]

    team.kernel = seen
    primitive._kernel.cache_clear()
    try:
        jax.jit(jax.vmap(threads(backward_pass, team=True))).lower(*args)
        code = codes[-1]
        found = driver.resources(ptx(code.source, capability()), code.name, ordinal())
        return (
            f"{code.block} threads, {found.registers} registers, {found.local_bytes} local bytes, "
            f"{found.shared_bytes} shared"
        )
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    finally:
        team.kernel = build
        primitive._kernel.cache_clear()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--horizons", nargs="*", type=int, default=[16, 64])
    parser.add_argument("--batches", nargs="*", type=int, default=[1, 64, 512, 4096])
    parser.add_argument("--sizes", nargs="*", default=list(SIZES))
    parser.add_argument("--seconds", type=float, default=130.0)
    parser.add_argument("--teams", action="store_true")
    args = parser.parse_args()
    rows: list[dict] = []
    start = time.perf_counter()
    put = functools.partial(jax.tree.map, lambda x: jax.device_put(jnp.asarray(x)))
    # what was asked comes first
    cases = [(s, N, b) for b in reversed(args.batches) for N in args.horizons for s in args.sizes]
    cases.sort(key=lambda c: (c[1:] not in ((16, 4096), (64, 1)), -c[2]))
    for size, N, batch in cases:
        if time.perf_counter() - start > args.seconds:
            print(f"left out: {size}, {N} knots, batch {batch}", flush=True)
            continue
        given = problem(*SIZES[size], N, batch)
        want, given = exact(given), put(given)
        print(used(given), flush=True)
        rows.append(row_of("team", size, N, batch, True, given, want))
        if args.teams:
            for team_size, resident in ((32, 12), (32, 20), (32, 27), (64, 8), (64, 13), (128, 4)):
                before = team.team_size, team.RESIDENT, team.RESIDENT_LARGE
                team.team_size = lambda samples, n=team_size: n
                team.RESIDENT = team.RESIDENT_LARGE = resident
                primitive._kernel.cache_clear()
                what = f"team of {team_size}, {resident} blocks"
                rows.append(row_of(what, size, N, batch, True, given, want))
                team.team_size, team.RESIDENT, team.RESIDENT_LARGE = before
                primitive._kernel.cache_clear()
        rows.append(row_of("a thread", size, N, batch, False, given, want))
        print(f"{time.perf_counter() - start:.0f} s", flush=True)
    save("gpu-team", rows)
    print(markdown_table(rows, COLUMNS))


if __name__ == "__main__":
    main()
