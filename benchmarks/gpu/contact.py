"""Robots on the floor on a GPU: steps a second of `rollout` with contacts, beside MJX.

    python -m benchmarks.gpu.contact --robots humanoid humanoid_feet FILE.xml
    python -m benchmarks.gpu.contact --robots humanoid --parts rollout free gradient mjx

Each sample has its own random controls. A step of `rollout` is converged to the tolerance of the
solver. "free" is the same robot without contacts. "scan" is a user's own loop of `rb.step` under
`rb.threads`, with and without contacts. It writes results/gpu-contact-<robot>-<device>.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from benchmarks.cases.standing import on_floor, random_controls, settled
from benchmarks.shared.gpu_timing import finish, timed

STEPS = 50
PARTS = ("rollout", "free", "gradient", "scan", "mjx")


def bench(name: str, batch: int, parts: tuple[str, ...]) -> list[dict[str, Any]]:
    m, rows = on_floor(name), list[dict[str, Any]]()
    short = Path(name).stem
    q, v = (jnp.asarray(x, jnp.float32) for x in settled(m, batch))
    ctrl = jnp.asarray(random_controls(m, np.random.default_rng(1), batch), jnp.float32)
    robots = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robots["rollout"], robots["free"] = rb.load(m), rb.load(m, contacts=False)

    def end(robot: rb.Model, q: Any, v: Any, ctrl: Any) -> Any:
        inputs = jnp.broadcast_to(ctrl[:, None], (len(q), STEPS, robot.nu)) if robot.nu else None
        return rb.rollout(
            robot, rb.State(q, v), inputs, m.opt.timestep, steps=STEPS, save_every=STEPS
        ).q[:, -1]

    def scan(robot: rb.Model, q: Any, v: Any, ctrl: Any) -> Any:
        @rb.threads
        def own(q: Any, v: Any, u: Any) -> Any:
            turn = lambda x, _: (rb.step(robot, x, u, m.opt.timestep), None)  # noqa: E731
            return jax.lax.scan(turn, rb.State(q, v), None, length=STEPS)[0].q

        return jax.vmap(own)(q, v, ctrl)

    def gradient(robot: rb.Model, q: Any, v: Any, ctrl: Any) -> Any:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*biased at any step size")
            return jax.grad(lambda u: (end(robot, q, v, u) ** 2).sum())(ctrl)

    functions = {"gradient": gradient, "scan": scan}
    for part in parts:
        row = {"what": part, "robot": short, "engine": "rbjax", "batch": batch}
        if part in robots:
            robot = robots[part]
            row |= timed(row, lambda *x, r=robot: end(r, *x), q, v, ctrl, work=batch * STEPS)
        elif part in functions:
            for kind, robot in robots.items():
                own = row | {"what": f"{part}, {kind}"}
                f = lambda *x, r=robot, g=functions[part]: g(r, *x)  # noqa: E731
                rows.append(timed(own, f, q, v, ctrl, work=batch * STEPS))
            continue
        else:
            row = of_mjx(m, short, q, v, ctrl)
        rows.append(row)
    return rows


def of_mjx(m: mujoco.MjModel, name: str, q: Any, v: Any, ctrl: Any) -> dict[str, Any]:
    from mujoco import mjx

    size = min(len(q), 8192)  # its fastest batch on an H100 is between 4,096 and 16,384
    m.opt.solver, m.opt.iterations, m.opt.ls_iterations = mujoco.mjtSolver.mjSOL_NEWTON, 4, 8
    model, blank = mjx.put_model(m), mjx.make_data(m)

    def end(q: Any, v: Any, u: Any) -> Any:
        def step(carry: Any, _: Any) -> Any:
            data = mjx.step(model, blank.replace(qpos=carry[0], qvel=carry[1], ctrl=u))
            return (data.qpos, data.qvel), None

        return jax.lax.scan(step, (q, v), None, length=STEPS)[0][0]

    row = {"what": "mjx, 4 Newton steps", "robot": name, "engine": "mjx", "batch": size}
    given = q[:size], v[:size], ctrl[:size]
    return timed(row, jax.vmap(end), *given, work=size * STEPS)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", nargs="+", default=["humanoid", "humanoid_feet"])
    parser.add_argument("--parts", nargs="+", default=PARTS[:3], choices=PARTS)
    parser.add_argument("--batch", type=int, default=65536)
    opts = parser.parse_args()
    for robot in opts.robots:
        found = bench(robot, opts.batch, tuple(opts.parts))
        finish(f"gpu-contact-{Path(robot).stem}", found)
