"""A cable of 40 coordinates that swings for 10 s: float32 against float64.

`python -m benchmarks.accuracy.cable_float32` writes results/accuracy-cable-float32-<device>.json:
the largest difference of the tip over the length of the cable at each second, by integrator. The
cable (`benchmarks.cases.beams.cable`) starts straight and level, at rest.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.cases.beams import cable
from benchmarks.shared.timing import markdown_table, save

LENGTH, SECONDS, STEPS = 2.0, 10, {"implicitfast": 5e-4, "variational_midpoint": 1e-3}
COLUMNS = ("integrator", "dt", "after 5 s", "after 10 s", "largest")


def tips(integrator: str, dt: float, dtype: type) -> np.ndarray:
    """Positions (seconds + 1, 3) of the tip at each second, m."""
    model = cable(LENGTH, dtype=dtype)
    each = round(1.0 / dt)
    path = rb.rollout(
        model, model.default_state(), None, dt, steps=SECONDS * each, integrator=integrator,
        save_every=each,
    )  # fmt: skip
    at = [rb.frame_pose(model, q, model.body_names[-1])[1] for q in path.q]
    return np.stack([np.asarray(x, np.float64) for x in at])


def main() -> None:
    rows = []
    with jax.enable_x64(True):
        for integrator, dt in STEPS.items():
            wide, narrow = (tips(integrator, dt, x) for x in (jnp.float64, jnp.float32))
            error = np.abs(wide - narrow).max(-1) / LENGTH
            row = {"integrator": integrator, "dt": dt, "after 5 s": float(error[5])}
            row |= {"after 10 s": float(error[10]), "largest": float(error.max())}
            rows.append(row | {"errors": error.tolist(), "tip": wide[-1].tolist()})
    print(markdown_table(rows, COLUMNS))
    print(save("accuracy-cable-float32", rows))


if __name__ == "__main__":
    main()
