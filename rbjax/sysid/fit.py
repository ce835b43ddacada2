"""`fit`: numbers of a model from measured configurations, by nonlinear least squares.

    min over theta of  sum_k |q_k (-) q(t_k; theta)|^2,   q(t; theta) a `rollout`
Levenberg-Marquardt on Jacobians by forward mode through the rollout. Positive numbers are sought by
their logarithm. Standard errors are those of the linearised problem: s^2 (J^T J)^-1 with s^2 the
mean square residual. They say how far noise moves the answer, not how wrong the model is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from rbjax.dynamics import difference
from rbjax.errors import InputError, UnknownName
from rbjax.model import Model, State
from rbjax.rollout import rollout


@dataclass(frozen=True)
class Unknown:
    """One number of a model: a leaf by its dotted name ("bodies.mass") and an index into it."""

    leaf: str
    index: int | tuple[int, ...]
    positive: bool = False


@dataclass(frozen=True)
class Fit:
    """What came out: the model with its new numbers, each with a standard error.

    Fields: model; values and errors by name; rms of the residual in units of v's tangent (rad, m);
    steps of Levenberg-Marquardt; ok, whether it converged.
    """

    model: Model
    values: dict[str, float]
    errors: dict[str, float]
    rms: float
    steps: int
    ok: bool


def fit(
    model: Model,
    state: State,
    ctrls: jax.Array,
    measured: jax.Array,
    unknowns: Mapping[str, Unknown],
    *,
    dt: float | None = None,
    integrator: str = "semi_implicit_euler",
    save_every: int = 1,
    max_steps: int = 60,
) -> Fit:
    """Numbers of a model from a measured motion, several at once.

    Args:
        model: the robot, with first guesses.
        state: the known initial state.
        ctrls: (steps, nu) controls that were applied.
        measured: (1 + steps / save_every, nq) measured configurations, the first at the start.
        unknowns: name -> `Unknown`.
        dt: step in seconds; the model's timestep if None.
        integrator: of `rollout`.
        save_every: steps between two measurements.
        max_steps: of Levenberg-Marquardt.

    Returns:
        `Fit`; `ok` is false where it did not converge.

    Raises:
        InputError: shapes; a positive unknown whose guess is not positive.
        UnknownName: an unknown that is no leaf of the model.

    Source: Marquardt 1963; Nocedal & Wright, *Numerical Optimization*, 10.3.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.sysid import Unknown, fit
        >>> model, push = rb.load("pendulum"), jnp.ones((200, 1))
        >>> start = model.default_state()
        >>> heavier = model.replace(bodies=model.bodies.replace(mass=jnp.array([1.3])))
        >>> seen = rb.rollout(heavier, start, push).q
        >>> mass = Unknown("bodies.mass", 0, positive=True)
        >>> found = fit(model, start, push, seen, {"mass": mass})
        >>> round(found.values["mass"], 3)
        1.3
    """
    measured, ctrls = jnp.asarray(measured), jnp.asarray(ctrls)
    expected = (1 + len(ctrls) // save_every, model.nq)
    if measured.shape != expected:
        raise InputError(f"fit: measured has shape {measured.shape}, expected {expected}")
    guess = {name: _read(model, u) for name, u in unknowns.items()}
    for name, u in unknowns.items():
        if u.positive and not guess[name] > 0:
            raise InputError(f"fit: {name} is {guess[name]:g}, expected a positive first guess")
    dtype = measured.dtype
    start = [np.log(x) if unknowns[n].positive else x for n, x in guess.items()]
    theta0 = jnp.asarray(start, dtype)

    def numbers(theta: jax.Array) -> list[jax.Array]:
        return [
            jnp.exp(x) if u.positive else x for x, u in zip(theta, unknowns.values(), strict=True)
        ]

    def residual(theta: jax.Array, data: Any) -> jax.Array:
        state, ctrls, measured = data
        changed = model
        for u, x in zip(unknowns.values(), numbers(theta), strict=True):
            changed = _write(changed, u, x)
        path = rollout(changed, state, ctrls, dt, integrator=integrator, save_every=save_every)
        return jax.vmap(lambda a, b: difference(model, a, b))(path.q[1:], measured[1:])

    @jax.jit
    def solve(theta: jax.Array, data: Any) -> Any:
        solver: Any = optx.LevenbergMarquardt(rtol=1e-7, atol=1e-9)
        solution: Any = optx.least_squares(
            residual, solver, theta, data, options={"jac": "fwd"}, max_steps=max_steps, throw=False
        )
        left = residual(solution.value, data)
        J = jax.jacfwd(residual)(solution.value, data).reshape(left.size, -1)
        variance = (left**2).sum() / max(left.size - len(theta), 1)
        spread = jnp.sqrt(jnp.diag(jnp.linalg.inv((J.T @ J) / variance)))
        ok = solution.result == optx.RESULTS.successful
        return solution.value, spread, jnp.sqrt((left**2).mean()), solution.stats["num_steps"], ok

    theta, spread, rms, steps, ok = solve(theta0, (state, ctrls, measured))
    values, errors = {}, {}
    found = model
    for name, x, s in zip(unknowns, numbers(theta), spread, strict=True):
        values[name] = float(x)
        errors[name] = float(s) * (float(x) if unknowns[name].positive else 1.0)
        found = _write(found, unknowns[name], x)
    return Fit(found, values, errors, float(rms), int(steps), bool(ok))


def _where(leaf: str) -> Any:
    def where(model: Model) -> Any:
        value: Any = model
        for part in leaf.split("."):
            value = getattr(value, part)
        return value

    return where


def _read(model: Model, u: Unknown) -> float:
    try:
        value = _where(u.leaf)(model)
    except AttributeError:
        value = None
    if not eqx.is_array(value):
        paths = jax.tree_util.tree_flatten_with_path(model)[0]
        names = [jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in paths]
        raise UnknownName("leaf of Model", u.leaf, names)
    return float(np.asarray(value)[u.index])


def _write(model: Model, u: Unknown, x: jax.Array) -> Model:
    where = _where(u.leaf)
    return eqx.tree_at(where, model, where(model).at[u.index].set(x))
