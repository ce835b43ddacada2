"""Articulated-body algorithm: forward dynamics in O(n) (Featherstone, ch. 7).

In Newton-Euler form, with the classical acceleration of each link's origin. Linear velocities are
then not needed (Luh, Walker & Paul 1980), and forces still add as spatial forces about the origin.

    outward   w = E w_p + rate;   c = bias acceleration;   p = [w x J w; w x (w x h)]
    inward    U = I_A S;  D = S.U + armature;  u = tau - S.p_A
              to the parent: X^T (I_A - U U^T / D),  X^T (p_A + I_a c + U u / D)
    outward   a' = X(a_p) + c;  qdd = (u - U.a') / D;  a = a' + S qdd
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax

from rbjax.dynamics.algorithms.kinematics import velocity_bias
from rbjax.dynamics.algorithms.link_forces import LinkForces, per_link
from rbjax.dynamics.drivers.choice import Driver
from rbjax.errors import ModelError
from rbjax.lanes import Lane, Sym3, Vec3, add, is_zero, mul, sub
from rbjax.model import LinkConstants
from rbjax.spatial import ArticulatedInertia, Force, Motion, RigidInertia, Transform


class VelocityStep(NamedTuple):
    """A link's motion at given q and v: its pose, its bias acceleration, its bias force."""

    X: Transform
    w: Vec3
    c: Motion


class Factor(NamedTuple):
    """The result of eliminating a joint: qdd = (u - U.a) / D."""

    X: Transform
    S: Motion
    U: Force
    inverse_D: Lane


def bias_force(inertia: RigidInertia, w: Vec3) -> Force:
    """p = [w x J w; w x (w x h)], the force that rotation at constant w needs."""
    return Force(w.cross(inertia.J @ w), w.cross(w.cross(inertia.h)))


def eliminate(
    link: LinkConstants, S: Motion, X: Transform, I_A: ArticulatedInertia
) -> tuple[ArticulatedInertia, Factor]:
    """Eliminate the joint: its factor, and the remaining inertia across it."""
    U = I_A(S)
    D = add(S.dot(U), link.armature)
    if is_zero(D):
        raise ModelError(
            "a joint of the model moves no mass, so the mass matrix is singular; give its body "
            "mass and inertia (bodies.mass, bodies.inertia), or the joint armature"
        )
    inverse_D = 1.0 / D
    return I_A.without(U, inverse_D, S, link.armature), Factor(X, S, U, inverse_D)


def to_parent(
    X: Transform, I_a: ArticulatedInertia, factor: Factor, mass: Lane | None
) -> ArticulatedInertia:
    """X^T I_a X. For a rigid link on a hinge, M = m 1 - U U^T / D (linear parts): m, given as
    `mass`, needs no rotation, and the rank-one term is rotated as a vector."""
    if mass is None:
        return X.articulated_to_parent(I_a)
    U = X.R @ factor.U.lin
    M = Sym3(mass, mass, mass, 0.0, 0.0, 0.0) - Sym3.outer(U * factor.inverse_D, U)
    turned = ArticulatedInertia(I_a.J.rotated(X.R), X.R @ I_a.H @ X.E, M)
    return turned.shifted(X.p)


def rigid_mass(link: LinkConstants, S: Motion, I_children: ArticulatedInertia) -> Lane | None:
    """The mass of a link that has no children and a hinge; else None."""
    tip = all(is_zero(x) for x in jax.tree.leaves((I_children, S.lin)))
    return link.inertia.m if tip else None


def aba(
    d: Driver, joints: Any, tau: Any, gravity: Vec3, f_ext: LinkForces | None = None
) -> tuple[Any, Any]:
    """Accelerations per link, and the factors of the mass matrix. `f_ext`: external forces on
    links."""

    def outward(x, w_parent):
        link, joint, *_ = x
        X = joint.transform(link)
        w, c = velocity_bias(joint, X, w_parent)
        return w, VelocityStep(X, w, c)

    def inward(x, message):
        (link, joint, tau, push), motion = x
        p_A = bias_force(link.inertia, motion.w) - push + message[1]
        I_a, factor = eliminate(link, joint.S, motion.X, link.inertia.articulated() + message[0])
        u = sub(tau, joint.S.dot(p_A))
        p_a = p_A + I_a(motion.c) + factor.U * mul(u, factor.inverse_D)
        mass = rigid_mass(link, joint.S, message[0])
        return (to_parent(motion.X, I_a, factor, mass), motion.X.T(p_a)), (factor, u, motion.c)

    zero = (ArticulatedInertia.zero(), Force.zero())
    xs = d.zip(d.constants, joints, tau, per_link(d, f_ext))
    ys = d.out_and_in(outward, Vec3.zero(), inward, zero, xs)

    def accelerate(x, a_parent):
        factor, u, c = x
        a = factor.X(a_parent) + c
        qdd = mul(sub(u, factor.U.dot(a)), factor.inverse_D)
        return a + factor.S * qdd, (qdd, factor)

    qdd, factors = d.unzip(d.outward(accelerate, Motion(Vec3.zero(), -gravity), ys), 2)
    return qdd, factors


def factorize(d: Driver, joints: Any, extra: Any = None) -> Any:
    """The factors of the mass matrix, from articulated inertias only. `extra`: added to its
    diagonal, per link."""

    def inward(x, I_children):
        link, joint, *more = x
        if more:
            link = replace(link, armature=add(link.armature, more[0]))
        X = joint.transform(link)
        I_a, factor = eliminate(link, joint.S, X, link.inertia.articulated() + I_children)
        return to_parent(X, I_a, factor, rigid_mass(link, joint.S, I_children)), factor

    given = (d.constants, joints) if extra is None else (d.constants, joints, extra)
    return d.inward(inward, ArticulatedInertia.zero(), d.zip(*given))


def solve(d: Driver, factors: Any, tau: Any, again: Any = None) -> Any:
    """M^-1 tau from the factors: ABA without velocities and gravity, linear in tau. `again`: the
    factors that the way out reads, where it shall not be handed those of the way in."""
    ys = eliminated(d, factors, tau)
    if again is not None:
        ys = d.zip(again, d.part(ys, 1))
    return accelerated(d, ys)


def eliminated(d: Driver, factors: Any, tau: Any) -> Any:
    """The way in: (factor, u) per link, u the force that is left at its joint."""

    def inward(x, p_A):
        factor, tau = x
        u = sub(tau, factor.S.dot(p_A))
        return factor.X.T(p_A + factor.U * mul(u, factor.inverse_D)), (factor, u)

    return d.inward(inward, Force.zero(), d.zip(factors, tau))


def accelerated(d: Driver, left: Any) -> Any:
    """The way out: accelerations per link, of (factor, u) per link."""

    def outward(x, a_parent):
        factor, u = x
        a = factor.X(a_parent)
        qdd = mul(sub(u, factor.U.dot(a)), factor.inverse_D)
        return a + factor.S * qdd, qdd

    return d.outward(outward, Motion.zero(), left)
