"""Wrong recordings of a leg and of a quadruped in the air: what `diagnose` finds, errors of fits.

`python -m benchmarks.cpu.wrong_data [leg] [quadruped] [--data FOLDER] [--cases ...]` writes
results/cpu-wrong-data-<part>-<device>.json, by default of the leg, if it ran all cases. The error
is the largest of all parameters against the truth (of the leg armature, viscous friction and bias
of three joints; of the quadruped those and Coulomb friction of twelve joints, and the delay): of
the fit to the wrong data, and of a fit to the data that `diagnose` corrected. The quadruped's files
lie beside the repository, or in FOLDER.
"""

import argparse
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.cases import problems  # noqa: E402
from benchmarks.cases.problems import Problem, quadruped  # noqa: E402
from benchmarks.cases.wrong_data import TRUTH, UNKNOWNS, WRONG, T, Wrong, leg, ways  # noqa: E402
from benchmarks.shared.progress import progress  # noqa: E402
from benchmarks.shared.timing import markdown_table, save  # noqa: E402
from rbjax.sysid import Grid, diagnose, identify  # noqa: E402

COLUMNS = ("wrong", "loss", "named", "error", "error, corrected", "seconds")
#: of the quadruped's recording, s
PIECE = 3.0


def of_leg() -> tuple[Problem, dict[str, Wrong]]:
    setup, run = leg()
    return Problem(setup, run, UNKNOWNS, TRUTH, {"grid": Grid(T)}), WRONG


def of_quadruped() -> tuple[Problem, dict[str, Wrong]]:
    problem = quadruped()
    run = problem.run.segment(0.0, PIECE)
    return problem._replace(run=run), ways(tuple(problem.setup.model.joint_names), 1, 11)


def table(problem: Problem, wrongs: dict[str, Wrong], some: list[str]) -> list[dict]:
    def error(found) -> float:
        return float(np.abs(np.array([*found.values.values()]) - problem.truth).max())

    cases = [("nothing", lambda run: run, "squares")]
    cases += [(name, wrong.make, "squares") for name, wrong in wrongs.items()]
    cases.append(("5 % outliers", wrongs["5 % outliers"].make, "huber"))
    rows = []
    chosen = [case for case in cases if not some or case[0] in some]
    for name, make, loss in progress(chosen, lambda case: case[0]):
        start = time.perf_counter()
        wrong = make(problem.run)
        how = {"loss": loss, "max_evaluations": 40, "restarts": 0} | problem.how
        found = identify(problem.setup, wrong, problem.unknowns, **how)
        diagnosis = diagnose(found)
        seconds = time.perf_counter() - start
        corrected = identify(problem.setup, diagnosis.recordings, problem.unknowns, **problem.how)
        named = "; ".join(
            " ".join([cause.kind, *cause.channels, *cause.columns]) for cause in diagnosis.causes
        )
        rows.append({"wrong": name, "loss": loss, "named": named or "nothing",
                     "error": error(found), "error, corrected": error(corrected),
                     "seconds": seconds})  # fmt: skip
        print(rows[-1], diagnosis.summary(), sep="\n", flush=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*", default=["leg"])
    parser.add_argument("--data", type=Path, default=problems.GO2)
    parser.add_argument("--cases", nargs="*", default=[], help="of the first column; all if none")
    asked = parser.parse_args()
    problems.GO2 = asked.data
    for part, make in (("leg", of_leg), ("quadruped", of_quadruped)):
        if part in asked.parts and (part == "leg" or problems.GO2.exists()):
            rows = table(*make(), asked.cases)
            print(f"\n{part}\n{markdown_table(rows, COLUMNS)}", flush=True)
            if not asked.cases:
                print(save(f"cpu-wrong-data-{part}", rows))
