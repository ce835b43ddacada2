"""The Jacobian of a simulation error on a GPU, beside MJX: a 7-joint arm with 50 unknowns.

`python -m benchmarks.gpu.sysid_jacobian [--small] [--engines rbjax mjx] [--chunks N ...]` writes
results/gpu-sysid-jacobian-<device>.json.

1,024 recordings of 1,000 steps each, all positions and velocities after every step, f32. Unknown
are seven armatures, seven viscous frictions, seven masses, 21 numbers of centres of mass and eight
principal moments. J has 1,024 x 14,000 rows and 50 columns, 2.9 GB. Each recording's part of it is
reduced to J^T J and J^T r, which is what Gauss-Newton needs. So both engines return the same. Both
step by semi-implicit Euler.

rbjax: rates beside each motion, one thread each (`identify`'s own residual). MJX: `jax.jvp` of its
steps in `lax.scan` under `vmap` over recordings and directions. All recordings are one program, or
parts of as many as `--chunks` says, in turn. An engine that does not fit is tried with a part of
`--fewer` recordings; `of 1024 s` is then multiplied up from it, which the row says.
slopes_s is J alone, written out; motion_s the rates of all states alone, which is the kernel.
program GB is what the compiled program holds beside its arguments; peak GB is the device's peak in
the process so far, where JAX reports it. The rows of rbjax come first, so theirs is their own.
The two are compared in f64 on two recordings of 50 steps, and in f32 on all.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

import rbjax as rb
from benchmarks.shared.robots import as_model
from benchmarks.shared.timing import markdown_table, others, save
from benchmarks.work.scenes import bare
from rbjax.model import State
from rbjax.sysid import Derived, Grid, Setup
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.runs import Run
from rbjax.sysid.simulation.simulation_error import SimulationError

COLUMNS = (
    "engine", "recordings", "chunk", "lower_s", "compile_s", "run_s", "slopes_s", "motion_s",
    "of 1024 s", "ratio", "peak GB", "program GB", "difference f64", "difference f32", "note",
)  # fmt: skip
RECORDINGS, STEPS, T, MOMENTS = 1024, 1000, 0.002, 8


def arm() -> mujoco.MjModel:
    """The arm without geoms, stepped alike by both engines."""
    m = bare("arm7")
    m.opt.timestep = T
    m.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    return m


def numbers(m: mujoco.MjModel) -> np.ndarray:
    """The fifty true numbers."""
    first = m.nbody - 7
    parts = m.dof_armature, m.dof_damping, m.body_mass[first:], m.body_ipos[first:]
    return np.concatenate([*map(np.ravel, parts), m.body_inertia[first:].ravel()[:MOMENTS]])


def split(p: jax.Array, moments: jax.Array) -> tuple[jax.Array, ...]:
    """Armatures, frictions, masses, centres (7, 3), and moments (7, 3) of the links."""
    armature, damping, mass, com, some = jnp.split(p, (7, 14, 21, 42))
    rest = jnp.asarray(moments, p.dtype).ravel()[MOMENTS:]
    return armature, damping, mass, com.reshape(7, 3), jnp.append(some, rest).reshape(7, 3)


def states(m: mujoco.MjModel, count: int, steps: int, dtype: Any) -> tuple[jax.Array, ...]:
    """Starts q, v (count, 7), controls (count, steps, 7), and what was recorded: zeros. The cost of
    a Jacobian does not depend on it."""
    rng = np.random.default_rng(0)
    q, v = 0.3 * rng.normal(size=(2, count, 7))
    t = np.arange(steps)[:, None] * T
    pace, phase = rng.uniform(0.2, 1.0, (count, 1, 7)), rng.uniform(0.0, 6.0, (count, 1, 7))
    ctrl = 0.5 * np.sin(2 * np.pi * pace * t + phase)
    return tuple(jnp.asarray(x, dtype) for x in (q, v, ctrl))


def normal(r: jax.Array, J: jax.Array) -> jax.Array:
    """[J r]^T [J r] of r (recordings, rows) and J (recordings, rows, n): a product for each
    recording, since one of all would have one small result and little to share out. Rows are filled
    up to whole 16 bytes, without which the product takes several times as long."""
    n = J.shape[-1] + 1
    rows = jnp.concatenate([J, r[..., None], jnp.zeros((*r.shape, -n % 4), r.dtype)], -1)
    return jnp.einsum("kri,krj->kij", rows, rows, precision="highest").sum(0)[:n, :n]


def by_rbjax(m: mujoco.MjModel, steps: int, part: str = "") -> Callable:
    """part: "slopes" or "motion", to time J alone, or the rates of the states alone."""
    model = as_model(m)
    first, moments = model.nb - 7, m.body_inertia[m.nbody - 7 :]
    quats = m.body_iquat[m.nbody - 7 :]
    turns = np.empty((7, 9))
    for k in range(7):
        mujoco.mju_quat2Mat(turns[k], quats[k])
    turns = turns.reshape(7, 3, 3)

    def into(setup: Setup, p: jax.Array) -> Setup:
        armature, damping, mass, com, principal = split(p, moments)
        R, old = jnp.asarray(turns, p.dtype), setup.model
        inertia = jnp.einsum("kij,kj,klj->kil", R, principal, R, precision="highest")
        bodies, joints = old.bodies, old.joints
        return setup.replace(model=old.replace(
            joints=joints.replace(armature=armature, damping=damping),
            bodies=bodies.replace(
                mass=bodies.mass.at[first:].set(mass), com=bodies.com.at[first:].set(com),
                inertia=bodies.inertia.at[first:].set(inertia),
            ),
        ))  # fmt: skip

    setup = Setup.of(model)
    sought = Unknowns.of("arm", {"all": Derived(tuple(numbers(m)), into)}, setup)
    grid = Grid(T, 1, "semi_implicit_euler")
    dtype = model.gravity.dtype
    t = jnp.arange(1, steps + 1, dtype=dtype) * T
    made: dict[int, SimulationError] = {}

    def jacobian(p: jax.Array, q: jax.Array, v: jax.Array, ctrl: jax.Array) -> jax.Array:
        count = q.shape[0]
        shape = (count, steps, 7)
        each = {s: jnp.broadcast_to(t, shape[:2]) for s in "qv"}
        zero, one = ({s: f(shape, dtype) for s in "qv"} for f in (jnp.zeros, jnp.ones))
        runs = Run(State(q, v), ctrl, each, zero, one)
        if count not in made:
            made[count] = SimulationError(setup, sought, runs, grid)
        x, programs = jnp.broadcast_to(p, (count, p.size)), made[count].programs
        if part == "motion":

            def states(x: jax.Array, run: Run) -> Any:
                def along(e: jax.Array) -> Any:
                    return jax.jvp(lambda x: programs.simulate(x, run)[1][:2], (x,), (e,))[1]

                return jax.vmap(along)(jnp.eye(p.size, dtype=p.dtype))

            return jax.vmap(states)(x, runs)
        r, J = programs.slopes(x, runs)
        return (r, J) if part == "slopes" else normal(r, J)

    return jacobian


def by_mjx(m: mujoco.MjModel, steps: int) -> Callable:
    model, blank = mjx.put_model(m), mjx.make_data(m)
    first, moments = m.nbody - 7, m.body_inertia[m.nbody - 7 :]

    def motion(p: jax.Array, q: jax.Array, v: jax.Array, ctrl: jax.Array) -> jax.Array:
        armature, damping, mass, com, principal = split(p, moments)
        now = model.replace(
            dof_armature=armature, dof_damping=damping,
            body_mass=model.body_mass.at[first:].set(mass),
            body_ipos=model.body_ipos.at[first:].set(com),
            body_inertia=model.body_inertia.at[first:].set(principal),
        )  # fmt: skip

        def once(carry: Any, u: jax.Array) -> tuple[Any, Any]:
            d = mjx.step(now, blank.replace(qpos=carry[0], qvel=carry[1], ctrl=u))
            return (d.qpos, d.qvel), (d.qpos, d.qvel)

        q, v = jax.lax.scan(once, (q, v), ctrl)[1]
        return jnp.concatenate([q.ravel(), v.ravel()])

    def jacobian(p: jax.Array, q: jax.Array, v: jax.Array, ctrl: jax.Array) -> jax.Array:
        def each(q: jax.Array, v: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
            def along(e: jax.Array) -> tuple[jax.Array, jax.Array]:
                return jax.jvp(lambda p: motion(p, q, v, u), (p,), (e,))

            return jax.vmap(along, out_axes=(None, 1))(jnp.eye(p.size, dtype=p.dtype))

        return normal(*jax.vmap(each)(q, v, ctrl))

    return jacobian


ENGINES = {"rbjax": by_rbjax, "mjx": by_mjx}


def jitted(f: Callable) -> Any:
    """On a CPU without the fusion emitters, with which MJX compiles for minutes."""
    return jax.jit(f, compiler_options=rb.compiler_options())


def apart(a: Any, b: Any, least: float) -> float:
    """The largest difference of [J r]^T [J r] of the engines, by its diagonal. Columns below
    `least` of the largest count as that: some are zero, since nothing shows them."""
    scale = np.sqrt(np.diag(b))
    scale = np.maximum(scale, least * scale.max())
    return float((np.abs(np.asarray(a) - np.asarray(b)) / np.outer(scale, scale)).max())


def parity(count: int = 2, steps: int = 50) -> float:
    """The difference in f64."""
    with jax.enable_x64(True):
        m = arm()
        given = (jnp.asarray(numbers(m)), *states(m, count, steps, float))
        a, b = (jitted(make(m, steps))(*given) for make in ENGINES.values())
        return apart(a, b, 1e-6)


def median_of(f: Callable, repeats: int = 3) -> float:
    """The median time of a call, after a first one."""
    jax.block_until_ready(f())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(f())
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def timed(
    engine: str, recordings: int, chunk: int, steps: int, repeats: int
) -> tuple[dict[str, Any], Any]:
    """A row, and [J r]^T [J r] of all recordings, None where it did not run."""
    m = arm()
    p, (q, v, ctrl) = jnp.asarray(numbers(m), jnp.float32), states(m, recordings, steps, np.float32)
    parts = [(q[k : k + chunk], v[k : k + chunk], ctrl[k : k + chunk])
             for k in range(0, recordings, chunk)]  # fmt: skip
    row: dict[str, Any] = {
        "engine": engine, "recordings": recordings, "chunk": chunk, "steps": steps,
        "unknowns": p.size,
    }  # fmt: skip
    found = None
    try:
        start = time.perf_counter()
        lowered = jitted(ENGINES[engine](m, steps)).lower(p, *parts[0])
        row["lower_s"] = time.perf_counter() - start
        start = time.perf_counter()
        program = lowered.compile()
        row["compile_s"] = time.perf_counter() - start
        row["program GB"] = program.memory_analysis().temp_size_in_bytes / 1e9

        def whole() -> jax.Array:
            return functools.reduce(jnp.add, [program(p, *part) for part in parts])

        found = np.asarray(whole(), float)
        row["run_s"] = median_of(whole, repeats)
        row["of 1024 s"] = row["run_s"] * RECORDINGS / recordings
        if engine == "rbjax" and chunk == recordings:
            for part in ("slopes", "motion") if repeats > 1 else ():
                f = jitted(by_rbjax(m, steps, part)).lower(p, *parts[0]).compile()
                row[f"{part}_s"] = median_of(lambda f=f: f(p, *parts[0]))
        if recordings != RECORDINGS:
            row["note"] = f"multiplied up from {recordings} recordings"
    except Exception as error:  # the other engine is still of interest
        row["note"] = f"{type(error).__name__}: {str(error)[:150]}"
    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        row["peak GB"] = stats["peak_bytes_in_use"] / 1e9
    print(json.dumps(row), flush=True)
    return row, found


def rows_of(asked: Any) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    whole: dict[str, Any] = {}
    recordings, steps, repeats = (4, 10, 1) if asked.small else (RECORDINGS, STEPS, 3)
    for engine in asked.engines:
        for chunk in (min(c, recordings) for c in asked.chunks):
            row, found = timed(engine, recordings, chunk, steps, repeats)
            rows.append(row)
            if found is not None:
                whole[engine] = found
        if engine not in whole:
            rows.append(timed(engine, asked.fewer, asked.fewer, steps, repeats)[0])
    best: dict[str, float] = {}
    for row in rows:
        if "of 1024 s" in row:
            name = row["engine"]
            best[name] = min(best.get(name, np.inf), row["of 1024 s"])
    if len(best) == len(ENGINES):
        for row in rows:
            if row.get("of 1024 s") == best["rbjax"]:
                row["ratio"] = best["mjx"] / best["rbjax"]
    if len(whole) == len(ENGINES):
        rows[0]["difference f32"] = apart(whole["rbjax"], whole["mjx"], 1e-3)
    print(markdown_table(rows, COLUMNS), flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--engines", nargs="*", default=list(ENGINES), choices=list(ENGINES))
    parser.add_argument("--chunks", nargs="*", type=int, default=[RECORDINGS],
                        help="recordings of a part; each size is a program of its own")  # fmt: skip
    parser.add_argument("--fewer", type=int, default=128)
    parser.add_argument("--small", action="store_true", help="to see that it runs")
    asked = parser.parse_args()
    rows = rows_of(asked)

    def kept() -> None:
        if not asked.small:
            older = others("gpu-sysid-jacobian", rows, ("engine", "chunk", "recordings"))
            save("gpu-sysid-jacobian", rows + older)

    kept()  # times come first: the comparison compiles both once more
    off = parity(1, 10) if asked.small else parity()
    print(f"difference in f64: {off:.2g}", flush=True)
    rows[0]["difference f64"] = off
    kept()
    assert off < 1e-8


if __name__ == "__main__":
    main()
