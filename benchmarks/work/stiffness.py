"""The stiffness above which implicit methods are faster: a hanging rod of six links with springs.

The dampers grow with the springs (1 ms), so the fast modes die out and a pendulum motion remains.
The vanished modes still limit explicit methods. For each stiffness: the fewest steps of a ladder
with an error below 1e-4 after 1 s, and their time. One core, f64.
`python -m benchmarks.work.stiffness` writes results/work-stiffness-<device>.json.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.robots import as_model
from benchmarks.shared.timing import save
from benchmarks.work.ladder import clocked
from benchmarks.work.scenes import SAMPLE, bare, chain, distance

WANTED, SECONDS = 1e-4, 1.0
RELAXATION = 1e-3  # damping over stiffness, seconds
EXPLICIT = ("rk4", "tsit5", "dopri8")
IMPLICIT = ("radau_iia3", "ros34pw2", "kvaerno5", "sdirk2")
CHUNK = 64


def stiffened(model: rb.Model, k: Any) -> rb.Model:
    """The rod with springs of k N m/rad."""
    springs = jnp.ones(len(model.joints.stiffness)).at[0].set(0.0) * k
    joints = model.joints.replace(stiffness=springs, damping=RELAXATION * springs)
    return model.replace(joints=joints)


def starts(model: rb.Model, batch: int) -> rb.State:
    """Straight rods at random angles and speeds."""
    rng = np.random.default_rng(0)
    first = rng.uniform(-1.0, 1.0, (2, SAMPLE, 1))
    q, v = (np.pad(x, ((0, 0), (0, model.nv - 1))) for x in first)
    return rb.State(*(jnp.tile(jnp.asarray(x), (batch // SAMPLE, 1)) for x in (q, v)))


def explicit(model: rb.Model, method: str, batch: int):
    @jax.jit
    def chunk(k, state, dt):
        path = rb.rollout(
            stiffened(model, k), state, None, dt, integrator=method, save_every=CHUNK, steps=CHUNK
        )
        return path.state(-1)

    state = starts(model, batch)

    def run(k, steps):
        now = state
        for _ in range(steps // CHUNK):
            now = chunk(k, now, SECONDS / steps)
        return now.q, now.v

    return run


def implicit(model: rb.Model, method: str, batch: int):
    make = rb.solvers.all()[method].make

    def one(k, state, dt):
        path = rb.simulate(
            stiffened(model, k), state, jnp.array([0.0, SECONDS]), None, solver=make(), dt=dt,
            adjoint=diffrax.ForwardMode(), throw=False, max_steps=1_000_000,
        )  # fmt: skip
        return path.q[-1], path.v[-1]

    many = jax.jit(jax.vmap(one, (None, 0, None)))
    state = starts(model, batch)
    return lambda k, steps: many(k, state, jnp.asarray(SECONDS / steps * (1 + 1e-12)))


def sweep(
    stiffnesses: list[float], methods: list[str], seconds: float, small: bool
) -> list[dict[str, Any]]:
    model, rows = as_model(bare(chain(1.0, 1.0))), []
    exact = implicit(model, "radau_iia3", SAMPLE)
    ends = {}
    for k in stiffnesses:
        steps, before = 64, exact(k, 32)
        bound = np.inf
        while steps <= 4096:
            now = exact(k, steps)
            bound = distance(model, before, now)
            if bound < WANTED / 100:
                break
            steps, before = 2 * steps, now
        ends[k] = tuple(map(np.asarray, now))
        rows.append({"what": "reference", "stiffness": k, "bound": bound})
    for method in methods:
        make, batch = (explicit, 1024) if method in EXPLICIT else (implicit, 128)
        run, timed = (make(model, method, SAMPLE if small else b) for b in (SAMPLE, batch))
        unit, steps = (CHUNK, CHUNK) if make is explicit else (1, 2)
        jax.block_until_ready(run(stiffnesses[0], steps))
        for k in stiffnesses:
            begin = time.monotonic()
            while True:
                last = run(k, steps)
                error = distance(model, [np.asarray(x) for x in last], ends[k])
                if error < WANTED or time.monotonic() - begin > seconds:
                    break
                steps = max(steps * 5 // 4 // unit, steps // unit + 1) * unit
            row = {"what": "stiff", "method": method, "implicit": make is implicit, "stiffness": k,
                   "steps": steps, "error": error}  # fmt: skip
            if error < WANTED:
                some = 4 * CHUNK if make is explicit else steps  # the cost of a step is constant
                timed(k, some)
                run_s = clocked(lambda n, k=k, f=timed: f(k, n), some, True)[0]
                size = SAMPLE if small else batch
                row["us"] = 1e6 * run_s / size / SECONDS * steps / some
            rows.append(row)
            print(*(f"{x:.3g}" if isinstance(x, float) else x for x in row.values()), flush=True)
            if not error < WANTED:
                break
            steps = steps if make is explicit else 2  # bound by stability, which falls; or not
        save("work-stiffness", rows)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a smoke test")
    parser.add_argument("--methods", nargs="*", default=[*EXPLICIT, *IMPLICIT])
    opts = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    ks = [10.0**e for e in ((1, 2) if opts.small else np.arange(0, 5.1, 0.5))]
    sweep(ks, opts.methods, 3.0 if opts.small else 30.0, opts.small)
