"""Forward dynamics and the inverse of the mass matrix, by the articulated-body algorithm.

The derivative does not differentiate ABA. With a = FD(q, v, tau), the identity
ID(q, v, FD(q, v, tau)) = tau gives

    da = M^-1 (dtau - dID(q, v, a)),

one tangent of RNEA and one solve with the factors of ABA (Carpentier & Mansard 2018).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rbjax.dynamics.algorithms.aba import Factor, aba, factorize, solve
from rbjax.dynamics.algorithms.columns import inverse_mass_by_columns
from rbjax.dynamics.algorithms.rnea import LinkForces, on_links, rnea
from rbjax.dynamics.drivers.choice import driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.dynamics.tracing.custom_rules import (
    split_tracers,
    with_implicit_jvp,
)
from rbjax.model import Model, with_constants

#: the names of values that a derivative may read instead of recomputing them
LEFT = ("acceleration", "factors")


def _left(a: jax.Array, factors: Any) -> tuple[jax.Array, Any]:
    """The acceleration and the factors, named. Transforms and axes are cheap to recompute."""

    def named(f: Factor) -> Factor:
        U, inverse_D = jax.tree.map(
            lambda x: checkpoint_name(x, "factors") if isinstance(x, jax.Array) else x,
            (f.U, f.inverse_D),
        )
        return f._replace(U=U, inverse_D=inverse_D)

    named_factors = jax.tree.map(named, factors, is_leaf=lambda x: isinstance(x, Factor))
    return checkpoint_name(a, "acceleration"), named_factors


def acceleration(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    tau: jax.Array,
    f_ext: LinkForces | None = None,
) -> jax.Array:
    """a = M^-1 (tau - b + sum of J_i^T f_i) on checked arrays (nv, ...), with the derivative above.

    `f_ext`: forces f_i on links, in their axes at their origins. Leaves of the model and lanes of
    forces that are known while tracing are no arguments of the custom derivative, so they stay
    known.
    """
    given, rebuilt = split_tracers((model, f_ext))

    def plain(changed, q, v, tau):
        model, f_ext = rebuilt(changed)
        d = driver(model, q.dtype)
        qdd, _ = aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity, f_ext)
        return (d.pack(qdd, tau),)

    def solved(changed, q, v, tau):
        model, f_ext = rebuilt(changed)
        d = driver(model, q.dtype)
        qdd, factors = aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity, f_ext)
        a, factors = _left(d.pack(qdd, tau), factors)
        return (a,), [lambda change: d.pack(solve(d, factors, d.lanes(change)), tau)]

    def residual(changed, q, v, tau, a):
        model, f_ext = rebuilt(changed)
        d = driver(model, q.dtype)
        forces = rnea(d, d.joints(q, v), d.lanes(a), d.prepared.gravity, f_ext)
        return tau - d.pack(forces, tau)

    return with_implicit_jvp(plain, solved, residual)(given, q, v, tau)[0]


@algorithm("q", "v", "tau", "wrenches", long=True)
def forward_dynamics(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, wrenches: jax.Array | None = None
) -> jax.Array:
    """Compute the acceleration of the bodies only: no actuators, force elements or constraints.

    a = M^-1 (tau - b + sum_b J_b^T w_b). `rb.acceleration` has everything in the model,
    `rbjax.constraints.constrained_dynamics` the bodies and the constraints.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        tau: (nv,) all applied generalized forces; `applied_forces` gives those of the model.
        wrenches: (nb, 6) external [moment N m; force N] on bodies, in world axes, at their origins.

    Returns:
        (nv,) the rate of v; not finite where the mass matrix is singular, as with a joint that
        moves no mass.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, zero quaternions.
        ModelError: a joint moves no mass, and this is known while tracing.

    Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 7 (ABA).

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("arm7")
        >>> state = model.random_state(jax.random.key(0))
        >>> rb.forward_dynamics(model, state.q, state.v, 0 * state.v).shape
        (7,)
    """
    if not model.nv:
        return jnp.zeros(0, q.dtype)
    model = with_constants(model, q.dtype)  # all samples share them: outside of the derivative rule
    f_ext = None
    if wrenches is not None:
        d = driver(model, q.dtype)
        f_ext = on_links(d, d.joints(q, None), wrenches)
    return acceleration(model, q, v, tau, f_ext)


@algorithm("q", pairs=True, apart=inverse_mass_by_columns)
def inverse_mass_matrix(model: Model, q: jax.Array) -> jax.Array:
    """M(q)^-1 (nv, nv), by the articulated-body algorithm in O(n) a column.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Source: Featherstone, 7.5; Carpentier (2018), analytical inverse of the joint-space inertia.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rb.inverse_mass_matrix(model, model.default_state().q).shape
        (2, 2)
    """
    if not model.nv:
        return jnp.zeros((0, 0), q.dtype)
    d = driver(model, q.dtype)
    factors = factorize(d, d.joints(q, None))

    def column(unit):
        return d.pack(solve(d, factors, d.lanes(unit)), unit)

    return jax.vmap(column)(jnp.eye(model.nv, dtype=q.dtype))
