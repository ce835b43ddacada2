"""The methods of `rb.control.solve` side by side, from random guesses of the controls.

    python -m benchmarks.cpu.control_methods [system ...] [--methods a,b] [--starts 20]

Prints for each: how many of the guesses converged, to how many different costs, the lowest, median
iterations, and the CPU time of one iteration of one problem (all guesses side by side). Collocation
integrates the motion to its own order; the steps of the other methods are RK4 of the same length,
so that costs of a system agree to the error of the discretisation.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.shared.progress import progress
from rbjax.control import Constraint, Control, Cost, Equations, Problem, solve


def double_integrator() -> tuple[Problem, Any, float]:
    """From rest to rest over 1 m in 1 s with the least energy: 12."""
    system = Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)
    goal = Constraint(lambda t, x, u: x - jnp.array([1.0, 0.0]), where="end", name="goal")
    problem = Problem(system, 20, 0.05, running=[Cost(Control(), 2.0)], constraints=[goal])
    return problem, jnp.zeros(2), 5.0


def pendulum() -> tuple[Problem, Any, float]:
    """A pendulum whose torque of 3 N m cannot lift it at once, in 5 s."""
    system = Equations(lambda t, x, u: jnp.stack([x[1], -9.81 * jnp.sin(x[0]) + u[0]]), 2, 1)

    def running(t, x, u):  # 1 + cos x = 2 cos^2(x / 2)
        height = 2 * jnp.cos(x[0] / 2)
        return jnp.stack([jnp.sqrt(0.1) * u[0], 0.1 * x[1], height])

    end = Cost(lambda t, x, u: x - jnp.array([jnp.pi, 0.0]), 100.0)
    problem = Problem(system, 100, 0.05, running=[running], terminal=[end], bounds=(-3.0, 3.0))
    return problem, jnp.zeros(2), 3.0


def cart_pole() -> tuple[Problem, Any, float]:
    """A pole of 0.1 kg on a cart of 1 kg from hanging, the force within 10 N, in 3 s."""

    def rates(t, x, u):
        _, angle, v, w = x
        s, c = jnp.sin(angle), jnp.cos(angle)
        mu = 1 + 0.1 * s * s
        a = (u[0] + 0.1 * 9.81 * c * s - 0.05 * s * w * w) / mu
        turn = (u[0] * c / 0.5 + 1.1 * 9.81 * s / 0.5 - 0.1 * c * s * w * w) / mu
        return jnp.stack([v, w, a, turn])

    def upright(t, x, u):
        return jnp.stack([x[0], jnp.sin(x[1]), 1 - jnp.cos(x[1]), x[2], x[3]])

    problem = Problem(
        Equations(rates, 4, 1), 60, 0.05, bounds=(-10.0, 10.0),
        running=[Cost(upright, 0.1), Cost(Control(), 0.01)], terminal=[Cost(upright, 100.0)],
    )  # fmt: skip
    return problem, jnp.array([0.0, jnp.pi, 0.0, 0.0]), 3.0


def double_pendulum() -> tuple[Problem, Any, float]:
    """Crocoddyl's double pendulum, swung up by its first joint in 1 s."""
    from benchmarks.cases.optimal_control import double_pendulum as case

    found = case()
    problem = Problem(
        found.problem.system.model, 100, 0.01, bounds=None, running=found.problem.running,
        terminal=found.problem.terminal, integrator="rk4",
    )  # fmt: skip
    return problem, found.start, 0.3


SYSTEMS = {f.__name__: f for f in (double_integrator, pendulum, cart_pole, double_pendulum)}
METHODS = ("ddp", "hermite_simpson", "gauss_legendre", "bfgs", "levenberg_marquardt", "adam")
BUDGET = {"adam": 3000, "bfgs": 500}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("systems", nargs="*", default=list(SYSTEMS))
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--starts", type=int, default=20)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print("| system | method | converged | optima | lowest | iterations | ms an iteration |")
    print("|---|---|---|---|---|---|---|")
    for name in args.systems:
        problem, start, size = SYSTEMS[name]()
        shape = (args.starts, problem.horizon, problem.nu)
        guesses = size * jax.random.normal(jax.random.key(0), shape)
        for method in progress(args.methods.split(",")):
            row(name, method, problem, start, guesses)


def row(name: str, method: str, problem: Problem, start: Any, guesses: jax.Array) -> None:
    """One line of the table."""

    def one(ctrls: jax.Array) -> tuple:
        s = solve(
            problem, start, method=method, ctrl=ctrls, iterations=BUDGET.get(method, 300),
            tolerance=1e-8,
        )  # fmt: skip
        return s.status, s.iterations, s.cost, s.gap

    run = jax.jit(jax.vmap(one))
    jax.block_until_ready(run(guesses))
    begun = time.process_time()
    outcome, iterations, cost, _ = (np.asarray(x) for x in jax.block_until_ready(run(guesses)))
    spent = time.process_time() - begun
    good = outcome == 1
    costs = np.unique(np.round(cost[good], 3)) if good.any() else np.array([np.nan])
    each = 1e3 * spent / (len(outcome) * iterations.max())
    turns = f"{np.median(iterations):.0f} ({iterations.max()})"
    others = {int(k): int((outcome == k).sum()) for k in np.unique(outcome[~good])}
    print(
        f"| {name} | {method} | {good.sum()} of {len(good)} {others or ''} | {len(costs)} "
        f"| {np.nanmin(cost):.6g} | {turns} | {each:.2f} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
