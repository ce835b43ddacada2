"""Forward dynamics of beams: evaluations a second, and the reverse derivative.

`python -m benchmarks.gpu.flexible` writes results/gpu-flexible-<device>.json: beams of 8 and of 52
coordinates (`benchmarks.cases.beams`), `jax.vmap` of `rb.forward_dynamics`, batch first, in f64 and
f32; its vjp by q, v and tau, which on a GPU includes the forward pass; and steps of `rb.rollout`
with elasticity and damping. On a CPU it measures the same with a smaller batch.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp

import rbjax as rb
from benchmarks.cases.beams import CASES
from benchmarks.shared.gpu_timing import timed
from benchmarks.shared.timing import markdown_table, save

STEPS = 50
COLUMNS = ("robot", "nv", "dtype", "run", "batch", "lower_s", "compile_s", "M/s median")


def rows(names: list[str], batch: int, *, gradient: bool) -> Iterator[dict]:
    for name in names:
        for dtype in (jnp.float64, jnp.float32):
            model = CASES[name]().astype(dtype)
            keys = jax.random.split(jax.random.key(0), 4)
            q, v, tau, w = (0.3 * jax.random.normal(k, (batch, model.nv), dtype) for k in keys)
            forward = jax.vmap(functools.partial(rb.forward_dynamics, model))
            row = {"robot": name, "nv": model.nv, "dtype": dtype.__name__, "batch": batch}
            yield timed(row | {"run": "forward"}, forward, q, v, tau, work=batch)
            if gradient:

                def back(q, v, tau, w, forward=forward):
                    return jax.vjp(forward, q, v, tau)[1](w)

                yield timed(row | {"run": "vjp"}, back, q, v, tau, w, work=batch)
            some = rb.State(q[: batch // 4], v[: batch // 4])

            def last(state, model=model):
                path = rb.rollout(
                    model, state, None, 1e-3, steps=STEPS, save_every=STEPS,
                    integrator="implicitfast",
                )  # fmt: skip
                return path.q[:, -1]

            row |= {"batch": batch // 4, "run": "rollout, implicitfast"}
            yield timed(row, last, some, work=batch // 4 * STEPS)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", nargs="+", default=list(CASES))
    parser.add_argument("--batch", type=int, default=131_072)
    parser.add_argument("--no-gradient", action="store_true")
    given = parser.parse_args()
    with jax.enable_x64(True):
        found = list(rows(given.robots, given.batch, gradient=not given.no_gradient))
    print(markdown_table(found, COLUMNS))
    print(save("gpu-flexible", found))


if __name__ == "__main__":
    main()
