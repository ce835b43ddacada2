"""The state of a robot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax

from rbjax.arguments import ArrayLike
from rbjax.model.record import Record


class State(Record):
    """The state of a robot.

    q: (nq,) configuration, in MuJoCo's layout.
    v: (nv,) velocity.
    x: (nx,) states of the force elements; None stands for their initial states, or for no states.
    memory: (m,) values that a dynamics keeps between steps (`VelocityDynamics`), or None.
    report: (2,) number of steps whose solver of contacts did not converge, and largest error of a
        step, or None. `rb.step` adds to a report if there is one: begin a loop with zeros.
        `rollout` has its own.
    """

    q: jax.Array
    v: jax.Array
    x: jax.Array | None = None
    memory: jax.Array | None = None
    report: jax.Array | None = None

    if TYPE_CHECKING:  # functions that are given a state convert its arrays

        def __init__(
            self,
            q: ArrayLike,
            v: ArrayLike,
            x: ArrayLike | None = None,
            memory: ArrayLike | None = None,
            report: ArrayLike | None = None,
        ) -> None: ...
