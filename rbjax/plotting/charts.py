"""Charts of trajectories: coordinates over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rbjax.arguments import real_array
from rbjax.errors import InputError
from rbjax.plotting.arguments import check_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def time_plot(axes: Sequence[Axes], ts: Any, q: Any, v: Any, names: Sequence[str] = ()) -> None:
    """Draw configuration and velocity coordinates over time, on two axes.

    Args:
        axes: two axes, for q and for v.
        ts: (T,), s.
        q: (T, nq), in m, rad, or quaternion components.
        v: (T, nv), in m/s, rad/s.
        names: names of the first coordinates, for a legend.

    Example:
        >>> import matplotlib.figure, numpy as np
        >>> from rbjax.plotting import time_plot
        >>> axes = matplotlib.figure.Figure().subplots(2)
        >>> time_plot(axes, np.arange(3.0), np.zeros((3, 2)), np.zeros((3, 2)), ["hip", "knee"])
        >>> len(axes[0].lines)
        2
    """
    several = isinstance(axes, (list, tuple, np.ndarray))
    if not several or len(axes) < 2:
        raise InputError(f"time_plot: axes is {type(axes).__name__}, expected two axes")
    for ax in axes[:2]:
        check_axis("time_plot", ax, "axes")
    ts = real_array("time_plot", "ts", ts, ndim=1)
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise InputError(f"time_plot: names is {names!r}, expected a sequence of names")
    for ax, name, given, label in (
        (axes[0], "q", q, "q  [m, rad, -]"), (axes[1], "v", v, "v  [m/s, rad/s]")
    ):  # fmt: skip
        x = real_array("time_plot", name, given, finite=False)  # gaps are nan
        if x.ndim != 2 or len(x) != len(ts):
            raise InputError(
                f"time_plot: {name} has shape {x.shape}, expected ({len(ts)}, n), a row for each "
                "of ts"
            )
        for i in range(np.shape(x)[-1]):
            ax.plot(ts, x[:, i], lw=1.4, label=names[i] if i < len(names) else None)
        ax.set(xlabel="time [s]", ylabel=label)
