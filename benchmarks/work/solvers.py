"""Speed against accuracy of every solver of `rb.solvers` through `simulate`, with constant steps.

A task is one solver on one scene in one precision. One program is compiled (vmapped over the batch,
with a traced step) and run at 4, 8, 16, ... steps. Rows are those of `benchmarks.work.ladder`, then
one "done" with the seconds of tracing and compiling ("first_s") and of the whole task.
A motion that a solver gives up (unsolved equations of a step), or that is not finite, has an
infinite error. On the CPU explicit solvers use the unrolled driver. Implicit ones, whose programs
also contain the field's Jacobian, and all on a GPU use the driver of "auto". For the humanoid this
is the rolled one, because unrolled code would compile for minutes.

A second program with a callback counts force evaluations a step, for one robot, in f64, on the CPU.
An explicit solver, whose count is constant, is counted once. An implicit one is counted on every
scene, at several step sizes at which it reaches the end. A Jacobian counts as one. The counts also
serve for f32 and the GPU.

`rigid_body_splitting` solves only `RigidBody`: it runs on the free body and the top, without
`simulate`.

`benchmarks.work.queue` runs this file in many processes.
"""

from __future__ import annotations

import functools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from benchmarks.shared.gpu_timing import alone
from benchmarks.shared.timing import provenance
from benchmarks.work.ladder import ON_GPU, Bench
from benchmarks.work.scenes import prepared
from rbjax.rotations import quaternion
from rbjax.solvers import RigidBody

#: the most important ones of `rb.solvers.all()` first; then all the others
FIRST = (
    "rkmk5", "gauss_legendre3", "radau_iia3", "ros34pw2", "pece4", "commutator_free4", "yoshida4",
    "stoermer_verlet", "adams_bashforth4", "bdf4", "kvaerno5", "sdirk2", "variational_midpoint",
)  # fmt: skip
DIFFRAX = {"diffrax tsit5": diffrax.Tsit5, "diffrax dopri8": diffrax.Dopri8}
ENTRIES = rb.solvers.all()
MAKERS: dict[str, Callable] = DIFFRAX | {n: ENTRIES[n].make for n in (*FIRST, *ENTRIES)}
IMPLICIT = {name for name, entry in ENTRIES.items() if entry.implicit}
RIGID = ("free_body", "spinning_top")  # scenes that are one rigid body
COUNTED = (16, 64, 256, 1024)  # steps
COUNTED_STIFF = (*COUNTED, 4096, 16_384)


def applicable(scene: str, method: str) -> bool:
    """Whether the scene's robot has the form that the solver takes."""
    return method != "rigid_body_splitting" or scene in RIGID


def batch_of(bench: Bench) -> int:
    nv, stiff = bench.model.nv, bench.scene.stiff
    if ON_GPU:
        return 2048 if nv > 9 else 4096 if nv > 6 or stiff else 16_384
    return 32 if nv > 9 or stiff else 128


def solved(bench: Bench, model: rb.Model, method: str, control: Callable) -> Callable:
    """(state, dt) -> q, v at the end; nan if the solver failed."""
    if method == "rigid_body_splitting":
        return rigid_body(bench, method)

    def run(state, dt):
        path = rb.simulate(
            model, state, jnp.array([0.0, bench.scene.seconds]), control, solver=MAKERS[method](),
            dt=dt, adjoint=diffrax.ForwardMode(), throw=False, max_steps=10_000_000,
        )  # fmt: skip
        return tuple(jnp.where(path.success, x[-1], jnp.nan) for x in (path.q, path.v))

    return run


def rigid_body(bench: Bench, method: str) -> Callable:
    """The body of a scene about its centre, which has constant velocity, or about its pivot."""
    m, T = bench.m, bench.scene.seconds
    arm, mass, weight = m.body_ipos[1], m.body_mass[1], m.body_mass[1] * m.opt.gravity
    inertia = m.body_inertia[1] + mass * (arm @ arm - arm**2)

    def torque(t, turn, args):
        down = quaternion.rotate(quaternion.conjugate(turn), jnp.asarray(weight, float))
        return jnp.cross(jnp.asarray(arm, float), down)

    def run(state, dt):
        free = m.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
        solution = diffrax.diffeqsolve(
            RigidBody(jnp.asarray(inertia, float), None if free else torque), MAKERS[method](),
            0.0, T, dt, (state.q[-4:], state.v[-3:]), saveat=diffrax.SaveAt(t1=True),
            adjoint=diffrax.ForwardMode(), throw=False, max_steps=10_000_000,
        )  # fmt: skip
        turn, w = (x[-1] for x in solution.ys)
        q = jnp.concatenate([state.q[:-4] + T * state.v[:-3], turn])
        v = jnp.concatenate([state.v[:-3], w])
        good = solution.result == diffrax.RESULTS.successful
        return jnp.where(good, q, jnp.nan), jnp.where(good, v, jnp.nan)

    return run


