"""Charts of trajectories: coordinates over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rbjax.arguments import real_array
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting.arguments import coordinates
from rbjax.style import axes_of, legend


def time_plot(ts: Any, q: Any, v: Any = None, *, names: Sequence[str] = (), ax: Any = None) -> Any:
    """Draw configuration and velocity coordinates over time, on two axes.

    Args:
        ts: (T,), s.
        q: (T, nq), in m, rad, or quaternion components; or states, such as a `Trajectory`.
        v: (T, nv), in m/s, rad/s; None for those of the states q.
        names: names of the first coordinates, for a legend.
        ax: two axes, for q and for v; None makes a figure.

    Returns:
        The two axes.

    Raises:
        InputError: q or v without a row for each time; not two axes.

    Example:
        >>> import matplotlib.figure, numpy as np
        >>> from rbjax.plotting import time_plot
        >>> axes = matplotlib.figure.Figure().subplots(2)
        >>> q, v = np.zeros((3, 2)), np.zeros((3, 2))
        >>> len(time_plot(np.arange(3.0), q, v, names=["hip", "knee"], ax=axes)[0].lines)
        2
    """
    axes = axes_of("time_plot", ax, 2)
    ts = real_array("time_plot", "ts", ts, ndim=1)
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise InputError(f"time_plot: names is {names!r}, expected a sequence of names")
    if v is None and isinstance(q, State | Trajectory):
        v = q.v
    for one, name, given, label in (
        (axes[0], "q", coordinates(q), "q  [m, rad, -]"), (axes[1], "v", v, "v  [m/s, rad/s]")
    ):  # fmt: skip
        x = real_array("time_plot", name, given, finite=False)  # gaps are nan
        if x.ndim != 2 or len(x) != len(ts):
            raise InputError(
                f"time_plot: {name} has shape {x.shape}, expected ({len(ts)}, n), a row for each "
                "of ts"
            )
        for i in range(x.shape[-1]):
            one.plot(ts, x[:, i], lw=1.4, label=names[i] if i < len(names) else None)
        one.set(xlabel="time [s]", ylabel=label)
    if names:
        legend(axes[0], ncols=2)
    return axes
