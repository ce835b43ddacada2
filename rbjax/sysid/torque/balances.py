"""Equations without acceleration: balances of momentum and energy over windows of a motion.

With p = M v, d(M v)/dt = M a + M' v, and M a + C v + g = tau less the forces of joints,

    momentum   [p + J v] = integral of (tau + M' v - C v - g - joint forces) dt
    energy     [T + U + J v^2 / 2] = integral of v . (tau - friction - bias) dt

over a window. All of it is linear in the parameters, so the rows go to `regress` as torques do:
momentum gives one for each coordinate (of impulses, N m s), energy one for all (J). Khalil &
Dombre, *Modeling, Identification and Control of Robots*, 12.6; Gautier, *Dynamic identification of
robots with power model*, ICRA 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate

from rbjax.arguments import flag
from rbjax.dynamics import forward_kinematics, inertial_regressor, integrate
from rbjax.dynamics.arguments import SHAPES, check_array, check_model, shape_of
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.solvers.common.arguments import check_whole
from rbjax.sysid.torque.regressors import joint_coordinates, regressor

Array = np.ndarray


def momentum_regressor(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """Y (nv, 10 nb) with M(q) v = Y pi, armature left out.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Source: M v is inverse dynamics at rest without gravity, with v for the acceleration.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid import momentum_regressor
        >>> model = rb.load("double_pendulum")
        >>> momentum_regressor(model, model.default_state().q, [1.0, 2.0]).shape
        (2, 20)
    """
    v = _velocity("momentum_regressor", model, v)
    weightless = model.replace(gravity=jnp.zeros_like(model.gravity))
    return inertial_regressor(weightless, q, jnp.zeros_like(v), v)


def energy_regressor(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """Y (10 nb,) with T + U = Y . pi, armature left out; U = 0 for bodies at the world's origin.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Source: Gautier & Khalil, CDC 1988: the energy model.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid import energy_regressor
        >>> model = rb.load("double_pendulum")
        >>> energy_regressor(model, model.default_state().q, [1.0, 2.0]).shape
        (20,)
    """
    v = _velocity("energy_regressor", model, v)
    R, p = forward_kinematics(model, q)
    g = model.gravity.astype(R.dtype)
    height, turned = -(p * g).sum(-1, keepdims=True), -(R * g[:, None]).sum(-2)
    none = jnp.zeros((model.nb, 6), R.dtype)
    U = jnp.concatenate([height, turned, none], 1).reshape(-1)
    return (v[:, None] * momentum_regressor(model, q, v)).sum(0) / 2 + U


def momentum_balance(
    model: Model,
    t: Any,
    q: Any,
    v: Any,
    tau: Any,
    *,
    window: int,
    joint_terms: Sequence[str] = (),
    smoothing: float = 0.0,
    held: bool = False,
) -> tuple[Array, Array]:
    """W (windows, nv, p) and impulses y (windows, nv) with W pi = y; no acceleration is needed.

    Args:
        model: the robot.
        t: (n,) times in s, ascending.
        q: (n, nq) configurations.
        v: (n, nv) velocities.
        tau: (n, nv) torques of the motors.
        window: samples from the start of a window to the start of the next.
        joint_terms: as for `regressor`.
        smoothing: as for `regressor`.
        held: each torque acts unchanged from its sample to the next; otherwise torques are samples
            of a smooth function.

    Returns:
        (W, y), the columns of W in the order of `parameter_names`. Integrals are Simpson's.

    Raises:
        InputError: wrong shapes; times that do not ascend; fewer samples than one window.

    Source: Khalil & Dombre, 12.6.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.sysid import momentum_balance
        >>> model, t = rb.load("pendulum"), jnp.linspace(0.0, 1.0, 21)
        >>> q, v = jnp.sin(t)[:, None], jnp.cos(t)[:, None]
        >>> W, y = momentum_balance(model, t, q, v, 0 * v, window=5)
        >>> W.shape, y.shape
        ((4, 1, 10), (4, 1))
    """
    flag("momentum_balance", "held", held)
    t, q, v, tau = _motion("momentum_balance", model, t, q, v, tau, window)
    inertial = 10 * model.nb

    def rates(q: jax.Array, v: jax.Array, tau: jax.Array) -> tuple[jax.Array, jax.Array]:
        """p + J v, and what joint forces and C v + g - M' v take."""

        def moved(s: jax.Array) -> jax.Array:
            return momentum_regressor(model, integrate(model, q, s * v), v)

        p, p_rate = jax.jvp(moved, (jnp.zeros(()),), (jnp.ones(()),))
        still = jnp.zeros_like(v)
        Y = regressor(model, q, v, still, joint_terms=joint_terms, smoothing=smoothing, tau=tau)
        moment = regressor(model, q, v, v, joint_terms=joint_terms, smoothing=smoothing, tau=tau)
        places = _columns(model, joint_terms)
        kept = jnp.where(places == "armature", moment[:, inertial:], 0.0)
        return (
            jnp.concatenate([p, kept], 1),
            jnp.concatenate([Y[:, :inertial] - p_rate, Y[:, inertial:]], 1),
        )

    P, taken = map(np.asarray, jax.jit(jax.vmap(rates))(q, v, tau))
    W = _over(P, window) + _over(_integral(t, taken), window)
    return W, _over(_integral(t, np.asarray(tau), held), window)


