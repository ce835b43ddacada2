"""What constraints do to a robot: residuals, multipliers, and the wrenches in joints.

    M a + b = tau + sum of J_i^T f_i + G^T l
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.constraints.law import constrained_motion
from rbjax.constraints.pairs import Pair
from rbjax.constraints.system import by_link, gradient_matrix, rows_of
from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.drivers import driver
from rbjax.dynamics.link_forces import on_links
from rbjax.dynamics.packing import pack
from rbjax.errors import InputError
from rbjax.forces.acting import applied
from rbjax.forces.inputs import Inputs
from rbjax.forces.instant import Instant
from rbjax.lanes import Vec3
from rbjax.model import Model, State


class Residual(NamedTuple):
    """Rows (m,): values g, zero for non-holonomic rows, and rates G v + g_t."""

    value: jax.Array
    rate: jax.Array


@algorithm("state", "t")
def residual(model: Model, state: State, t: Any = 0.0) -> Residual:
    """How far a state is from the constraints: g(t, q) and g' = G v + g_t.

    Args:
        model: the robot, with constraints.
        state: `State(q (nq,), v (nv,))`.
        t: time in seconds, for rows that look at it.

    Returns:
        `Residual(value (m,), rate (m,))`, in metres and per second, or without unit for angles.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> loop = rb.constraints.Inline.between(model, None, "lower", point=[0.0, 0, -2.0])
        >>> model = model.with_constraints(loop)
        >>> rb.constraints.residual(model, model.default_state()).value.shape
        (2,)
    """
    rows = rows_of(model, Instant.of(model, t, state, None))
    values, rates = [row.residual for row in rows], [row.rate for row in rows]
    return Residual(pack(values, state.v), pack(rates, state.v))


@algorithm("q", "t")
def jacobian(model: Model, q: jax.Array, t: Any = 0.0) -> jax.Array:
    """G (m, nv): g' = G v + g_t, row by row.

    Args:
        model: the robot, with constraints.
        q: (nq,) configuration.
        t: time in seconds, for rows that look at it.
    """
    now = Instant.of(model, t, State(q, jnp.zeros(model.nv, q.dtype)), None)
    return gradient_matrix(now, rows_of(model, now))


class ConstrainedMotion(NamedTuple):
    """Accelerations (nv,) and multipliers (m,)."""

    acceleration: jax.Array
    multipliers: jax.Array


@algorithm("q", "v", "tau", "wrenches", "t", long=True)
def constrained_dynamics(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    tau: jax.Array,
    wrenches: jax.Array | None = None,
    t: Any = 0.0,
) -> ConstrainedMotion:
    """Accelerations of a robot with its constraints, and their multipliers:

        M a + b = tau + sum_b J_b^T w_b + G^T l,      G a = -(G' v + ...)

    `rbjax.forward_dynamics` is the same without constraints.

    Args:
        model: the robot; its constraints are enforced, redundant ones too.
        q: (nq,) configuration.
        v: (nv,) velocity.
        tau: (nv,) all applied generalized forces; `applied_forces` gives those of the model.
        wrenches: (nb, 6) external [moment N m; force N] on bodies, in world axes, at their origins.
        t: time in seconds, for rows that look at it.

    Returns:
        `ConstrainedMotion(acceleration (nv,), multipliers (m,))`, the latter as `multipliers` has
        them.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, zero quaternions.

    Source: Masarati, *Multibody System Dynamics*, ch. 7; Carpentier, Budhiraja & Mansard 2021.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rail = rb.constraints.Inplane.between(model, None, "lower", point=[0.0, 0, -2.0])
        >>> model = model.with_constraints(rail)
        >>> state = model.default_state()
        >>> found = rb.constraints.constrained_dynamics(model, state.q, state.v, 0 * state.v)
        >>> found.multipliers.shape
        (1,)
    """
    if not model.nv:
        return ConstrainedMotion(jnp.zeros(0, q.dtype), jnp.zeros(0, q.dtype))
    pushes: Any = None
    if wrenches is not None:
        d = driver(model, q.dtype)
        pushes = on_links(d, d.joints(q, None), wrenches)
    return ConstrainedMotion(*constrained_motion(model, t, State(q, v), tau, pushes))


@algorithm("state", "ctrl", "t")
def multipliers(
    model: Model, state: State, ctrl: jax.Array | None = None, t: Any = 0.0
) -> jax.Array:
    """l (m,) of M a + b = tau + G^T l, G a = -(G' v + ...): the forces that the rows need.

    Of redundant rows the multipliers of least norm, each weighed by the square root of its
    diag(G M^-1 G^T). A multiplier is in newtons where its row is in metres, in newton metres where
    it is an angle or a cosine.

    Args:
        model: the robot, with constraints.
        state: `State(q (nq,), v (nv,))`, with x (nx,) where force elements have states.
        ctrl: (nu,) controls; None for no actuation.
        t: time in seconds.

    Source: Masarati, *Multibody System Dynamics*, ch. 7.
    """
    return _solved(model, state, ctrl, t)


def _solved(model: Model, state: State, ctrl: Any, t: Any) -> jax.Array:
    tau, pushes, _ = applied(model, t, state, Inputs(ctrl))
    return constrained_motion(model, t, state, tau, pushes)[1]


@algorithm("state", "ctrl", "t")
def joint_wrenches(
    model: Model, state: State, ctrl: jax.Array | None = None, t: Any = 0.0
) -> jax.Array:
    """What each loop joint (`Pair`) of the model does to its body b: (joints, 6) [torque N m; force
    N], in world axes at the origin of its frame on b.

    Args: as `multipliers`.
    """
    l = _solved(model, state, ctrl, t)
    now = Instant.of(model, t, state, None)
    out, at = [], 0
    for constraint in model.constraints:
        if not isinstance(constraint, Pair):
            raise InputError(
                f"joint_wrenches: the model has a {type(constraint).__name__}, expected joints "
                "between two frames only; `multipliers` takes any constraint"
            )
        B = constraint.b.frame(now)
        torque, force = Vec3.zero(), Vec3.zero()
        for row in constraint.rows(now):
            push = by_link(row.gradient).get(B.link)
            if push is not None:
                link = now.link(B.link)
                lin = link.rotation @ push.lin
                arm = link.position - B.position
                torque = torque + (link.rotation @ push.ang + arm.cross(lin)) * l[at]
                force = force + lin * l[at]
            at += 1
        out.append(pack([*torque, *force], state.v))
    return jnp.stack(out) if out else jnp.zeros((0, 6), state.q.dtype)
