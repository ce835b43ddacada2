"""Robots with loops on a GPU, beside MJX: steps a second, what is left of the loops, gradients.

`python -m benchmarks.gpu.loops four_bar cassie.xml` writes results/loops-<robot>-<device>.json.
Batch first, f32, 100 steps; ours semi-implicit Euler with the formulations "projected" and
"baumgarte", MJX its own Euler with soft constraints, Newton's method, one iteration and more. The
error is the norm of the rows at the end, the median over the batch; "open" is the same robot
without its constraints. `--parts` takes the other formulations by name, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

import rbjax as rb
from benchmarks.shared.gpu_timing import timed
from benchmarks.shared.timing import markdown_table, others, save

STEPS = 100
WAYS = ("projected", "baumgarte", "open")
OTHERS = tuple(name for name in rb.constraints.formulations() if name not in WAYS)
PARTS = (*WAYS, *(f"gradient-{way}" for way in WAYS), "mjx")
MORE = (*OTHERS, *(f"gradient-{way}" for way in OTHERS))
COLUMNS = ("what", "engine", "batch", "lower_s", "compile_s", "M/s median", "rows left")


def compiled(name: str) -> mujoco.MjModel:
    """A file's model; of a scene without the geoms, which MJX would move too."""
    if name in rb.scenes():
        return mujoco.MjModel.from_xml_string(rb.write_mjcf(rb.load(name)))
    return mujoco.MjModel.from_xml_path(name)


def start(m: mujoco.MjModel, model: rb.Model, batch: int) -> rb.State:
    """States on the loops: the file's own, turned and moved a little, put back by projection."""
    q = jnp.asarray(m.key_qpos[0] if m.nkey else m.qpos0)
    q, v = jnp.tile(q, (batch, 1)), jax.random.normal(jax.random.key(0), (batch, model.nv)) * 0.1
    exact = rb.constraints.Projection(iterations=8)
    state = rb.State(q.astype(jnp.float32), v.astype(jnp.float32))
    return jax.jit(jax.vmap(lambda s: exact.project(model, 0.0, s)))(state)


def rows(name: str, batch: int, parts: Collection[str]) -> Iterator[dict]:
    m = compiled(name)
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    model = rb.load(m).astype(jnp.float32)
    state = start(m, model, batch)
    dt = float(m.opt.timestep)

    def left(q, v):
        off = jax.vmap(lambda q, v: rb.constraints.residual(model, rb.State(q, v)).value)(q, v)
        return float(jnp.median(jnp.sqrt((off * off).sum(-1))))

    feedback = rb.constraints.Baumgarte.for_step(dt)
    ways = {"projected": (model, "projected"), "baumgarte": (model, feedback)}
    ways["open"] = model.replace(constraints=()), None
    ways |= {name: (model, name) for name in OTHERS}
    for what, (robot, formulation) in ways.items():

        def run(state: rb.State, robot: rb.Model = robot, formulation=formulation):
            path = rb.rollout(
                robot, state, None, dt, steps=STEPS, save_every=STEPS, constraints=formulation
            )
            return path.q[:, -1], path.v[:, -1]

        def slope(state: rb.State, run=run):
            return jax.grad(lambda v: sum((x * x).sum() for x in run(state.replace(v=v))))(state.v)

        row = {"what": what, "engine": "rbjax", "batch": batch}
        if what in parts:
            row = timed(row, run, state, work=batch * STEPS)
            yield row | {"rows left": left(*jax.jit(run)(state))}
        if f"gradient-{what}" in parts:
            yield timed(
                {"what": f"gradient, {what}", "engine": "rbjax", "batch": batch},
                slope, state, work=batch * STEPS,
            )  # fmt: skip
    for iterations in (1, 4) if "mjx" in parts else ():
        m.opt.solver, m.opt.iterations, m.opt.ls_iterations = 2, iterations, 4
        theirs = mjx.put_model(m)
        blank = mjx.make_data(theirs)

        def march(state: rb.State, theirs=theirs, blank=blank):
            def step(c, _):
                d = jax.vmap(lambda q, v: mjx.step(theirs, blank.replace(qpos=q, qvel=v)))(*c)
                return (d.qpos, d.qvel), None

            return jax.lax.scan(step, (state.q, state.v), None, STEPS)[0]

        row = {"what": f"MJX, {iterations} iterations", "engine": "mjx", "batch": batch}
        row = timed(row, march, state, work=batch * STEPS)
        yield row | {"rows left": left(*jax.jit(march)(state))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", default=["four_bar"], help="scenes, or MJCF files")
    parser.add_argument("--batch", type=int, default=65536)
    parser.add_argument("--parts", nargs="*", default=PARTS, choices=PARTS + MORE)
    args = parser.parse_args()
    for name in args.robots:
        found = []
        for row in rows(name, args.batch, args.parts):
            found.append(row)
            print(row, flush=True)
        print(markdown_table(found, COLUMNS))
        title = f"loops-{Path(name).stem}"
        print(save(title, found + others(title, found, ("what", "batch"))))


if __name__ == "__main__":
    main()
