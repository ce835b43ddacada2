"""Speed against accuracy: error of a motion by computing time and by force evaluations.

`python -m benchmarks.work_precision --scenes arm7 --parts ours mjx mujoco solvers` writes
results/work-precision-<scene>-<device>.json; `benchmarks.work_precision_chart` draws all of them.

Rows: "point", one method at one number of steps, with error and microseconds per robot and
simulated second; "error", steps and error alone; "step", microseconds per robot and step at a
batch. MJX's time for an error is its steps for that error times its fastest step, whatever the
batch; errors are taken on the CPU, where a small sample costs less (they are the algorithm's, the
same on a GPU). Compilation is not counted.
"""

from __future__ import annotations

import argparse
import functools
import os
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout as native

import rbjax as rb
from benchmarks.gpu_timing import alone
from benchmarks.timing import save
from benchmarks.work_scenes import (
    SAMPLE,
    SCENES,
    distance,
    prepared,
    reference,
    reference_by_cpu,
)
from rbjax.integrators import INTEGRATORS, TABLEAUS
from rbjax.validation.mjx import UNFUSED, mjx

CHUNK = 4  # steps in one compiled rollout, or
STIFF_CHUNK = 64
PRECISIONS = ("f64", "f32")
STAGES = {name: TABLEAUS[name].stages if name in TABLEAUS else 1 for name in INTEGRATORS}
FINEST = 2e-12
ON_GPU = jax.default_backend() == "gpu"


