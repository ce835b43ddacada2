"""Pictures of linear theory, on the caller's axes of matplotlib.

`rbjax.plotting.STYLE` is the style of rbjax: `with plt.rc_context(STYLE): ...`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from rbjax.errors import InputError
from rbjax.stability.theory.multistep_roots import Method, characteristic
from rbjax.stability.theory.oscillator import spectral_radius
from rbjax.stability.theory.regions import stability_region

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Window = tuple[float, float, float, float]


def plot_regions(
    ax: Axes,
    methods: Mapping[str, Method],
    window: Window = (-5.0, 1.0, -4.0, 4.0),
    points: int = 401,
) -> None:
    """Draw regions of absolute stability over z = h lambda, as outlines on a light ground.

    Args:
        ax: axes of matplotlib; its colour cycle is used.
        methods: label -> a solver, its name, a tableau or a polynomial, as for `characteristic`.
        window: (left, right, bottom, top) in the plane of z.
        points: of the grid, in each direction.

    Raises:
        InputError: solvers without linear theory, or a window without width.

    Example:
        >>> import rbjax as rb, matplotlib.figure
        >>> ax = matplotlib.figure.Figure().add_subplot()
        >>> rb.stability.plot_regions(ax, {"RK4": "rk4"}, points=21)
        >>> ax.get_legend().get_texts()[0].get_text()
        'RK4'
    """
    left, right, bottom, top = window
    if not (left < right and bottom < top):
        raise InputError(f"plot_regions: window is {window}, expected (left, right, bottom, top)")
    x, y = np.linspace(left, right, points), np.linspace(bottom, top, points)
    ax.axhline(0, color="0.6", lw=0.8, zorder=1)
    ax.axvline(0, color="0.6", lw=0.8, zorder=1)
    for label, method in methods.items():
        grown = np.minimum(stability_region(characteristic(method), x, y) - 1 - 1e-9, 1.0)
        (line,) = ax.plot([], [], label=label)
        color = line.get_color()
        ax.contourf(x, y, grown, [-2.0, 0.0], colors=[color], alpha=0.08)
        ax.contour(x, y, grown, [0.0], colors=[color], linewidths=1.5)
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal",
           xlabel=r"Re $h\lambda$", ylabel=r"Im $h\lambda$")  # fmt: skip
    ax.legend()


def plot_spectral_radius(ax: Axes, methods: Mapping[str, Method], h_omega: np.ndarray) -> None:
    """Draw spectral radii over h omega, measured on one step of each solver's code.

    Args:
        ax: axes of matplotlib.
        methods: label -> solver, as for `spectral_radius`.
        h_omega: (n,) positive, increasing.

    Raises:
        InputError: solvers of other equations.

    Example:
        >>> import rbjax as rb, numpy as np, matplotlib.figure
        >>> ax = matplotlib.figure.Figure().add_subplot()
        >>> rb.stability.plot_spectral_radius(ax, {"Verlet": "stoermer_verlet"}, np.array([1.0]))
        >>> float(ax.lines[0].get_ydata()[0].round(6))
        1.0
    """
    for label, solver in methods.items():
        ax.semilogx(h_omega, spectral_radius(solver, h_omega), label=label)
    ax.set(xlabel=r"$h\omega$", ylabel=r"spectral radius $\rho$", ylim=(0, 1.1))
    ax.legend()
