"""Computing time against error: integrators of rbjax and MJX, on one batch of robots.

The reference is Dormand-Prince 8 with a much smaller step. Every engine runs the same batch in f64
without contacts. Compilation time is not counted. Each point is one step size.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from rbjax.demo.report import ReportSection
from rbjax.loading import load
from rbjax.model import Model, State
from rbjax.motion.rollout import rollout
from rbjax.motion.simulate import simulate
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, PURPLE, RED, STYLE
from rbjax.validation.mjx import integrator as mjx_integrator
from rbjax.validation.reference import smooth

#: scene -> (keyframe, spread of the batch, seconds, steps of the coarsest run)
SCENES = {
    "double_pendulum": ("swing", 0.1, 1.0, 100),
    "arm7": ("home", 0.3, 0.5, 200),
}
CHUNK = 50  # steps in one compiled rollout
REFINED = (1, 2, 4)
BUDGET = 0.2  # seconds of timing a point, at least one run
LOOK = {
    "semi-implicit Euler": (BLUE, "o", "-"),
    "RK4": (GREEN, "s", "-"),
    "Tsit5": (PURPLE, "^", "-"),
    "Dopri8": (INK, "D", "-"),
    "MJX Euler": (ORANGE, "o", "--"),
    "MJX RK4": (RED, "s", "--"),
}

Run = Callable[[int], tuple[Any, Any]]  # steps -> final (q, v) of the batch


def start(model: Model, scene: str, batch: int) -> State:
    """Draw random initial states around a keyframe."""
    keyframe, spread, _, _ = SCENES[scene]
    state = model.keyframe(keyframe)
    rng = np.random.default_rng(0)
    v = np.asarray(state.v) + spread * rng.normal(size=(batch, model.nv))
    return State(jnp.broadcast_to(state.q, (batch, model.nq)), jnp.asarray(v))


def held(model: Model, scene: str) -> np.ndarray:
    """Return the keyframe's controls (nu,), which are constant in every engine."""
    return np.asarray(model.keyframes.ctrl[model.keyframe_names.index(SCENES[scene][0])])


