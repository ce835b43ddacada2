"""The gradient of a squared simulation error: forward and reverse mode, by numbers and recordings.

`python -m benchmarks.cpu.gradient_modes [--full] [--small] [--gpu]` writes
results/<cpu or gpu>-gradient-modes-<device>.json; --full has five counts of unknowns on a CPU, the
default two, in results of their own. A recording is that of a 7-joint arm; the unknown
numbers are the first n of its armatures, friction, and inertias. ratio is the time of forward mode
over that of reverse mode; chosen, the mode that
`rbjax.sysid.simulation.objective` takes by the shape. f64 on a CPU, f32 on a GPU. memory is what
the compiled program holds besides its arguments and results.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import numpy as np

import rbjax as rb
from benchmarks.shared.progress import add_full, progress, sized
from benchmarks.shared.timing import markdown_table, measure, save
from rbjax.sysid import Channel, Grid, Inertia, Recording, Unknown, squares
from rbjax.sysid.simulation.objective import faster

COLUMNS = ("recordings", "unknowns", "mode", "compile_s", "run_s", "memory MB", "ratio", "chosen")
T = 0.002


def recordings(model: rb.Model, count: int, steps: int) -> list[Recording]:
    """Motions under sums of sines, read at every step."""
    rng, t = np.random.default_rng(0), np.arange(steps + 1) * T
    found = []
    for k in range(count):
        pace, phase = rng.uniform(0.2, 1.0, 7), rng.uniform(0.0, 6.0, 7)
        ctrl = 0.5 * np.sin(2 * np.pi * pace * t[:-1, None] + phase)
        path = rb.rollout(model, model.default_state(), ctrl.astype(model.gravity.dtype), T,
                          integrator="rk4")  # fmt: skip
        channels = {"q": Channel(t, path.q), "v": Channel(t, path.v), "ctrl": Channel(t[:-1], ctrl)}
        found.append(Recording(f"motion {k}", channels, initial_state=path.state(0)))
    return found


def unknowns(n: int) -> dict[str, Any]:
    """The first n numbers: seven armatures, seven viscous frictions, ten of each body."""
    found: dict[str, Any] = {"armature": Unknown("joints.armature", slice(0, min(7, n)))}
    if n > 7:
        found["damping"] = Unknown("joints.damping", slice(0, min(7, n - 7)))
    for k in range(7, 7 - (n - 14) // 10, -1):
        found[f"link{k}"] = Inertia(f"link{k}")
    return found


def rows(counts: list[int], numbers: list[int], steps: int) -> list[dict[str, Any]]:
    model = rb.load("arm7")
    size = model.gravity.dtype.itemsize
    found = []
    for count in counts:
        runs = recordings(model, count, steps)
        for n in progress(numbers, lambda n, count=count: f"{count} recordings, {n} unknowns"):
            times, grads, memory = {}, {}, {}
            for mode in ("forward", "reverse"):
                of = squares(model, runs, unknowns(n), grid=Grid(T), mode=mode)
                assert of.x.size == n
                x = of._of.by_run(1.02 * of.x)
                times[mode] = measure(of._both, x, of._of.runs, budget_s=1.0)
                compiled = of._both.lower(x, of._of.runs).compile()
                memory[mode] = compiled.memory_analysis().temp_size_in_bytes / 1e6
                grads[mode] = np.asarray(of.value_and_grad(1.02 * of.x)[1])
            off = np.abs(grads["forward"] - grads["reverse"]).max() / np.abs(grads["forward"]).max()
            ratio = times["forward"]["run_s"] / times["reverse"]["run_s"]
            found += [
                times[mode] | {
                    "recordings": count, "unknowns": n, "steps": steps, "mode": mode,
                    "memory MB": memory[mode], "ratio": ratio, "chosen": faster(n, count, size),
                    "difference": float(off),
                } for mode in times
            ]  # fmt: skip
            print(found[-2], found[-1], sep="\n", flush=True)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--small", action="store_true", help="a minute, to see that it runs")
    parser.add_argument("--gpu", action="store_true")
    add_full(parser, "2, 4, 14, 34 and 84 unknowns", "4 and 34")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", not asked.gpu)
    if asked.small:
        print(markdown_table(rows([2], [2], 20), COLUMNS))
    else:
        counts = [1, 64, 1024] if asked.gpu else [1, 16]
        numbers = [4, 24, 84] if asked.gpu else [2, 4, 14, 34, 84] if asked.full else [4, 34]
        found = rows(counts, numbers, 500)
        print(markdown_table(found, COLUMNS))
        name = sized("cpu-gradient-modes", asked.full)
        save("gpu-gradient-modes" if asked.gpu else name, found)
