"""Stability of methods: regions over h lambda, and spectral radii over h omega.

`python -m benchmarks.maps.stability_regions` draws docs/benchmarks/figures/stability_regions.png.
Regions are of exact polynomials; the spectral radii are those of one step of each solver's code on
an oscillator.
"""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("JAX_ENABLE_X64", "1")

import diffrax
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.shared.charts import PAGE, save_chart
from rbjax import solvers
from rbjax.plotting import STYLE
from rbjax.stability import plot_regions, plot_spectral_radius

PICTURE = Path(__file__).parents[2] / "docs" / "benchmarks" / "figures" / "stability_regions.png"
EXPLICIT = {
    "Euler": "euler",
    "Heun": "heun",
    "Bosh3": diffrax.Bosh3(),
    "RK4": "rk4",
    "Dopri5": diffrax.Dopri5(),
    "Tsit5": diffrax.Tsit5(),
}
SECOND_ORDER = {
    **{rf"generalized-$\alpha$, $\rho_\infty$ = {r}": solvers.generalized_alpha(r)
       for r in (0.0, 0.5, 0.8, 0.9, 1.0)},
    "central differences": "central_differences",
}  # fmt: skip


def main() -> None:
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2, 2, figsize=(PAGE, 8), layout="constrained")
        plot_regions(EXPLICIT, (-5.5, 1.5, -4.2, 4.2), ax=axes[0, 0])
        axes[0, 0].set_title("Runge-Kutta: stable inside")
        adams = {f"order {k}": f"adams_bashforth{k}" for k in range(1, 6)}
        plot_regions(adams, (-2.3, 0.5, -1.5, 1.5), ax=axes[0, 1])
        axes[0, 1].set_title("Adams-Bashforth: stable inside")
        bdf = {f"order {k}": f"bdf{k}" for k in range(1, 7)}
        plot_regions(bdf, (-8.0, 30.0, -19.0, 19.0), ax=axes[1, 0])
        axes[1, 0].legend(ncols=2, loc="upper right")
        axes[1, 0].set_title("BDF: stable outside")
        plot_spectral_radius(SECOND_ORDER, np.logspace(-1.5, 3, 300), ax=axes[1, 1])
        axes[1, 1].set_title("Second order, measured on steps")
        save_chart(figure, PICTURE)
    print(PICTURE)


if __name__ == "__main__":
    main()
