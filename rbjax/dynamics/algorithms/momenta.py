"""Momenta: p = M(q) v, their rate, and the velocity of a momentum, each in O(n).

V_i is the twist of a link. h_i is the momentum of the subtree that it carries, itself included, and
f_i the weight of this subtree plus the external forces on it.

    p_i  = S_i.h_i + armature v_i
    p'_i = S_i.(f_i - V_i x* h_i) + S'_i.h_i + tau_i    (dL/dq_i + tau_i; of attitudes less w x p)

This needs no accelerations and no derivative of M. (Featherstone, *Rigid Body Dynamics
Algorithms*, 2.9 and 2.12, for the subtree that a joint carries: its axis moves at V x S + S', with
S' its rate in the link, which is zero except for joints whose axes depend on q.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax

from rbjax.dynamics.algorithms.aba import factorize, solve
from rbjax.dynamics.algorithms.link_forces import LinkForces, per_link
from rbjax.dynamics.algorithms.rnea import momentum
from rbjax.dynamics.drivers.choice import driver
from rbjax.dynamics.tracing.custom_rules import split_tracers, with_implicit_jvp
from rbjax.lanes import Lane, Vec3, add, mul
from rbjax.model import Model
from rbjax.spatial import Force, Motion


def momentum_of(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """p = M(q) v (nv, ...), on checked arrays."""
    return momentum(model, q, v)


def momentum_and_rate(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    tau: jax.Array,
    f_ext: LinkForces | None = None,
) -> tuple[jax.Array, jax.Array]:
    """p = M(q) v and p' (nv, ...) under generalized forces and forces on links, on checked
    arrays."""

    def outward(x, parent):
        link, joint, _, _ = x
        V_parent, g_parent = parent
        X = joint.transform(link)
        V = X(V_parent) + joint.twist
        g = X.E @ g_parent
        return (V, g), (X, V, g)

    def inward(x, children):
        (link, joint, tau, push), (X, V, g) = x
        h = link.inertia(V) + children[0]
        f = link.inertia(Motion(Vec3.zero(), g)) + push + children[1]
        p = add(joint.S.dot(h), mul(link.armature, joint.qd))
        rate = add(joint.S.dot(f - V.cross_force(h)), add(joint.S_rate.dot(h), tau))
        return (X.T(h), X.T(f)), (p, rate)

    d = driver(model, q.dtype)
    xs = d.zip(d.constants, d.joints(q, v), d.lanes(tau), per_link(d, f_ext))
    root = (Motion.zero(), d.prepared.gravity)
    found = d.out_and_in(outward, root, inward, (Force.zero(), Force.zero()), xs)
    p, rate = d.unzip(found, 2)
    return d.pack(p, v), d.pack(rate, v)


def velocity_of(model: Model, q: jax.Array, p: jax.Array) -> jax.Array:
    """v = M(q)^-1 p (nv, ...), on checked arrays, with the derivative

    dv = M^-1 (dp - d(M(q) v)),   v held constant.
    """
    given, rebuilt = split_tracers(model)

    def factors(changed, q):
        d = driver(rebuilt(changed), q.dtype)
        return d, factorize(d, d.joints(q, None))

    def plain(changed, q, p):
        d, found = factors(changed, q)
        return (d.pack(solve(d, found, d.lanes(p)), p),)

    def solved(changed, q, p):
        d, found = factors(changed, q)

        def velocity(p):
            return d.pack(solve(d, found, d.lanes(p)), p)

        return (velocity(p),), [velocity]

    def residual(changed, q, p, v):
        return p - momentum(rebuilt(changed), q, v)

    return with_implicit_jvp(plain, solved, residual)(given, q, p)[0]


def linearly_implicit_velocity(
    model: Model, q: jax.Array, extra: Mapping[int, Lane] | None = None
) -> Callable[[jax.Array], jax.Array]:
    """The function p -> (M(q) + diag(extra))^-1 p of arrays (nv, ...); all calls share one
    elimination. `extra`: one lane a velocity coordinate. Its derivatives by q and the model are
    zero."""
    moving, closed = split_tracers(model)  # known leaves stay known
    still, q = closed(jax.lax.stop_gradient(moving)), jax.lax.stop_gradient(q)
    d = driver(still, q.dtype)
    found = factorize(d, d.joints(q, None), d.scattered(extra or {}, 0.0))
    return lambda p: d.pack(solve(d, found, d.lanes(p)), p)
