"""`fit`: parameters of a model from measured configurations, by nonlinear least squares.

    min over theta of  sum_k |q_k (-) q(t_k; theta)|^2,   q(t; theta) a `rollout`
Levenberg-Marquardt with forward-mode Jacobians of the rollout. Positive parameters are fitted by
their logarithm. Standard errors are those of the linearised problem: s^2 (J^T J)^-1 with s^2 the
mean square residual. They measure the effect of noise, not errors of the model.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from rbjax.dynamics import difference
from rbjax.dynamics.arguments import check_array, check_arrays, check_step
from rbjax.errors import InputError, UnknownName
from rbjax.model import Model, State
from rbjax.motion.integrators import integrator_of
from rbjax.motion.rollout import rollout
from rbjax.solvers.common.arguments import check_whole
from rbjax.sysid.parameters.unknowns import Unknown


@dataclass(frozen=True)
class Fit:
    """The result of `fit`: the model with its fitted numbers, and their standard errors.

    Fields: model; values and errors by name; rms of the residual (rad, m); steps of
    Levenberg-Marquardt; ok, whether it converged.
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
    """Fit one or more numbers of a model to a measured motion.

    Args:
        model: the robot, with first guesses.
        state: the known initial state.
        ctrls: (steps, nu) applied controls.
        measured: (1 + steps / save_every, nq) measured configurations, the first at the start.
        unknowns: name -> `Unknown`.
        dt: step in seconds; the model's timestep if None.
        integrator: of `rollout`.
        save_every: steps between two measurements.
        max_steps: of Levenberg-Marquardt.

    Returns:
        `Fit`; `ok` is false if it did not converge.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite; no unknowns, or one that is
            not a single number; a positive unknown whose guess is not positive.
        UnknownName: an unknown is no leaf of the model.

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
    state = check_arrays("fit", model, {"state": state})["state"]
    integrator_of("fit", integrator)
    for name, value in (("save_every", save_every), ("max_steps", max_steps)):
        check_whole("fit", name, value, 1)
    if not isinstance(unknowns, Mapping) or not all(
        isinstance(u, Unknown) for u in unknowns.values()
    ):
        raise InputError(
            f"fit: unknowns is {unknowns!r}, expected a dict name -> {Unknown.__name__}, such as "
            '{"mass": Unknown("bodies.mass", 0)}'
        )
    if not unknowns:
        raise InputError('fit: no unknowns, expected e.g. {"mass": Unknown("bodies.mass", 0)}')
    rows = max(1, np.shape(ctrls)[0]) if np.ndim(ctrls) else 1
    ctrls = check_array("fit", "ctrls", ctrls, (rows, model.nu), fix=": one row a step")
    measured = check_array("fit", "measured", measured, (1 + rows // save_every, model.nq))
    guess = {name: _read(model, u) for name, u in unknowns.items()}
    for name, u in unknowns.items():
        if u.positive and not guess[name] > 0:
            raise InputError(f"fit: {name} is {guess[name]:g}, expected a positive first guess")
    sought = tuple(unknowns.values())
    start = [np.log(guess[n]) if u.positive else guess[n] for n, u in unknowns.items()]
    step = check_step("fit", "dt", model.timestep if dt is None else dt, float)
    # the fit runs in the widest available dtype, whatever the dtype of the data
    data = (model, *jax.tree.map(lambda x: x.astype(float), (state, ctrls, measured)), step)
    how = (sought, integrator, save_every, max_steps)
    numbers, errors, rms, steps, ok = _solve(jnp.asarray(start, float), data, *how)
    return Fit(
        _changed(model, sought, numbers),
        dict(zip(unknowns, map(float, numbers), strict=True)),
        dict(zip(unknowns, map(float, errors), strict=True)),
        float(rms), int(steps), bool(ok),
    )  # fmt: skip


@functools.partial(jax.jit, static_argnums=(2, 3, 4, 5))
def _solve(theta, data, sought, integrator, save_every, max_steps):
    """Numbers, their standard errors, rms of the residual, steps, whether it converged."""

    def numbers(theta: jax.Array) -> list[jax.Array]:
        return [jnp.exp(x) if u.positive else x for x, u in zip(theta, sought, strict=True)]

    def residual(theta: jax.Array, data: Any) -> jax.Array:
        model, state, ctrls, measured, dt = data
        changed = _changed(model, sought, numbers(theta))
        path = rollout(changed, state, ctrls, dt, integrator=integrator, save_every=save_every)
        return jax.vmap(lambda a, b: difference(model, a, b))(path.q[1:], measured[1:])

    solver: Any = optx.LevenbergMarquardt(rtol=1e-7, atol=1e-9)
    solution: Any = optx.least_squares(
        residual, solver, theta, data, options={"jac": "fwd"}, max_steps=max_steps, throw=False
    )
    left = residual(solution.value, data)
    J = jax.jacfwd(residual)(solution.value, data).reshape(left.size, -1)
    variance = (left**2).sum() / max(left.size - len(theta), 1)
    errors = jnp.sqrt(jnp.diag(jnp.linalg.inv((J.T @ J) / variance)))
    found = jnp.stack(numbers(solution.value))
    scale = jnp.where(np.array([u.positive for u in sought]), found, 1.0)  # d exp(x) = exp(x) dx
    ok = solution.result == optx.RESULTS.successful
    return found, errors * scale, jnp.sqrt((left**2).mean()), solution.stats["num_steps"], ok


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
    try:
        return float(np.asarray(value)[u.index])
    except (IndexError, TypeError) as error:
        raise InputError(
            f"fit: {u.leaf} has shape {np.shape(value)} and no number at index {u.index}, "
            "expected a whole number for each axis"
        ) from error


def _changed(model: Model, sought: tuple[Unknown, ...], numbers: Any) -> Model:
    for u, x in zip(sought, numbers, strict=True):
        where = _where(u.leaf)
        model = eqx.tree_at(where, model, where(model).at[u.index].set(x))
    return model
