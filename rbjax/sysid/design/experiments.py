"""`design_experiment`: optimal excitation within the limits of the robot.

    min over the coefficients of  loss(F),   F = F_known + J^T J,   subject to  g(q, v, a) <= 0
J (rows, n) are the derivatives of the measurements by the n unknowns, divided by the noise: a
regressor, or the Jacobian of a simulated motion. F_known is the information of earlier experiments.
The losses are
    D   -log det F / n        the volume of the confidence ellipsoid; independent of units
    A   log trace F^-1        the mean variance
    E   -log lambda_min(F)    the variance in the worst direction
    condition   log sqrt(lambda_max / lambda_min), the condition number of J
An augmented Lagrangian with BFGS enforces the limits at sampled times. The result is checked at ten
times as many samples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import cho_solve

from rbjax.arguments import choice, instance, integer, real_array
from rbjax.display import displayed
from rbjax.dynamics import inverse_dynamics
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.progress import progress_line
from rbjax.sysid.design.excitation import Fourier, Spline

FINE = 10  # number of samples of the check for each sample of the optimisation
MARGIN = 1e-3  # safety margin relative to a limit, for the tolerance of the augmented Lagrangian
GROWTH = 4.0  # growth factor of the penalty if violations do not decrease fast enough


def _d(F: jax.Array) -> jax.Array:
    return -jnp.linalg.slogdet(F)[1] / len(F)


def _a(F: jax.Array) -> jax.Array:
    L = jnp.linalg.cholesky(F)
    return jnp.log(jnp.trace(cho_solve((L, True), jnp.eye(len(F), dtype=F.dtype))))


def _e(F: jax.Array) -> jax.Array:
    return -jnp.log(jnp.linalg.eigvalsh(F)[0])


def _condition(F: jax.Array) -> jax.Array:
    values = jnp.linalg.eigvalsh(F)
    return 0.5 * jnp.log(values[-1] / values[0])


#: criterion -> loss as a function of the information matrix (n, n)
CRITERIA: dict[str, Callable[[jax.Array], jax.Array]] = {
    "D": _d, "A": _a, "E": _e, "condition": _condition,
}  # fmt: skip


@displayed
class MotionLimits(eqx.Module):
    """Limits of a trajectory.

    Each limit is one number for all joints, or one number for each joint.

    Args:
        low: lower position limits in rad or m; requires `high`.
        high: upper position limits in rad or m, above `low`.
        speed: largest absolute velocity in rad/s or m/s.
        acceleration: largest absolute acceleration in rad/s^2 or m/s^2.
        torque: largest absolute torque in N m or N; requires `model`.
        model: model for the torque by inverse dynamics.
        own: function g(q, v, a) of one sample, (nv,) each, which returns an array of order one. The
            constraint is g <= 0.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid.design import MotionLimits
        >>> limits = MotionLimits(speed=2.0)
        >>> q = jnp.zeros((1, 1))
        >>> limits(q, q + 3.0, q)["speed"].tolist()
        [[0.5]]
    """

    low: Any = None
    high: Any = None
    speed: Any = None
    acceleration: Any = None
    torque: Any = None
    model: Model | None = None
    own: Callable[..., jax.Array] | None = eqx.field(default=None, static=True)

    def __check_init__(self) -> None:
        if (self.low is None) != (self.high is None):
            raise InputError("MotionLimits: only one of low and high is given, expected both")
        if (self.torque is None) != (self.model is None):
            raise InputError("MotionLimits: only one of torque and model is given, expected both")
        for name in ("low", "high", "speed", "acceleration", "torque"):
            if getattr(self, name) is not None:
                real_array("MotionLimits", name, getattr(self, name), "numbers, or None")
        instance("MotionLimits", "model", self.model, Model | None, "a Model (rbjax.load)")
        instance("MotionLimits", "own", self.own, Callable | None, "a function of q, v, a")
        span = () if self.low is None else np.asarray(self.high) - np.asarray(self.low)
        for name, x in (("high - low", span), ("speed", self.speed), ("torque", self.torque),
                        ("acceleration", self.acceleration)):  # fmt: skip
            if x is not None and not (np.asarray(x) > 0).all():
                raise InputError(f"MotionLimits: {name} is {x}, expected positive numbers")

    def __call__(self, q: jax.Array, v: jax.Array, a: jax.Array) -> dict[str, jax.Array]:
        """Evaluate the constraints g <= 0 by name. A value of 0.1 is 10 % beyond the limit."""
        out = {}
        if self.low is not None:
            low, span = jnp.asarray(self.low), jnp.asarray(self.high) - jnp.asarray(self.low)
            out["position"] = jnp.abs((q - low) / span - 0.5) - 0.5
        if self.speed is not None:
            out["speed"] = jnp.abs(v) / jnp.asarray(self.speed) - 1
        if self.acceleration is not None:
            out["acceleration"] = jnp.abs(a) / jnp.asarray(self.acceleration) - 1
        if (model := self.model) is not None:
            tau = jax.vmap(lambda *x: inverse_dynamics(model, *x))(q, v, a)
            out["torque"] = jnp.abs(tau) / jnp.asarray(self.torque) - 1
        if self.own is not None:
            out["own"] = jax.vmap(self.own)(q, v, a)
        return out


@displayed
@dataclass(frozen=True, eq=False)
class Experiment:
    """The result of `design_experiment`.

    Fields:
        motion: the optimal trajectory.
        criterion: name of the criterion.
        value: loss of `motion`.
        start_value: loss of the start.
        information: (n, n) information of `motion` and of the earlier experiments.
        worst: limit -> its largest violation g at the points of the finer grid.
        times: number of points of the finer grid.
    """

    motion: Any
    criterion: str
    value: float
    start_value: float
    information: np.ndarray
    worst: Mapping[str, float]
    times: int

    @property
    def success(self) -> bool:
        """Whether the trajectory is within all limits."""
        return all(w <= 0 for w in self.worst.values())

    def summary(self) -> str:
        """Return a sentence with the change of the loss and the violated limits."""
        text = f"the {self.criterion} criterion goes from {self.start_value:.4g} to "
        text += f"{self.value:.4g}; "
        if self.success:
            return text + f"all limits hold at {self.times} times"
        broken = [f"{n} by {100 * w:.2g} %" for n, w in self.worst.items() if w > 0]
        return text + "limits are broken: " + ", ".join(broken)


def design_experiment(
    start: Fourier | Spline,
    information: Callable[..., jax.Array],
    limits: MotionLimits | None = None,
    *,
    criterion: str = "D",
    known: Any = None,
    samples: int = 100,
    rounds: int = 8,
    steps: int = 60,
    progress: bool = True,
) -> Experiment:
    """Design the trajectory with the most information on the unknowns, within limits.

    Args:
        start: initial trajectory, such as `Fourier.random(...)`, with information of full rank.
        information: function of (q, v, a), (samples, n) each, that returns J (rows, unknowns). It
            is written with jax.numpy. Divide rows by their noise, and scale columns to unknowns of
            order one.
        limits: `MotionLimits`, or None for no limits.
        criterion: "D", "A", "E" or "condition".
        known: (unknowns, unknowns) information of earlier experiments.
        samples: number of times of the optimisation.
        rounds: number of rounds of the augmented Lagrangian; doubled if no round satisfies all
            limits.
        steps: number of BFGS steps in a round.
        progress: show a progress line on a terminal.

    Returns:
        `Experiment`, the best trajectory within all limits. If the start violates the limits,
        `success` may be False.

    Raises:
        InputError: a start without full rank, or wrong shapes.
        UnknownName: an unknown criterion.

    Source: Swevers et al. 1997; Pukelsheim, *Optimal Design of Experiments*, 6; Nocedal & Wright,
        *Numerical Optimization*, 17.4.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from rbjax.sysid.design import Fourier, MotionLimits, design_experiment
        >>> def spring_and_mass(q, v, a):
        ...     return jnp.concatenate([q, a], 1)  # tau = k q + m a
        >>> start = Fourier.random(jax.random.key(0), jnp.zeros(1), 2, period=6.0)
        >>> limits = MotionLimits(speed=1.0)
        >>> found = design_experiment(start, spring_and_mass, limits, rounds=3, steps=20)
        >>> found.success, found.value < found.start_value
        (True, True)
    """
    choice("criterion", criterion, CRITERIA)
    for name, number in (("samples", samples), ("rounds", rounds), ("steps", steps)):
        integer("design_experiment", name, number, least=1)
    where = "design_experiment"
    instance(where, "start", start, (Fourier, Spline), "a motion: Fourier or Spline")
    fix = "a function (q, v, a) -> J (rows, unknowns)"
    instance(where, "information", information, Callable, fix)
    limits = MotionLimits() if limits is None else limits
    instance(where, "limits", limits, MotionLimits, "MotionLimits")
    _check_joints(start, limits)
    times, fine = _times(start, samples), _times(start, FINE * samples)
    flat: jax.Array
    flat, unravel = ravel_pytree(start)
    before = _start_information(start, information, times, known)
    F0 = 0.0 if known is None else jnp.asarray(known)
    loss = CRITERIA[criterion]

    def information_of(x: jax.Array) -> jax.Array:
        J = information(*unravel(x)(times))
        return F0 + J.T @ J

    def violations(x: jax.Array) -> jax.Array:
        g = [jnp.ravel(y) for y in limits(*unravel(x)(times)).values()]
        return jnp.concatenate(g) if g else jnp.full(1, -1.0, x.dtype)

    def lagrangian(x: jax.Array, args: Any) -> jax.Array:
        multipliers, penalty, margin = args
        push = jnp.maximum(multipliers + penalty * (violations(x) + margin), 0)
        return loss(information_of(x)) + jnp.sum(push**2 - multipliers**2) / (2 * penalty)

    @jax.jit
    def improve(x: jax.Array, args: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        solver: Any = optx.BFGS(rtol=1e-6, atol=1e-8)
        found: Any = optx.minimise(lagrangian, solver, x, args, max_steps=steps, throw=False)
        good = jnp.isfinite(lagrangian(found.value, args)) & jnp.isfinite(found.value).all()
        x = jnp.where(good, found.value, x)
        return x, violations(x), loss(information_of(x))

    @jax.jit
    def worst_of(x: jax.Array) -> dict[str, jax.Array]:
        return {name: g.max() for name, g in limits(*unravel(x)(fine)).items()}

    def excess_of(x: jax.Array) -> float:
        return max([float(w) for w in worst_of(x).values()], default=-1.0)

    multipliers = jnp.zeros(jax.eval_shape(violations, flat).shape, flat.dtype)
    x: jax.Array = flat
    penalty, margin, last = 10.0, MARGIN, np.inf
    best = (float(loss(jnp.asarray(before))), flat) if excess_of(flat) <= 0 else None
    with progress_line("design_experiment", progress) as say:
        for k in range(2 * rounds):
            if k >= rounds and best is not None:
                break
            say(f"{criterion} criterion, round {k + 1} of {rounds}")
            x, g, value = improve(x, (multipliers, penalty, margin))
            excess = excess_of(x)
            held = x if excess <= 0 else None
            if held is None and best is not None:
                held = _last_within(best[1], x, excess_of)
                value = loss(information_of(held))
            if held is not None and (best is None or float(value) < best[0]):
                best = float(value), held
            multipliers = jnp.maximum(multipliers + penalty * (g + margin), 0)
            beyond = float(jnp.maximum(g + margin, 0).max())
            penalty *= GROWTH if beyond > 0.25 * last else 1.0
            margin = max(margin, MARGIN + excess - float(g.max()))  # if violated between samples
            last = beyond
    if best is not None:
        x = best[1]
    worst = {name: float(w) for name, w in worst_of(x).items()}
    after = information_of(x)
    value, start_value = float(loss(after)), float(loss(jnp.asarray(before)))
    return Experiment(
        unravel(x), criterion, value, start_value, np.asarray(after), worst, len(fine)
    )


def _check_joints(start: Fourier | Spline, limits: MotionLimits) -> None:
    """Raise InputError unless each limit is one number, or one number for each joint."""
    joints = len(start.q0 if isinstance(start, Fourier) else start.points)
    for name in ("low", "high", "speed", "acceleration", "torque"):
        shape = np.shape(getattr(limits, name)) if getattr(limits, name) is not None else ()
        if shape not in ((), (1,), (joints,)):
            raise InputError(
                f"design_experiment: limit {name} has shape {shape}, expected one number, or "
                f"{joints}, one "
                "for each joint of the motion"
            )


def _last_within(
    inside: jax.Array, outside: jax.Array, excess_of: Callable[[jax.Array], float]
) -> jax.Array:
    """Find the last point within all limits between `inside` and `outside`, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(10):
        mid = 0.5 * (low + high)
        within = excess_of(inside + mid * (outside - inside)) <= 0
        low, high = (mid, high) if within else (low, mid)
    return inside + low * (outside - inside)


