"""A model predictive controller for real time, with a record of the durations of its calls.

A control loop with period h requires that the longest call, not the average call, is shorter than h
(Liu, *Real-Time Systems*, 2000, 3.2: jitter).
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance
from rbjax.compiling import compiler_options
from rbjax.control.optimal.receding_horizon import PredictiveController
from rbjax.control.optimal.ticks import PLANNED
from rbjax.display import displayed
from rbjax.errors import InputError


@displayed
class Timing(NamedTuple):
    """Statistics of the durations of calls.

    calls: number of calls.
    median, p99, worst: median, 99 % quantile and maximum, ms.
    late: number of calls longer than a tick.
    """

    calls: int
    median: float
    p99: float
    worst: float
    late: int


class RealTime:
    """A `PredictiveController` as a stateful callable (t, state) -> ctrl.

    Args:
        controller: from `rb.control.mpc`.
        state: the first state, from which the first plan is computed.
        ctrl: a first guess of the controls.

    The constructor compiles all programs, so that the first call is as fast as later ones. `status`
    is the `TickStatus` of the last control. `search_status` is the `Status` of the last search.

    Raises:
        InputError: not a controller.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> C = rb.control
        >>> cart = C.Equations(lambda t, x, u: jnp.stack([x[1], u[0]]), 2, 1)
        >>> problem = C.Problem(cart, 10, 0.1, running=[lambda t, x, u: x, C.Control()])
        >>> act = C.RealTime(C.mpc(problem), jnp.array([1.0, 0.0]))
        >>> act(0.0, jnp.array([1.0, 0.0])).shape, act.timing().calls
        ((1,), 1)
    """

    def __init__(self, controller: PredictiveController, state: Any, ctrl: Any = None) -> None:
        expected = "what rb.control.mpc returns"
        instance("RealTime", "controller", controller, PredictiveController, expected)
        self.controller = controller
        x = controller.problem.system.checked("RealTime", state)
        options = compiler_options()
        begin = jax.jit(controller.begin, compiler_options=options)
        self.memory = jax.block_until_ready(begin(x, ctrl))
        zero = jnp.zeros((), controller.dt.dtype)
        tick = jax.jit(controller.tick, compiler_options=options)
        self._tick = tick.lower(self.memory, zero, x).compile()
        jax.block_until_ready(self._tick(self.memory, zero, x))
        self._ns: list[int] = []
        self.status, self.search_status = PLANNED, int(self.memory.search_status)

    def __call__(self, t: float, state: Any) -> np.ndarray:
        """Return the control (nu,) of the tick that begins at t."""
        begin = time.perf_counter_ns()
        like = self.controller.dt.dtype
        x = jax.tree.map(lambda a: np.asarray(a, like), state)
        u, self.memory, status = self._tick(self.memory, np.asarray(t, like), x)
        u = np.asarray(u)
        self._ns.append(time.perf_counter_ns() - begin)
        self.status, self.search_status = int(status), int(self.memory.search_status)
        return u

    def timing(self) -> Timing:
        """Return statistics of the durations of the calls."""
        if not self._ns:
            raise InputError("timing: there was no call yet")
        ms = np.asarray(self._ns) / 1e6
        late = int((ms > 1e3 * float(self.controller.dt)).sum())
        return Timing(len(ms), float(np.median(ms)), float(np.quantile(ms, 0.99)), float(ms.max()),
                      late)  # fmt: skip