def energy_balance(
    model: Model,
    t: Any,
    q: Any,
    v: Any,
    tau: Any,
    *,
    window: int,
    joint_terms: Sequence[str] = (),
    smoothing: float = 0.0,
    held: bool = False,
) -> tuple[Array, Array]:
    """W (windows, 1, p) and work y (windows, 1) with W pi = y; no acceleration is needed.

    Args, Returns and Raises as for `momentum_balance`. The work of a held torque is its product
    with the integral of the velocity.

    Source: Gautier 1997.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.sysid import energy_balance
        >>> model, t = rb.load("pendulum"), jnp.linspace(0.0, 1.0, 21)
        >>> q, v = jnp.sin(t)[:, None], jnp.cos(t)[:, None]
        >>> W, y = energy_balance(model, t, q, v, 0 * v, window=5)
        >>> W.shape, y.shape
        ((4, 1, 10), (4, 1))
    """
    flag("energy_balance", "held", held)
    t, q, v, tau = _motion("energy_balance", model, t, q, v, tau, window)
    inertial, places = 10 * model.nb, _columns(model, joint_terms)

    def rates(q: jax.Array, v: jax.Array, tau: jax.Array) -> tuple[jax.Array, jax.Array]:
        still = jnp.zeros_like(v)
        Y = regressor(model, q, v, v, joint_terms=joint_terms, smoothing=smoothing, tau=tau)
        Y = Y[:, inertial:]
        power = (v[:, None] * Y).sum(0)
        stored = jnp.where(places == "armature", power / 2, 0.0)
        lost = jnp.where(places == "armature", 0.0, power)
        none = jnp.zeros(inertial, still.dtype)
        return (
            jnp.concatenate([energy_regressor(model, q, v), stored]),
            jnp.concatenate([none, lost]),
        )

    E, lost = map(np.asarray, jax.jit(jax.vmap(rates))(q, v, tau))
    W = _over(E, window) + _over(_integral(t, lost), window)
    v, tau = np.asarray(v), np.asarray(tau)
    if held:
        steps = np.diff(_integral(t, v), axis=0)
        work = np.concatenate([np.zeros((1, v.shape[1])), np.cumsum(tau[:-1] * steps, 0)])
    else:
        work = _integral(t, tau * v)
    return W[:, None], _over(work.sum(1), window)[:, None]


def _velocity(where: str, model: Model, v: Any) -> jax.Array:
    check_model(where, model)
    return check_array(where, "v", v, (model.nv,))


def _columns(model: Model, joint_terms: Sequence[str]) -> Array:
    """The term of each joint column."""
    return np.repeat(np.array(joint_terms, dtype=object), joint_coordinates(model).size)


def _motion(
    where: str, model: Model, t: Any, q: Any, v: Any, tau: Any, window: int
) -> tuple[Array, jax.Array, jax.Array, jax.Array]:
    check_model(where, model)
    n = (*shape_of(where, "t", t), 1)[0]
    t = np.asarray(check_array(where, "t", t, (n,)))
    q, v, tau = (
        check_array(where, name, x, (n, *SHAPES[name](model)), fix=": one row a sample")
        for name, x in (("q", q), ("v", v), ("tau", tau))
    )
    if not (np.diff(t) > 0).all():
        k = int(np.argmin(np.diff(t) > 0))
        raise InputError(f"{where}: t[{k + 1}] = {t[k + 1]:g} follows {t[k]:g}, expected ascending")
    check_whole(where, "window", window, 1, n - 1)
    return t, q, v, tau


def _integral(t: Array, y: Array, held: bool = False) -> Array:
    """From the first sample to each, of samples or of held values."""
    if held:
        steps = np.diff(t).reshape(-1, *[1] * (y.ndim - 1)) * y[:-1]
        return np.concatenate([np.zeros_like(y[:1]), np.cumsum(steps, 0)])
    if len(t) < 3:
        return scipy.integrate.cumulative_trapezoid(y, t, axis=0, initial=0)
    return scipy.integrate.cumulative_simpson(y, x=t, axis=0, initial=0)


def _over(y: Array, window: int) -> Array:
    """Differences over windows; samples after the last whole one are left out."""
    return np.diff(y[::window], axis=0)
