"""Speed against accuracy: error of a motion by computing time and by force evaluations.

`python -m benchmarks.work.precision --scenes arm7 --parts ours mjx mujoco` writes
results/work-precision-<scene>-<device>.json, and keeps the other parts of an older file.
`benchmarks.work.precision_chart` draws all of them, and the solvers of `simulate` from
`benchmarks.work.queue`.

Rows: those of `benchmarks.work.ladder`, and "step", microseconds per robot and step at a batch.
MJX's time for an error is its number of steps for that error times its fastest step over all
batches. Errors are measured on the CPU, where a small sample costs less; they are the same on a
GPU. Compilation is not counted. "options": on the CPU, the seconds of both engines with several
compiler options; the fastest are used.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout as native

import rbjax as rb
from benchmarks.shared.timing import others, save
from benchmarks.work.ladder import ON_GPU, PRECISIONS, Bench, clocked
from benchmarks.work.scenes import SAMPLE, SCENES, prepared
from rbjax.compiling import WIDE, WITHOUT_EMITTERS, xla_accepts
from rbjax.motion.integrators import INTEGRATORS, TABLEAUS
from rbjax.validation.mjx import UNFUSED, mjx

CHUNK = 4  # steps in one rollout, or
STIFF_CHUNK = 64
STAGES = {name: TABLEAUS[name].stages if name in TABLEAUS else 1 for name in INTEGRATORS}


def fastest(
    bench: Bench, engine: str, precision: str, march: Callable, args: tuple,
    candidates: Iterable[dict[str, Any] | None],
) -> dict[str, Any] | None:  # fmt: skip
    """The CPU compiler options with which a program runs fastest, of those that this jaxlib knows;
    a row has the times of all."""
    if ON_GPU:
        return None
    found: dict[float, dict[str, Any] | None] = {}
    for options in candidates:
        if not all(xla_accepts(*option) for option in (options or {}).items()):
            continue
        run = jax.jit(march, compiler_options=options).lower(*args).compile()
        jax.block_until_ready(run(*args))
        found[clocked(lambda _, f=run: f(*args), 1, True)[0]] = options
    seconds = {" ".join(options or {}) or "none": t for t, options in found.items()}
    bench.add("options", engine, "-", precision, seconds=seconds)
    return found[min(found)]


def ours(bench: Bench, small: bool) -> None:
    """`rollout`: every integrator, in both precisions."""
    large, stiff = bench.model.nv > 9, bench.scene.stiff
    steps_in_one = STIFF_CHUNK if stiff else CHUNK
    if ON_GPU:
        batch, most_s = 65_536 if large else 262_144 if stiff else 1_048_576, 1.0 if stiff else 0.4
    else:
        batch, most_s = 240 if stiff else 1024, 2.0
    batch = SAMPLE if small else batch
    chosen: dict[str, Any] = {}

    def one(method, precision):
        model = prepared(bench.name, precision)[1]
        ctrls = jnp.broadcast_to(jnp.asarray(bench.ctrl, float), (steps_in_one, bench.m.nu))

        def some(state, dt):
            path = rb.rollout(
                model, state, ctrls, dt, integrator=method, save_every=steps_in_one, kernel=ON_GPU
            )
            return path.state(-1)

        def march(state, dt, times):  # one call for any number of steps, as for MJX
            return jax.lax.fori_loop(0, times, lambda _, now: some(now, dt), state)

        state = rb.State(*bench.tiled(batch))
        if precision not in chosen:
            args = state, jnp.asarray(bench.scene.seconds / 1000, float), 4
            candidates = None, dict([WIDE]), rb.compiler_options()
            chosen[precision] = fastest(bench, "rbjax", precision, march, args, candidates)
        compiled = jax.jit(march, compiler_options=chosen[precision])

        def run(steps):
            dt = jnp.asarray(bench.scene.seconds / steps, float)
            now = compiled(state, dt, steps // steps_in_one)
            return now.q, now.v

        bench.ladder("rbjax", method, precision, run, STAGES[method], batch, steps_in_one, most_s)

    for precision in bench.precisions:
        for method in ("dopri8", "dop853", "tsit5", "rk4", "semi_implicit_euler"):
            bench.guarded("rbjax", method, precision, lambda a=method, b=precision: one(a, b))


MJX = ("RK4", "implicitfast", "Euler")


def mjx_options() -> tuple[dict[str, Any] | None, ...]:
    """XLA's CPU fusion slows MJX down, up to a thousand times; options against it, by jaxlib."""
    if xla_accepts(*WITHOUT_EMITTERS):
        return dict([WITHOUT_EMITTERS]), dict([WITHOUT_EMITTERS, WIDE])
    return dict([UNFUSED[-1]]), None


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
            chosen.append(fastest(bench, "mjx", precision, march, args, mjx_options()))
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


PARTS: dict[str, Callable] = {
    "ours": ours,
    "mjx": mjx_runs,
    "mujoco": mujoco_runs,
}
HALVES = {  # of one part, for two machines
    "mjx-errors": functools.partial(mjx_runs, times=False),
    "mjx-times": functools.partial(mjx_runs, errors=False),
}


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
            kept = others(f"work-precision-{name}", bench.rows, ("what", "engine"))
            save(f"work-precision-{name}", [*bench.rows, *kept])


if __name__ == "__main__":
    main()
