"""Rollouts of wheeled robots on one CPU core, f32, and the arithmetic limit of that core.

`python -m benchmarks.cpu.wheeled [SCENE ...]` pins itself to one core. "known" is a robot that the
jitted function closes over, "argument" one that is passed to it. A step has so many operations
(`rb.compiler.explain`: each addition, product, root, quotient and sine is one). The limit is the
rate of products and sums of polynomials that XLA compiles from the same lanes, in the same process:
`of limit` is the share of it that a rollout reaches. Roots, quotients and sines take several times
as long as a product, which the count does not know.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import argparse

import jax
import jax.numpy as jnp

from benchmarks.shared.timing import markdown_table, measure, save
from benchmarks.shared.wheeled_rollouts import SCENES, STEPS, cases

jax.config.update("jax_enable_x64", False)

BATCH, DEGREE, REPEATS = 4096, 64, 100
COLUMNS = ("what", "method", "robot is", "operations", "compile_s", "M steps/s", "of limit")


def operations_per_second() -> float:
    """The rate of sums and products of Horner's scheme on a batch."""

    def chain(x: jax.Array) -> jax.Array:
        def again(_: int, y: jax.Array) -> jax.Array:
            for k in range(DEGREE):
                y = y * x + (0.5 + 0.001 * k)
            return y * 1e-3

        return jax.lax.fori_loop(0, REPEATS, again, x)

    row = measure(chain, jnp.linspace(0.1, 0.5, BATCH))
    return 2 * DEGREE * REPEATS * BATCH / row["run_min_s"]


def rows(scene: str, limit: float) -> list[dict]:
    out = []
    for case in cases(scene, BATCH):
        row = case.row | {"operations": case.operations} | measure(case.run, *case.args)
        rate = BATCH * STEPS / row["run_min_s"]
        row |= {"M steps/s": rate / 1e6, "of limit": rate * case.operations / limit}
        print(row, flush=True)
        out.append(row)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=list(SCENES))
    chosen = parser.parse_args().scenes
    limit = operations_per_second()
    found = [{"what": "limit", "G operations/s": limit / 1e9}]
    for scene in chosen:
        found += rows(scene, limit)
    save("cpu-wheeled", found)
    print(f"limit: {limit / 1e9:.1f} G operations/s\n")
    print(markdown_table(found[1:], COLUMNS))


if __name__ == "__main__":
    main()