def ours(model: Model, state: State, ctrl: np.ndarray, seconds: float) -> dict[str, Run]:
    """Make rbjax's integrators: `rollout` in compiled chunks, and `simulate` with fixed steps."""

    ctrls = jnp.broadcast_to(ctrl, (CHUNK, model.nu))

    def fixed(name: str) -> Run:
        @jax.jit
        def chunk(now: State, dt: Any) -> State:
            path = rollout(model, now, ctrls, dt, integrator=name, save_every=CHUNK)
            return path.state(-1)

        def run(steps: int) -> tuple[Any, Any]:
            now = state
            for _ in range(steps // CHUNK):
                now = chunk(now, seconds / steps)
            return now.q, now.v

        return run

    def solved(solver: diffrax.AbstractSolver) -> Run:
        def one(state: State, dt: Any) -> tuple[Any, Any]:
            path = simulate(
                model,
                state,
                jnp.array([0.0, seconds]),
                lambda t, state: jnp.asarray(ctrl),
                solver=solver,
                dt=dt,
                adjoint=diffrax.ForwardMode(),
                throw=False,
            )
            return path.q[-1], path.v[-1]

        batch = jax.jit(jax.vmap(one, (0, None)))
        return lambda steps: batch(state, jnp.asarray(seconds / steps * (1 + 1e-12)))

    return {
        "semi-implicit Euler": fixed("semi_implicit_euler"),
        "RK4": fixed("rk4"),
        "Tsit5": solved(diffrax.Tsit5()),
        "Dopri8": solved(diffrax.Dopri8()),
    }


def measure(
    scene: str, batch: int, refined: tuple[int, ...], say: Callable[[str], None], mjx: bool
) -> dict[str, list[tuple[int, float, float]]]:
    """Measure all methods on a scene. Return method -> rows (steps, microseconds per simulated
    second and robot, relative error)."""
    _, _, seconds, coarse = SCENES[scene]
    model = load(scene)
    if model.nv > 4:
        model = model.replace(driver="rolled")
    state = start(model, scene, batch)
    ctrl = held(model, scene)
    runs = ours(model, state, ctrl, seconds)
    if mjx:
        m, _ = smooth(scene)
        # MJX's RK4 of an arm compiles for half a minute
        for name in ("Euler", "RK4") if model.nv <= 4 else ("Euler",):
            runs[f"MJX {name}"] = mjx_integrator(m, name, state.q, state.v, ctrl, seconds)
    say(f"integrators: {scene}, compilation")
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # XLA compiles one while Python traces another
        list(pool.map(_compile, runs.values()))
    say(f"integrators: {scene}, reference")
    exact = _flat(runs["Dopri8"](coarse * refined[-1] * 2))
    out = {}
    for name, run in runs.items():
        say(f"integrators: {scene}, {name}")
        rows = []
        for k in refined:
            steps = coarse * k
            if name in ("Dopri8", "Tsit5"):
                steps = max(steps // 4, 5)
            best, spent = float("inf"), 0.0
            while spent < BUDGET:
                begin = time.perf_counter()
                final = jax.block_until_ready(run(steps))
                best = min(best, time.perf_counter() - begin)
                spent += time.perf_counter() - begin
            last = _flat(final)
            error = np.abs(last - exact).max(-1) / np.abs(exact).max(-1)
            rows.append((steps, 1e6 * best / batch / seconds, float(np.median(error))))
        out[name] = rows
    return out


def _compile(run: Run) -> None:
    with jax.enable_x64(True):  # this setting is per thread
        jax.block_until_ready(run(CHUNK))


def _flat(last: tuple[Any, Any]) -> np.ndarray:
    return np.concatenate([np.asarray(x) for x in last], -1)


def integrators(
    folder: Path,
    say: Callable[[str], None],
    *,
    scenes: tuple[str, ...] = tuple(SCENES),
    batch: int = 32,
    refined: tuple[int, ...] = REFINED,
    mjx: bool = True,
) -> ReportSection:
    """Measure time and error of the integrators, and draw them. Return the section of the
    report."""
    found = {scene: measure(scene, batch, refined, say, mjx) for scene in scenes}
    _picture(folder / "integrators.png", found)
    rows = []
    for scene, methods in found.items():
        for name, points in methods.items():
            steps, cost, error = points[-1]
            rows.append((scene, name, f"{steps}", f"{cost:,.0f}", f"{error:.1e}"))
    text = (
        f"Each line is one method at several step sizes, on {batch} robots at once in f64: further "
        "left is faster, lower is more accurate. The fixed-step integrators of `rollout` give the "
        "highest throughput. `simulate` runs any diffrax solver, whose higher order is faster if "
        "more than a few digits are needed.",
    )
    return ReportSection(
        "Time against error: integrators of rbjax and MJX",
        text,
        (("integrators.png", "Computing time for a second of one robot's motion, against the "
          "relative error of its final state (median of the batch)."),),
        ("scene", "method", "finest: steps", "us per simulated second", "relative error"),
        tuple(rows),
        note="Wall time on this machine, without compilation. MJX runs with "
        "xla_cpu_use_fusion_emitters=False; a CPU runs it up to a thousand times slower without.",
    )  # fmt: skip


def _picture(path: Path, found: dict[str, dict[str, list[tuple[int, float, float]]]]) -> None:
    with plt.rc_context(STYLE):
        size = (3.9 * len(found) + 0.4, 4.6)
        figure, axes = plt.subplots(
            1, len(found), figsize=size, layout="constrained", squeeze=False
        )
        for ax, (scene, methods) in zip(axes[0], found.items(), strict=True):
            for name, points in methods.items():
                color, marker, line = LOOK[name]
                x, y = [p[1] for p in points], [max(p[2], 1e-16) for p in points]
                ax.loglog(x, y, color=color, marker=marker, ls=line, ms=5, lw=1.6, label=name)
            ax.set(title=scene.replace("_", " "), xlabel="computing time per simulated second [us]")
        axes[0, 0].set(ylabel="relative error of the final state")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=6 if len(found) > 2 else 2)
        figure.savefig(path)
        plt.close(figure)
