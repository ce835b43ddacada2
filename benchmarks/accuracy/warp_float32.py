"""Forward dynamics of MuJoCo Warp (f32) against MuJoCo C in f64, model by model.

    pip install mujoco-warp==4.0.0
    python -m benchmarks.accuracy.warp_float32

States and models are those of `accuracy.against_mujoco_gpu`, up to 40 velocities. MuJoCo Warp runs
on a CPU and on a GPU.
"""

from __future__ import annotations

from typing import Any

import mujoco_warp as mjw
import numpy as np

from benchmarks.accuracy.against_mujoco_gpu import COUNT, plain, reference
from benchmarks.cases.models import MODELS, SINGULAR
from benchmarks.shared.progress import progress
from benchmarks.shared.robots import relative
from benchmarks.shared.timing import markdown_table, save
from benchmarks.shared.warp_states import assign


def errors(name: str) -> dict[str, Any] | None:
    """One model's row; None for a model without or with too many velocities."""
    m = plain(name)
    if not 0 < m.nv <= 40:
        return None
    row = {"model": name, "nv": m.nv}
    given, want = reference(m)
    try:
        model, data = mjw.put_model(m), mjw.make_data(m, nworld=COUNT)
        assign(data, *given)
        mjw.forward(model, data)
        error = relative(data.qacc.numpy(), want)
    except Exception as refused:  # some models have features that it lacks
        return row | {"note": f"{type(refused).__name__}: {str(refused)[:80]}"}
    return row | {"median": float(np.median(error)), "max": float(error.max())}


def main() -> None:
    found = (errors(name) for name in progress([name for name in MODELS if name not in SINGULAR]))
    rows = [row for row in found if row]
    rows.sort(key=lambda row: -row.get("median", np.inf))
    print(markdown_table(rows, ("model", "nv", "median", "max", "note")))
    print(save("accuracy-warp", rows))


if __name__ == "__main__":
    main()