def doubling(first: int) -> Iterator[int]:
    while True:
        yield first
        first *= 2


def points(bench: Bench, method: str, precision: str, reference: Callable) -> None:
    """Errors and times of one solver. It compiles while the reference may still be computed."""
    begin = time.perf_counter()
    implicit, large = method in IMPLICIT, bench.model.nv > 9 or bench.scene.stiff
    model = prepared(bench.name, precision)[1]
    if not implicit and not ON_GPU:
        model = model.replace(driver="unrolled")
    ctrl, batch, first = jnp.asarray(bench.ctrl, float), batch_of(bench), 4
    state = rb.State(*bench.tiled(batch))

    def dt(steps):  # slightly longer, so that rounding adds no extra step
        return jnp.asarray(bench.scene.seconds / steps * (1 + 1e-12), float)

    many = jax.jit(jax.vmap(solved(bench, model, method, lambda t, state: ctrl), (0, None)))
    program = many.lower(state, dt(first)).compile()
    first_s = time.perf_counter() - begin
    *bench.end, bench.bound = reference()

    def run(steps):
        return program(state, dt(steps))

    with alone():
        jax.block_until_ready(run(first))
    most_s = (0.5 if ON_GPU else 3.0 if implicit else 1.5) * (2 if large else 1)
    most_s *= 2 if ON_GPU and bench.scene.stiff else 1
    bench.ladder(
        "simulate", method, precision, run, None, batch, first, most_s, rungs=doubling(first)
    )
    bench.add("done", "simulate", method, precision, first_s=first_s)


def counts(bench: Bench, method: str) -> None:
    """Force evaluations a step, of the runs that reach the end."""
    if method == "rigid_body_splitting":  # torques, at both ends
        bench.add("count", "simulate", method, "f64", of_steps=COUNTED, a_step=[2] * len(COUNTED))
        return
    calls = [0]

    def counted(t, v):
        calls[0] += 1

    def control(t, state):
        jax.debug.callback(counted, t, state.v)  # once for each of a batch of stages
        return jnp.asarray(bench.ctrl)

    one = jax.jit(solved(bench, bench.model, method, control))
    start = rb.State(*(jnp.asarray(x[0]) for x in (bench.q, bench.v)))
    found = {}
    for steps in COUNTED_STIFF if bench.scene.stiff else COUNTED:
        calls[0] = 0
        end = jax.block_until_ready(one(start, bench.scene.seconds / steps * (1 + 1e-12)))
        jax.effects_barrier()
        if all(np.isfinite(x).all() for x in end):
            found[steps] = calls[0] / steps
    bench.add("count", "simulate", method, "f64", of_steps=[*found], a_step=[*found.values()])


def rows_of(scene: str, method: str, precision: str, reference: Callable) -> list[dict[str, Any]]:
    """The rows of one task; the precision "count" counts the evaluations."""
    begin, waited = time.perf_counter(), [0.0]

    def awaited():
        before = time.perf_counter()
        found = reference()
        waited[0] += time.perf_counter() - before
        return found

    bench = Bench(scene, float("inf"), end=(None, None, np.nan))
    if precision == "count":
        bench.guarded("simulate", method, "f64", lambda: counts(bench, method))
    else:
        work = functools.partial(points, bench, method, precision, awaited)
        bench.guarded("simulate", method, precision, work)
    bench.rows[-1]["task_s"] = time.perf_counter() - begin - waited[0]
    return [{k: rounded(x) for k, x in row.items()} for row in bench.rows[1:]]


def rounded(x: Any) -> Any:
    return float(f"{x:.5g}") if isinstance(x, float) else x


def reference_in(folder: Path, scene: str, most_s: float = 200.0) -> Any:
    """The end of a scene, when the process that computes it has written it."""
    path = folder / f"{scene}.npz"
    begin = time.monotonic()
    while not path.exists():
        if time.monotonic() - begin > most_s:
            raise TimeoutError(f"no reference of {scene} after {most_s:.0f} s")
        time.sleep(0.2)
    with np.load(path) as end:
        return end["q"], end["v"], float(end["bound"])


def serve(references: Path) -> None:
    """Run the tasks from stdin, a line each; answer each with a line of rows."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # everything else that is printed goes to the log
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(provenance()), file=answers, flush=True)
    ends = functools.cache(functools.partial(reference_in, references))
    for n, line in enumerate(sys.stdin, 1):
        scene, method, precision = json.loads(line)
        rows = rows_of(scene, method, precision, functools.partial(ends, scene))
        print(json.dumps(rows), file=answers, flush=True)
        if n % 10 == 0:
            jax.clear_caches()  # programs of finished tasks


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
