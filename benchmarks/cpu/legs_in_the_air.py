"""The legs of a real Go2: models of growing detail, and CMA-ES on the same residual.

`python -m benchmarks.cpu.legs_in_the_air [choice] [half] [search] [--full]` writes
results/cpu-legs-in-the-air-<processor>.json; the default is `choice`, --full all three. The
recording lies beside the repository.

Errors are RMS over the joints in mrad: fitted, where the model was fitted; unseen, on the samples
that follow, free from their first state under the recorded commands. `choice` fits the first two
thirds of the first half of one leg, and its unseen part is the last third: there the model was
chosen. `half` fits the first half of all legs, its unseen part is the second half. `search` is one
leg, by `identify` and by CMA-ES: the same unknowns, first guess and squares. A rollout is a
simulated motion; a direction of a Jacobian counts as one, too.
"""

import argparse
import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from benchmarks.cases import go2  # noqa: E402
from benchmarks.shared.cma_es import cma_es  # noqa: E402
from benchmarks.shared.progress import add_full, progress  # noqa: E402
from benchmarks.shared.timing import markdown_table, others, save  # noqa: E402
from rbjax.sysid import Setup, identify  # noqa: E402
from rbjax.sysid.parameters.unknown_vector import Unknowns  # noqa: E402
from rbjax.sysid.simulation.runs import make_run  # noqa: E402
from rbjax.sysid.simulation.setup import simulate_motion  # noqa: E402

COLUMNS = (
    "part", "model", "unknowns", "rollouts", "evaluations", "seconds", "fitted", "unseen", "ok"
)  # fmt: skip
NAME, SEARCHED, STEPS = "cpu-legs-in-the-air", "RL", 14


def mrad(residuals: Any) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.square(residuals))))


def fitted(part: str, name: str, problem: Any, last: int, end: int) -> dict[str, Any]:
    setup, unknowns = problem
    model = setup.model
    start = time.perf_counter()
    run = go2.recording(model, 0, last)
    # as in the source, a motion begins at its first sample, and there is one search
    found = identify(
        setup,
        run,
        unknowns,
        grid=go2.GRID,
        max_evaluations=STEPS,
        estimate_initial_state=False,
        restarts=0,
    )
    seconds = time.perf_counter() - start
    n = len(found.values)
    return {
        "part": part, "model": name, "unknowns": n,
        "rollouts": found.evaluations * (1 + n),  # at most: some steps are refused
        "evaluations": found.evaluations, "seconds": seconds, "fitted": mrad(found.rms["q"]),
        "unseen": 1e3 * found.validate([go2.recording(model, last, end)]).rms, "ok": found.success,
    }  # fmt: skip


def searched(budget: int) -> dict[str, Any]:
    """CMA-ES; positive numbers in the logarithm, curves in units of 0.3 N m."""
    model = go2.robot(SEARCHED)
    setup, unknowns = go2.by_position(model)
    of = Unknowns.of("search", unknowns, setup)
    guess = jnp.asarray(of.read(setup))
    positive = np.arange(guess.size) < 6  # armature and viscous friction come first
    run = make_run(setup, go2.recording(model), go2.GRID)

    def made(p: jax.Array) -> Setup:
        return of.write(setup, p)

    def numbers(y: jax.Array) -> jax.Array:
        return jnp.where(positive, guess * jnp.exp(y), guess + 0.3 * y)

    @jax.jit
    @jax.vmap
    def squares(y: jax.Array) -> jax.Array:
        path = simulate_motion(made, numbers(y), run.start, run.commands, go2.GRID)
        return ((path.q[: run.values["q"].shape[0]] - run.values["q"]) ** 2).sum()

    start = time.perf_counter()
    best, used = cma_es(lambda y: np.asarray(squares(y)), guess.size, 0.3, budget)
    seconds = time.perf_counter() - start
    found = made(numbers(jnp.asarray(best)))
    errors = [
        mrad(go2.free_run(found, go2.recording(model, *part)))
        for part in ((0, go2.HALF), (go2.HALF, go2.END))
    ]
    return {
        "part": "search", "model": "CMA-ES", "unknowns": guess.size, "rollouts": used,
        "evaluations": used, "seconds": seconds, "fitted": errors[0], "unseen": errors[1],
    }  # fmt: skip


def choice() -> list[dict[str, Any]]:
    leg = go2.robot(SEARCHED)
    return [
        fitted("choice", f"curves of {terms}", go2.by_position(leg, terms), go2.FITTED, go2.HALF)
        for terms in progress(((1, 1), (1, 8), (12, 1), go2.TERMS))
    ]


def half() -> list[dict[str, Any]]:
    whole = go2.robot(*go2.LEGS)
    free = go2.free_run(go2.nominal(whole), go2.recording(whole, go2.HALF, go2.END))
    return [
        {"part": "half", "model": "nominal", "unknowns": 0, "unseen": mrad(free)},
        fitted("half", "49 numbers", go2.joint_dynamics(whole), go2.HALF, go2.END),
        fitted("half", f"curves of {go2.TERMS}", go2.by_position(whole), go2.HALF, go2.END),
    ]


def search(budget: int) -> list[dict[str, Any]]:
    problem = go2.by_position(go2.robot(SEARCHED))
    return [fitted("search", "identify", problem, go2.HALF, go2.END), searched(budget)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*", help="if left out, those of the size")
    parser.add_argument("--rollouts", type=int, default=20_000)
    add_full(parser, "choice, half and search", "choice")
    asked = parser.parse_args()
    parts = {"choice": choice, "half": half, "search": lambda: search(asked.rollouts)}
    if go2.DATA.exists():
        for part in progress(asked.parts or [*parts][: None if asked.full else 1]):
            rows = parts[part]()
            print(markdown_table(rows, COLUMNS), flush=True)
            save(NAME, rows + others(NAME, rows, ("part", "model")))
    else:
        print(f"{go2.DATA} is not there: nothing is measured")
