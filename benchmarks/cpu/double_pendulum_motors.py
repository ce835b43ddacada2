"""The DFKI double pendulum, every run held out once: torques explained and free runs.

`python -m benchmarks.cpu.double_pendulum_motors` writes
results/cpu-double-pendulum-motors-<processor>.json. The recordings lie beside the repository; where
they are not, nothing is written. R2 is that of the measured torque below the cut-off, over the runs
that drive the joint, after the first three seconds of each, which give the zeros of the encoders.
Free runs last one second, under the measured torques: the median over windows of the rms error. In
runs that swing the arm up errors grow by ten in a third of a second; they have a column of 0.3 s.
Models: the fit to all other runs; the published one with zeros found in the same way; the published
one as it is.
"""

import itertools
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.cases import dfki  # noqa: E402
from benchmarks.shared.progress import progress  # noqa: E402
from benchmarks.shared.timing import markdown_table, save  # noqa: E402

CUTOFFS = (3.0, 4.0, 5.0, 8.0)
COLUMNS = (
    "design", "cutoff", "model", "R2 shoulder", "R2 elbow", "worst run shoulder",
    "worst run elbow", "free shoulder mrad", "free elbow mrad",
    "up shoulder mrad", "up elbow mrad",
)  # fmt: skip
#: other published files, scored too, at the one cut-off
OTHERS = {"A.0": ("model_1.0", "model_2.1"), "C.1": ("model_1.1", "model_2.0", "model_3.0")}


def pooled(scores: list[dfki.Score]) -> tuple[np.ndarray, np.ndarray]:
    """R2 over all runs, and the worst run's, a joint."""
    left, there = (np.sum([getattr(s, k) for s in scores], 0) for k in ("left", "there"))
    return 1 - left / there, np.nanmin([x for s in scores for x in s.by_run.values()], 0)


def table(design: str, cutoff: float) -> list[dict[str, Any]]:
    old, runs = dfki.published(design), dfki.recordings(design)
    rows = dfki.rows(old.model, runs, cutoff)
    fits = [dfki.fit(old.model, rows[:k] + rows[k + 1 :]) for k in range(len(runs))]
    noise = fits[0].linear.noise
    models: dict[str, Any] = {
        "fitted to the other runs": [(f.model, f.values, True) for f in fits],
        "published, zeros found": [(old.model, old.parameters, True)] * len(runs),
        "published": [(old.model, old.parameters, False)] * len(runs),
    }
    for name in OTHERS[design] if cutoff == dfki.CUTOFF else ():
        other = dfki.published(design, name)
        models[f"{name}, zeros found"] = [(None, other.parameters, True)] * len(runs)
    out = []
    for name, each in models.items():
        scores: list[dfki.Score] = []
        errors: dict[bool, list[np.ndarray]] = {False: [], True: []}
        for run, r, (model, values, zeros) in zip(runs, rows, each, strict=True):
            scores.append(dfki.score(values, [run], [r], noise=noise, zeros=zeros))
            if cutoff == dfki.CUTOFF and model is not None:
                first = r.segment(end=r.t[0] + dfki.FIRST)
                z = first.encoder_zeros(values, noise=noise) if zeros else np.zeros(2)
                up = dfki.swings_up(run)
                off = dfki.free_run(model, run, z, seconds=0.3 if up else 1.0)
                errors[up].append(np.sqrt((off**2).mean(1)))
        R2, worst = pooled(scores)
        free: list[float | None] = [None] * 4
        if errors[True]:
            each_kind = [np.concatenate(errors[up]) for up in (False, True)]
            free = [float(1e3 * x) for e in each_kind for x in np.median(e, 0)]
        values = (design, cutoff, name, *map(float, (*R2, *worst)), *free)
        out.append(dict(zip(COLUMNS, values, strict=True)))
    return out


if __name__ == "__main__":
    if dfki.DATA.exists():
        rows = [
            row
            for d, f in progress(itertools.product(dfki.DESIGNS, CUTOFFS))
            for row in table(d, f)
        ]
        print(markdown_table(rows, COLUMNS))
        save("cpu-double-pendulum-motors", rows)
    else:
        print("the recordings lie beside the repository, and are absent: nothing was measured")
