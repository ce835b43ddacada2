"""Plots of the linear theory, on an axis of the caller or in a new figure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from rbjax.arguments import integer, real_array, shown
from rbjax.errors import InputError
from rbjax.stability.theory.multistep_roots import Method, characteristic
from rbjax.stability.theory.oscillator import spectral_radius
from rbjax.stability.theory.regions import stability_region
from rbjax.style import axes_of, legend

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Window = tuple[float, float, float, float]


def plot_regions(
    methods: Mapping[str, Method],
    window: Window = (-5.0, 1.0, -4.0, 4.0),
    *,
    points: int = 401,
    ax: Axes | None = None,
) -> Axes:
    """Plot regions of absolute stability in the plane of z = h lambda, as filled outlines.

    Args:
        methods: label -> solver, name, tableau or polynomial, as for `characteristic`.
        window: (left, right, bottom, top) in the plane of z.
        points: number of grid points in each direction.
        ax: the axis to draw on, whose colour cycle is used; None makes a figure.

    Returns:
        The axis.

    Raises:
        InputError: a solver without linear theory, or a window without width.

    Example:
        >>> import rbjax as rb, matplotlib.figure
        >>> ax = matplotlib.figure.Figure().add_subplot()
        >>> ax = rb.stability.plot_regions({"RK4": "rk4"}, points=21, ax=ax)
        >>> ax.get_legend().get_texts()[0].get_text()
        'RK4'
    """
    _check_methods("plot_regions", methods)
    integer("plot_regions", "points", points, least=2)
    found = real_array("plot_regions", "window", window, "(left, right, bottom, top)", ndim=1)
    left, right, bottom, top = found if len(found) == 4 else (0.0, 0.0, 0.0, 0.0)
    if not (left < right and bottom < top):
        raise InputError(f"plot_regions: window is {window}, expected (left, right, bottom, top)")
    ax = axes_of("plot_regions", ax)
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
    legend(ax)
    return ax


def _check_methods(where: str, methods: Mapping[str, Method]) -> None:
    if not isinstance(methods, Mapping):
        raise InputError(
            f"{where}: methods is {shown(methods)}, expected a dict of labels and methods, such "
            "as {'RK4': 'rk4'}"
        )


def plot_spectral_radius(
    methods: Mapping[str, Method], h_omega: np.ndarray, *, ax: Axes | None = None
) -> Axes:
    """Plot spectral radii over h omega, measured on one step of each solver's code.

    Args:
        methods: label -> solver, as for `spectral_radius`.
        h_omega: (n,) step times frequency, rad; positive, increasing.
        ax: the axis to draw on; None makes a figure.

    Returns:
        The axis.

    Raises:
        InputError: a solver that `spectral_radius` rejects.

    Example:
        >>> import rbjax as rb, numpy as np, matplotlib.figure
        >>> ax = matplotlib.figure.Figure().add_subplot()
        >>> methods = {"Verlet": "stoermer_verlet"}
        >>> ax = rb.stability.plot_spectral_radius(methods, np.array([1.0]), ax=ax)
        >>> float(ax.lines[0].get_ydata()[0].round(6))
        1.0
    """
    _check_methods("plot_spectral_radius", methods)
    h_omega = real_array("plot_spectral_radius", "h_omega", h_omega, ndim=1)
    ax = axes_of("plot_spectral_radius", ax)
    for label, solver in methods.items():
        ax.semilogx(h_omega, spectral_radius(solver, h_omega), label=label)
    ax.set(xlabel=r"$h\omega$", ylabel=r"spectral radius $\rho$", ylim=(0, 1.1))
    legend(ax)
    return ax