class Bench:
    """One scene: its sample, where it ends, and the rows found."""

    def __init__(self, name: str, deadline: float, precisions: tuple[str, ...] = PRECISIONS):
        self.name, self.scene, self.deadline = name, SCENES[name], deadline
        self.precisions = precisions
        with jax.enable_x64(True):
            self.m, self.model, self.q, self.v, self.ctrl = prepared(name)
            *self.end, self.bound = (reference_by_cpu if ON_GPU else reference)(name)
        self.rows: list[dict[str, Any]] = [
            {"what": "reference", "scene": name, "bound": self.bound, "seconds": self.scene.seconds}
        ]

    def error(self, q: Any, v: Any) -> float:
        last = np.asarray(q[:SAMPLE]), np.asarray(v[:SAMPLE])
        return distance(self.model, last, self.end)

    def tiled(self, batch: int) -> tuple[jax.Array, jax.Array]:
        """The starts, again and again, in the current precision."""
        times = -(-batch // SAMPLE)
        return tuple(jnp.tile(jnp.asarray(x, float), (times, 1))[:batch] for x in (self.q, self.v))

    def add(self, what: str, engine: str, method: str, precision: str, **row: Any) -> None:
        row = {"what": what, "scene": self.name, "engine": engine, "method": method,
               "precision": precision} | row  # fmt: skip
        self.rows.append(row)
        if "steps" not in row:
            self.say(row)

    def say(self, row: dict[str, Any]) -> None:
        short = {k: f"{x:.3g}" if isinstance(x, float) else x for k, x in row.items()}
        print(*short.values(), flush=True)

    def guarded(self, engine: str, method: str, precision: str, work: Callable) -> None:
        """A benchmark goes on where one method fails, and says so."""
        if time.monotonic() > self.deadline:
            self.add("left out", engine, method, precision, note="out of time")
            return
        try:
            with jax.enable_x64(precision == "f64"):
                work()
        except Exception as error:
            traceback.print_exc()
            note = f"{type(error).__name__}: {str(error)[:200]}"
            self.add("failed", engine, method, precision, note=note)

    def ladder(
        self, engine: str, method: str, precision: str, run: Callable[[int], Any],
        stages: float, batch: int, first: int, most_s: float, what: str = "point",
    ) -> None:  # fmt: skip
        """Points at growing numbers of steps, until the error is at its floor or time is up."""
        errors: list[float] = []
        begin = time.perf_counter()
        jax.block_until_ready(run(first))
        compile_s = time.perf_counter() - begin
        for steps in _growing(first):
            if time.monotonic() > self.deadline:
                break
            seconds, last = clocked(run, steps, what == "point")
            errors.append(self.error(*last))
            each = 1e6 * seconds / batch / self.scene.seconds
            row = {"steps": steps, "error": errors[-1], "batch": batch, "run_s": seconds}
            row["evaluations"] = stages * steps / self.scene.seconds
            if what == "point":
                row["us"] = each
            self.add(what, engine, method, precision, **row)
            floor = len(errors) > 3 and min(errors[-2:]) > 0.7 * min(errors[:-2])
            if errors[-1] < FINEST or (floor and errors[-1] < 1e-2) or 1.5 * seconds > most_s:
                break
        self.say(self.rows[-1] | {"first": compile_s})


def _growing(first: int) -> Iterator[int]:
    """first times 1, 2, 3, 4, 6, 8, 12, 16, ..."""
    k = first
    while True:
        yield k
        if k > first:
            yield 3 * k // 2
        k *= 2


def clocked(run: Callable[[int], Any], steps: int, often: bool) -> tuple[float, Any]:
    """The fastest of a few runs, and what the last one gave."""
    best, spent, count = float("inf"), 0.0, 0
    enough = 0.05 if ON_GPU else 0.3
    with alone():
        while count == 0 or (often and count < 20 and spent < enough):
            begin = time.perf_counter()
            last = jax.block_until_ready(run(steps))
            best = min(best, time.perf_counter() - begin)
            spent, count = spent + time.perf_counter() - begin, count + 1
    return best, last


def ours(bench: Bench, small: bool) -> None:
    """`rollout`: every integrator, in both precisions."""
    large, stiff = bench.model.nv > 9, bench.scene.stiff
    steps_in_one = STIFF_CHUNK if stiff else CHUNK
    if ON_GPU:
        batch, most_s = 65_536 if large else 262_144 if stiff else 1_048_576, 1.0 if stiff else 0.4
    else:
        batch, most_s = 128 if large or stiff else 1024, 2.0
    batch = SAMPLE if small else batch

    def one(method, precision):
        model = prepared(bench.name, precision)[1]
        if not ON_GPU:  # where no gradient is asked for, unrolled is faster however many joints
            model = model.replace(driver="unrolled")
        ctrls = jnp.broadcast_to(jnp.asarray(bench.ctrl, float), (steps_in_one, bench.m.nu))

        @jax.jit
        def chunk(state, dt):
            path = rb.rollout(
                model, state, ctrls, dt, integrator=method, save_every=steps_in_one, kernel=ON_GPU
            )
            return path.state(-1)

        state = rb.State(*bench.tiled(batch))

        def run(steps):
            now, dt = state, jnp.asarray(bench.scene.seconds / steps, float)
            for _ in range(steps // steps_in_one):
                now = chunk(now, dt)
            return now.q, now.v

        bench.ladder("rbjax", method, precision, run, STAGES[method], batch, steps_in_one, most_s)

    for precision in bench.precisions:
        for method in ("dopri8", "dop853", "tsit5", "rk4", "semi_implicit_euler"):
            bench.guarded("rbjax", method, precision, lambda a=method, b=precision: one(a, b))


MJX = ("RK4", "implicitfast", "Euler")


def mjx_options(march: Callable, args: tuple, steps: int) -> dict[str, Any] | None:
    """The compiler's options that make MJX fastest on this platform: XLA's CPU fusion slows it down
    up to a thousand times, and versions differ in what switches it off."""
    if ON_GPU:
        return None
    found = {}
    for options in (*UNFUSED, None):
        try:
            run = jax.jit(march, compiler_options=options).lower(*args).compile()
        except jax.errors.JaxRuntimeError as error:
            if "compile option" not in str(error):
                raise
            continue
        jax.block_until_ready(run(*args))
        found[clocked(lambda _, f=run: f(*args), steps, True)[0]] = options
        if options is UNFUSED[0]:
            break
    print("mjx", {str(o): f"{t:.3g}" for t, o in found.items()}, flush=True)
    return found[min(found)]


def mjx_runs(bench: Bench, small: bool, errors: bool = True, times: bool = True) -> None:
    """MJX's three integrators: errors on the CPU, a step's time at several batches."""
    chosen: list = []
    if ON_GPU:
        batches = {"RK4": (8192, 65_536) + ((262_144,) if bench.m.nv <= 9 else ())}
        batches |= dict.fromkeys(("implicitfast", "Euler"), (65_536,))
    else:
        batches = {"RK4": (128, 1024), "implicitfast": (1024,), "Euler": (1024,)}
    if small:
        batches = dict.fromkeys(MJX, (SAMPLE,))

    def one(method, precision):
        bench.m.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{method.upper()}")
        model = mjx.put_model(bench.m)
        blank = mjx.make_data(bench.m).replace(ctrl=jnp.asarray(bench.ctrl, float))

        def march(q, v, steps):
            at = model.tree_replace({"opt.timestep": bench.scene.seconds / steps[0]})
            data = jax.vmap(lambda q, v: blank.replace(qpos=q, qvel=v))(q, v)
            step = jax.vmap(mjx.step, (None, 0))
            data = jax.lax.fori_loop(0, steps[1], lambda _, d: step(at, d), data)
            return data.qpos, data.qvel

        if not chosen:
            args = (*bench.tiled(SAMPLE if errors else 128), jnp.array([1000, 4]))
            chosen.append(mjx_options(march, args, 4))
        compiled = jax.jit(march, compiler_options=chosen[0])

        def marching(batch):
            start = bench.tiled(batch)
            return lambda steps, of=None: compiled(*start, jnp.array([of or steps, steps]))

        stages = 4 if method == "RK4" else 1
        if errors and not ON_GPU:
            run = marching(SAMPLE)
            most = 6.0 if method == "RK4" else 2.0
            bench.ladder("mjx", method, precision, run, stages, SAMPLE, 8, most, "error")
        for batch in batches[method] if times else ():
            run = marching(batch)
            count = 8
            jax.block_until_ready(run(1, 1000))
            seconds = clocked(lambda n, f=run: f(n, 1000), count, True)[0]
            us = 1e6 * seconds / batch / count
            bench.add("step", "mjx", method, precision, batch=batch, us_per_step=us)

    for method in MJX:
        for precision in bench.precisions:
            bench.guarded("mjx", method, precision, lambda a=method, b=precision: one(a, b))


def mujoco_runs(bench: Bench, small: bool) -> None:
    """MuJoCo C, one thread, f64."""
    m, data = bench.m, mujoco.MjData(bench.m)
    full = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = np.zeros((SAMPLE, mujoco.mj_stateSize(m, full)))
    for row, q, v in zip(start, bench.q, bench.v, strict=True):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel = q, v
        mujoco.mj_getState(m, data, row, full)

    def one(method):
        m.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{method.upper()}")

        def run(steps):
            m.opt.timestep = bench.scene.seconds / steps
            now, left = start, steps
            while left:
                some = min(left, 1024)
                ctrl = np.broadcast_to(bench.ctrl, (SAMPLE, some, m.nu))
                states = native.rollout(m, data, now, ctrl if m.nu else None, nstep=some)[0]
                now, left = np.ascontiguousarray(states[:, -1]), left - some
            return now[:, 1 : 1 + m.nq], now[:, 1 + m.nq : 1 + m.nq + m.nv]

        stages = 4 if method == "RK4" else 1
        bench.ladder("mujoco", method, "f64", run, stages, SAMPLE, 8, 0.2 if small else 4.0)

    for method in ("RK4", "implicitfast", "implicit", "Euler"):
        bench.guarded("mujoco", method, "f64", lambda a=method: one(a))


#: of `rb.solvers.all()`, the most telling ones first; then all the others
FIRST = (
    "rkmk5", "gauss_legendre3", "radau_iia3", "ros34pw2", "pece4", "commutator_free4", "yoshida4",
    "stoermer_verlet", "adams_bashforth4", "bdf4", "kvaerno5", "sdirk2", "variational_midpoint",
)  # fmt: skip


def solver_runs(bench: Bench, small: bool) -> None:
    """`simulate` with constant steps, a batch by vmap, f64: diffrax's solvers and `rb.solvers`."""
    entries = rb.solvers.all()
    makers: dict[str, Callable] = {"diffrax tsit5": diffrax.Tsit5, "diffrax dopri8": diffrax.Dopri8}
    makers |= {name: entries[name].make for name in (*FIRST, *entries)}
    batch, model = SAMPLE if small else 128, bench.model
    calls = [0]

    def one(make):
        def solved(state, dt, count=False):
            def control(t, state):
                if count:
                    jax.debug.callback(counted)
                return jnp.asarray(bench.ctrl)

            path = rb.simulate(
                model, state, jnp.array([0.0, bench.scene.seconds]), control, solver=make(),
                dt0=dt, adjoint=diffrax.ForwardMode(), throw=False, max_steps=1_000_000,
            )  # fmt: skip
            return path.q[-1], path.v[-1]

        many = jax.jit(jax.vmap(solved, (0, None)))
        state = rb.State(*bench.tiled(batch))

        def run(steps):
            return many(state, jnp.asarray(bench.scene.seconds / steps * (1 + 1e-12)))

        alone_, steps = jax.tree.map(lambda x: x[0], state), 64
        counting = jax.jit(lambda dt: solved(alone_, dt, True))
        calls[0] = 0
        jax.block_until_ready(counting(bench.scene.seconds / steps * (1 + 1e-12)))
        jax.effects_barrier()
        return run, calls[0] / steps

    def counted():
        calls[0] += 1

    def points(name, make):
        run, evaluations = one(make)
        bench.ladder("simulate", name, "f64", run, evaluations, batch, 16, 1.0)

    for name in list(makers)[: 2 if small else None]:
        if name.startswith("rigid_body"):
            continue  # takes rigid bodies alone
        bench.guarded("simulate", name, "f64", lambda a=name: points(a, makers[a]))


PARTS: dict[str, Callable] = {
    "ours": ours,
    "mjx": mjx_runs,
    "mujoco": mujoco_runs,
    "solvers": solver_runs,
}
HALVES = {  # of one part, for two machines
    "mjx-errors": functools.partial(mjx_runs, times=False),
    "mjx-times": functools.partial(mjx_runs, errors=False),
}


def save_rows(name: str, rows: list[dict[str, Any]]) -> None:
    """Save; a copy goes where RBJAX_RESULTS says."""
    path = save(name, rows)
    copy = os.environ.get("RBJAX_RESULTS")
    if copy:
        (Path(copy) / path.name).write_bytes(path.read_bytes())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--parts", nargs="*", default=["ours", "mjx"] if ON_GPU else [*PARTS])
    parser.add_argument("--precisions", nargs="*", default=PRECISIONS)
    parser.add_argument("--deadline", type=float, default=3600.0, help="seconds a scene")
    parser.add_argument("--small", action="store_true", help="a smoke test")
    opts = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name in opts.scenes:
        bench = Bench(name, time.monotonic() + opts.deadline, tuple(opts.precisions))
        for part in opts.parts:
            (PARTS | HALVES)[part](bench, opts.small)
            save_rows(f"work-precision-{name}", bench.rows)


if __name__ == "__main__":
    main()
