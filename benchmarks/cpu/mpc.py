"""Model predictive control of a 7-joint arm: time of a tick, and its distribution.

    python -m benchmarks.cpu.mpc [--ticks 2000]

The tip follows a circle; horizon 30 steps of 5 ms, bounds of the controls, one core, f64. A tick
is a call of `rb.control.RealTime`: state in, control out, with the prediction over the delay.
The plant is the model with 20 % more mass in each body.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import argparse
import gc
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.timing import markdown_table, save
from rbjax.control.optimal.system import system_of

C = rb.control
DT, HORIZON, RADIUS, PERIOD = 0.005, 30, 0.08, 2.0


def problem_of(model: rb.Model, tip: str, centre: np.ndarray) -> Any:
    rest = model.default_state()

    def at(t: Any) -> C.Problem:
        w = 2 * jnp.pi / PERIOD
        middle = jnp.asarray(centre)
        goal = middle + RADIUS * jnp.stack([jnp.cos(w * t) - 1, jnp.sin(w * t), 0.0 * t])
        point = C.Point(goal, body=tip)
        return C.Problem(
            model, HORIZON, DT,
            running=[C.Cost(point, 1e3), C.Cost(C.Control(rest.q), 1e-3),
                     C.Cost(C.Velocity(), 0.1)],
            terminal=[C.Cost(point, 1e2)],
        )  # fmt: skip

    return at


def run(iterations: int, ticks: int) -> dict[str, Any]:
    model = rb.load("arm7")
    rest = model.default_state()
    tip = model.body_names[-1]
    centre = np.asarray(rb.frame_pose(model, rest.q, tip)[1])
    at = problem_of(model, tip, centre)
    bodies = model.bodies.replace(mass=1.2 * model.bodies.mass)
    plant = system_of("plant", model.replace(bodies=bodies))
    move = jax.jit(lambda *x: plant.step(*x))
    start = time.perf_counter()
    act = C.RealTime(C.mpc(at, iterations=iterations), rest, jnp.tile(rest.q, (HORIZON, 1)))
    compile_s = time.perf_counter() - start
    place = jax.jit(lambda q: rb.frame_pose(model, q, tip)[1])
    x, off, cpu, wall = rest, [], [], []
    gc.collect()
    gc.disable()
    for k in range(ticks):
        t = k * DT
        begin, began = time.process_time(), time.perf_counter()
        u = act(t, x)
        cpu.append(1e3 * (time.process_time() - begin))
        wall.append(1e3 * (time.perf_counter() - began))
        assert act.status == 0, act.status
        x = jax.block_until_ready(move(t, x, u, DT))
        w = 2 * np.pi / PERIOD
        goal = centre + RADIUS * np.array([np.cos(w * (t + DT)) - 1, np.sin(w * (t + DT)), 0])
        off.append(np.linalg.norm(np.asarray(place(x.q)) - goal))
    gc.enable()
    timing = act.timing()
    counts, edges = np.histogram(wall, 12)
    return {
        "iterations": iterations, "ticks": ticks, "hz": 1e3 / timing.median,
        "median_ms": timing.median, "p99_ms": timing.p99, "worst_ms": timing.worst,
        "median_cpu_ms": float(np.median(cpu)), "p99_cpu_ms": float(np.quantile(cpu, 0.99)),
        "late": timing.late, "hz_at_p99": 1e3 / timing.p99,
        "tip_error_mm": 1e3 * float(np.median(off)), "compile_s": compile_s,
        "counts": counts.tolist(), "edges_ms": [round(float(e), 3) for e in edges],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ticks", type=int, default=2000)
    ticks = parser.parse_args().ticks
    rows = [run(iterations, ticks) for iterations in (1, 2)]
    print(markdown_table(rows, [k for k in rows[0] if k not in ("counts", "edges_ms")]))
    print(save("cpu-mpc", rows))


if __name__ == "__main__":
    main()
