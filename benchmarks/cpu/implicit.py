"""Implicit methods on robots: compile time, time of a step, and evaluations of the vector field.

`python -m benchmarks.cpu.implicit [ROBOT ...] [--solvers NAME ...] [--full]`. Robots:
double_pendulum, with --full also arm7 and humanoid. f64, one sample, constant
steps of 10 ms through `rb.simulate`, with the model an argument. Compile times are in CPU seconds,
which do not depend on the load of the machine. Both times are also measured with
`rb.compiler_options()`. The control counts evaluations, because every evaluation of the vector
field calls it. A Jacobian counts as one, with any number of columns.
"""

from __future__ import annotations

import argparse
import itertools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.progress import add_full, progress
from benchmarks.shared.robots import NAMES, ours
from benchmarks.shared.timing import markdown_table, measure, others, save

jax.config.update("jax_enable_x64", True)

ROBOTS = ("double_pendulum", "arm7", "humanoid")
SOLVERS = ("rk4", "implicit_midpoint", "gauss_legendre2", "radau_iia3", "bdf2", "kvaerno3",
           "ros34pw2", "generalized_alpha", "variational_midpoint")  # fmt: skip
COLUMNS = ("robot", "nv", "solver", "trace s", "compile s", "step us", "compile s, options",
           "step us, options", "fields", "jacobians")  # fmt: skip
STEPS, DT = 20, 0.01
FINDERS = {"newton": rb.solvers.newton}


class Counter:
    """A zero control that counts the calls from the field and from its derivative."""

    def __init__(self, nu: int):
        self.nu, self.fields, self.jacobians = nu, 0, 0

        @jax.custom_jvp
        def ask(v):
            return self._zeros(v, "fields")

        @ask.defjvp
        def _(primals, tangents):
            return self._zeros(primals[0], "jacobians"), 0.0 * tangents[0].sum() * jnp.ones(nu)

        self.ask = ask

    def __call__(self, t: Any, state: rb.State) -> jax.Array:
        return self.ask(state.v)

    def _zeros(self, v: jax.Array, name: str) -> jax.Array:
        def count(v):
            setattr(self, name, getattr(self, name) + 1)
            return np.zeros(self.nu)

        shape = jax.ShapeDtypeStruct((self.nu,), v.dtype)
        return jax.pure_callback(count, shape, v, vmap_method="sequential")


def solver_of(name: str) -> Any:
    """By its name in the registry, with "/newton" for full Newton."""
    plain, _, finder = name.partition("/")
    options = {"root_finder": FINDERS[finder]()} if finder else {}
    make: Any = rb.solvers.all()[plain].make
    return make(**options)


def row(robot: str, name: str) -> dict[str, Any]:
    model = ours(robot) if robot in NAMES else rb.load(robot)
    state = model.random_state(jax.random.key(0))
    ts, solver = jnp.array([0.0, STEPS * DT]), solver_of(name)

    def run(model, state, control=None):
        path = rb.simulate(model, state, ts, control, solver=solver, dt=DT, throw=False)
        return path.q, path.v, path.success

    out: dict[str, Any] = {"robot": robot, "nv": model.nv, "solver": name}
    for which, options in (("", None), (", options", rb.compiler_options())):
        clock = [time.process_time()]
        lowered = jax.jit(run, compiler_options=options).lower(model, state)
        clock.append(time.process_time())
        compiled = lowered.compile()
        clock.append(time.process_time())
        assert compiled(model, state)[2], "a step failed"
        timed = measure(compiled, model, state, jit=False)
        trace, build = (b - a for a, b in itertools.pairwise(clock))
        out.setdefault("trace s", trace)
        out |= {f"compile s{which}": build, f"step us{which}": timed["run_min_s"] / STEPS * 1e6}
    if model.nu and model.nv <= 7:  # a second compilation
        counter = Counter(model.nu)
        jax.block_until_ready(jax.jit(lambda m, s: run(m, s, counter))(model, state))
        out |= {"fields": counter.fields / STEPS, "jacobians": counter.jacobians / STEPS}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", help="if left out, those of the size")
    parser.add_argument("--solvers", nargs="*", default=list(SOLVERS))
    add_full(parser, ", ".join(ROBOTS), ROBOTS[0])
    asked = parser.parse_args()
    robots = asked.robots or ROBOTS[: None if asked.full else 1]
    rows = []
    for robot, name in progress(itertools.product(robots, asked.solvers), " ".join):
        rows.append(row(robot, name))
        print(rows[-1], flush=True)
    print(markdown_table(rows, COLUMNS))
    print(save("cpu-implicit", rows + others("cpu-implicit", rows, ("robot", "solver"))))


if __name__ == "__main__":
    main()
