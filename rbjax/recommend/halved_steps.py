"""Trial runs of candidates, with steps that are halved until they are accurate enough."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax

from rbjax.compiling import compiler_options
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.progress import Say
from rbjax.recommend.recommendation import fastest

#: a motion has converged if halving its step changes it by less than this fraction of the accuracy
AGREE = 1 / 8
#: the least duration of a measurement of time, s
SECONDS = 0.05


class Trial(NamedTuple):
    """A candidate with the largest of its steps that is accurate enough."""

    name: str  # of the candidate
    dt: float  # the step, s
    error: float  # the largest deviation of the motion from the reference
    #: the largest residual of a constraint or of its rate (`formulation`), or the deviation of the
    #: converged motion from the converged motion of the next finer fidelity (`fidelity`)
    gap: float
    step_us: float  # the computing time of a step, microseconds
    success: bool  # whether error and gap are as requested

    @property
    def cost(self) -> float:
        """The computing time per second of motion, microseconds."""
        return self.step_us / self.dt


class HalvedSteps(abc.ABC):
    """Trial runs of named candidates, with the step dt / 2^k after k halvings."""

    #: the largest number of steps; the advice if a motion does not converge; its duration, s
    most_steps: int
    cure: str
    seconds: float

    def __init__(self, dt: float, accuracy: float, say: Say):
        self.accuracy, self.say, self._dt = accuracy, say, dt
        self._programs: dict[str, Callable[..., State]] = {}
        self._paths: dict[tuple[str, int], State] = {}

    @abc.abstractmethod
    def steps(self, k: int) -> int:
        """Return the number of steps after k halvings."""

    @abc.abstractmethod
    def motion(self, name: str) -> Callable[..., State]:
        """Return the motion of a candidate as a function of `arguments`, for `jax.jit`."""

    @abc.abstractmethod
    def arguments(self, k: int) -> tuple:
        """Return the arguments of `motion` after k halvings."""

    @abc.abstractmethod
    def deviation(self, a: State, b: State) -> float:
        """Return the largest deviation between two motions; infinite if one is not finite."""

    def dt(self, k: int) -> float:
        """Return the step after k halvings, s."""
        return self._dt / 2**k

    def compiled(self, name: str) -> Callable[..., State]:
        """Compile the motion of a candidate, as one program for all steps."""
        if name not in self._programs:
            options = compiler_options()
            self._programs[name] = jax.jit(self.motion(name), compiler_options=options)
        return self._programs[name]

    def run(self, name: str, k: int) -> State:
        """Run a candidate with k halvings. Return its states."""
        return jax.block_until_ready(self.compiled(name)(*self.arguments(k)))

    def path(self, name: str, k: int) -> State:
        """Return the states of a candidate with k halvings, from a cache if they were computed
        before."""
        if (name, k) not in self._paths:
            self.say(f"{name} with steps of {self.dt(k):.2g} s")
            self._paths[name, k] = self.run(name, k)
        return self._paths[name, k]

    def step_us(self, name: str, k: int) -> float:
        """Measure the computing time of a step in the fastest run, microseconds."""
        return 1e6 * fastest(lambda: self.run(name, k), SECONDS) / self.steps(k)

    def converge(self, name: str, k: int = 0) -> int:
        """Halve the step until the motion has converged. Return the number of halvings.

        k: number of halvings at the start.

        Raises:
            InputError: the motion does not converge with the largest number of steps.
        """
        while self.steps(k + 1) <= self.most_steps:
            k += 1
            change = self.deviation(self.path(name, k - 1), self.path(name, k))
            if change < AGREE * self.accuracy:
                return k
        raise InputError(
            f"recommend: the motion by {name!r} over {self.seconds:.3g} s does not converge to "
            f"{self.accuracy:.1e} with steps down to {self.dt(k):.1e} s; {self.cure}"
        )

    def trial(
        self,
        name: str,
        halvings: Iterable[int],
        measure: Callable[[State], tuple[float, float, bool]],
    ) -> Trial:
        """Measure a candidate with the largest accurate step, or with the smallest step if none is
        accurate.

        measure: motion -> error, gap, and whether they are as requested.
        """
        dt = error = gap = math.nan
        for k in halvings:
            if not math.isnan(dt) and self.steps(k) > self.most_steps:
                break
            dt, (error, gap, ok) = self.dt(k), measure(self.path(name, k))
            if ok:
                return Trial(name, dt, error, gap, self.step_us(name, k), True)
        return Trial(name, dt, error, gap, math.inf, False)


def cost_decides(best: Any, trials: Iterable[Trial]) -> str:
    """Explain the choice by the costs of the best and the next candidate; empty if there is no
    other."""
    others = [x for x in trials if x is not best and x.success]
    if not others:
        return ""
    other = min(others, key=lambda x: x.cost)
    return f"cost decides: {other.name} would take {other.cost:.2g} us per second of motion"
