"""A real pendulum of one, two and three arms: free runs of 1.5 s on pieces that were not fitted.

`python -m benchmarks.cpu.pendulum_data` writes results/cpu-pendulum-data-<processor>.json. The
recordings lie beside the repository. A row is a piece. Errors are the RMS over samples and arms of
the angles from the vertical, in mrad, of the model found here and of the published numbers, by the
same code, each from its own best start: that which suits all of the piece (1.5 s), or its first
third (0.5 s), after which nothing of the piece is known.
"""

import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.cases.pendulums import (  # noqa: E402
    DATA,
    NAMES,
    SECONDS,
    chain,
    errors,
    fit,
    published,
    split,
)
from benchmarks.shared.progress import progress  # noqa: E402
from benchmarks.shared.timing import markdown_table, save  # noqa: E402

COLUMNS = ("pendulum", "piece", "found 1.5", "published 1.5", "found 0.5", "published 0.5")


def rows(name: str) -> list[dict[str, Any]]:
    fitted, unseen = split(name)
    start = time.perf_counter()
    found = fit(name, fitted)
    seconds, theirs = time.perf_counter() - start, chain(published(name))
    print(f"{name}: {len(fitted)} segments fitted in {seconds:.1f} s, {found.status.text}")
    columns: dict[str, np.ndarray] = {}
    for known in (SECONDS, SECONDS / 3):
        columns[f"found {known:g}"] = 1e3 * errors(found.setup, unseen, known=known)
        columns[f"published {known:g}"] = 1e3 * errors(theirs, unseen, known=known)
    each = [
        {"pendulum": name, "piece": run.name} | {k: float(x[i]) for k, x in columns.items()}
        for i, run in enumerate(unseen)
    ]
    for label, of in {"median": np.median, "largest": np.max}.items():
        total = {k: float(of(x)) for k, x in columns.items()}
        each.append({"pendulum": name, "piece": label, "seconds": seconds} | total)
    worse = sum(int((columns[f"found {k}"] >= columns[f"published {k}"]).sum()) for k in (1.5, 0.5))
    print(f"{name}: not better than the published numbers: {worse} of {2 * len(unseen)}\n")
    return each


if __name__ == "__main__":
    if DATA.exists():
        table = [row for name in progress(NAMES) for row in rows(name)]
        print(markdown_table(table, COLUMNS))
        save("cpu-pendulum-data", table)
    else:
        print(f"{DATA} is not there: nothing to measure")
