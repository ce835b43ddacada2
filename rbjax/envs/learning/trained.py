"""The result of a training, and the figures that it reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from rbjax.model.record import Record

#: function (steps of the environment so far, name -> number, policy)
Report = Callable[[int, dict[str, float], Any], None]


def no_report(steps: int, figures: dict[str, float], policy: Any) -> None:
    """Report nothing."""


class Trained(Record):
    """The result of a training.

    policy: the trained `Policy`.
    critic: the `Critic`; None if the training has none.
    rewards: of SHAC and `through_time` the mean reward of a step over batch and horizon,
        (iterations,); of PPO the returns of the evaluations, (reports + 1,).
    skipped: number of updates skipped because their gradients were not finite, ().
    """

    policy: Any
    critic: Any
    rewards: Any
    skipped: jax.Array


def summary_of(figures: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the figures of a chunk of iterations as one row.

    "reward": mean return of the whole episodes that ended; NaN if none did. "length": their mean
    length in steps. "episodes": their number. "step_reward": mean reward of a step. "failed":
    number of steps, of all samples and iterations, that ended in a state that is not finite.
    """
    count = float(figures["episodes"].sum())
    mean = (lambda x: float(x.sum()) / count) if count else (lambda x: float("nan"))
    return {
        "reward": mean(figures["return"]),
        "length": mean(figures["length"]),
        "episodes": count,
        "step_reward": float(figures["reward"].mean()),
        "failed": float(figures["failed"].sum()),
    }