def _times(motion: Fourier | Spline, samples: int) -> jax.Array:
    """Return sample times over one period without its end (Fourier) or the duration (Spline)."""
    last = not isinstance(motion, Fourier)
    return jnp.asarray(np.linspace(0, motion.duration, samples, endpoint=last), float)


def _start_information(
    start: Fourier | Spline, information: Callable, times: jax.Array, known: Any
) -> np.ndarray:
    J = np.asarray(information(*start(times)), float)
    if J.ndim != 2 or not np.isfinite(J).all():
        raise InputError(
            f"design_experiment: information gave an array of shape {J.shape}"
            f"{'' if np.isfinite(J).all() else ' with numbers that are not finite'}, expected "
            "finite (rows, unknowns)"
        )
    n = J.shape[1]
    F = J.T @ J
    if known is not None:
        if np.shape(known) != (n, n):
            raise InputError(
                f"design_experiment: known has shape {np.shape(known)}, expected {(n, n)}"
            )
        F = F + np.asarray(known, float)
    lengths = np.sqrt(np.maximum(np.diag(F), np.finfo(float).tiny))
    rank = int(np.linalg.matrix_rank(F / np.outer(lengths, lengths), hermitian=True))
    if rank < n:
        raise InputError(
            f"design_experiment: the start identifies {rank} combinations of {n} unknowns, "
            "expected all of them: start from a random motion, take base parameters as unknowns, "
            "or give `known` information"
        )
    return F
