"""Wrong data on a leg of a quadruped in the air: what is found and named, what the fit survives.

`python -m benchmarks.cpu.wrong_data` prints the table of docs/wrong_data.md. The error is the
largest of nine numbers (armature, viscous friction, bias of three joints) against the truth: of the
fit to the wrong data, and of one to what `diagnose` mended.
"""

import time

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.shared.timing import markdown_table  # noqa: E402
from rbjax.sysid import Grid, Identified, diagnose, identify  # noqa: E402
from tests.sysid.wrong_data import TRUTH, UNKNOWNS, WRONG, T, leg  # noqa: E402

COLUMNS = ("wrong", "loss", "named", "error", "error_mended", "seconds")


def error(found: Identified) -> float:
    return float(np.abs(np.array([*found.values.values()]) - TRUTH).max())


if __name__ == "__main__":
    setup, run = leg()
    cases = [("nothing", lambda run: run, "squares")]
    cases += [(name, wrong, "squares") for name, (wrong, *_) in WRONG.items()]
    cases.append(("5 % outliers", WRONG["5 % outliers"][0], "huber"))
    rows = []
    for name, wrong, loss in cases:
        found = identify(setup, wrong(run), UNKNOWNS, grid=Grid(T), loss=loss, steps=40)
        start = time.perf_counter()
        said = diagnose(found)
        seconds = time.perf_counter() - start
        mended = identify(setup, said.recordings, UNKNOWNS, grid=Grid(T))
        named = "; ".join(
            " ".join([cause.kind, *cause.channels, *cause.columns]) for cause in said.causes
        )
        rows.append({"wrong": name, "loss": loss, "named": named or "nothing",
                     "error": error(found), "error_mended": error(mended),
                     "seconds": seconds})  # fmt: skip
        print(said.words(), flush=True)
    print(markdown_table(rows, COLUMNS))
