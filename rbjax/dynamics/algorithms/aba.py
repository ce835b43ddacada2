"""Articulated-body algorithm: forward dynamics in O(n) (Featherstone, ch. 7).

The recursion uses the classical acceleration of each link's origin (Newton-Euler form). It then
needs no linear velocities (Luh, Walker & Paul 1980). Forces add as spatial forces about the origin.
C and m are the coupling and the mass of a mode, zero for a rigid link (joints/modal.py).

    outward   w = E w_p + rate;   c = bias acceleration;   p = [w x J w; w x (w x h)]
    inward    U = I_A S + C;  D = S.U + S.C + m + armature;  u = tau - S.p_A
              to the parent: X^T (I_A - U U^T / D),  X^T (p_A + I_a c + U u / D)
    outward   a' = X(a_p) + c;  qdd = (u - U.a') / D;  a = a' + S qdd

The derivative does not differentiate ABA. With a = FD(q, v, tau), ID(q, v, a) = tau gives

    da = M^-1 (dtau - dID(q, v, a)),

one tangent of RNEA and one solution with the factors of ABA (Carpentier & Mansard 2018).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rbjax.dynamics.algorithms.kinematics import velocity_bias
from rbjax.dynamics.algorithms.rnea import LinkForces, per_link, rnea, wrenches_to_links
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.dynamics.tracing.custom_rules import (
    jax_arrays,
    split_tracers,
    with_implicit_jvp,
)
from rbjax.errors import ModelError
from rbjax.joints import JointMotion
from rbjax.lanes import Lane, Sym3, Vec3, add, batch_first, is_zero, mul, sub
from rbjax.model import LinkConstants, Model, with_constants
from rbjax.spatial import ArticulatedInertia, Force, Motion, Transform


class VelocityStep(NamedTuple):
    """Pose X of a link in its parent, angular velocity w, and bias acceleration c at (q, v)."""

    X: Transform
    w: Vec3
    c: Motion


class Factor(NamedTuple):
    """The factors of a joint that ABA has eliminated, which give qdd = (u - U.a) / D.

    X: pose of the link in its parent.
    S: axis of the joint in link axes.
    U: I_A S, with I_A the articulated inertia.
    inverse_D: 1 / D, with D = S.U + armature.
    """

    X: Transform
    S: Motion
    U: Force
    inverse_D: Lane


def eliminate(
    link: LinkConstants, joint: JointMotion, X: Transform, I_A: ArticulatedInertia
) -> tuple[ArticulatedInertia, Factor]:
    """Eliminate a joint. Return the articulated inertia that remains across it, and its factor."""
    S, modal = joint.S, joint.modal
    U = I_A(S) + modal.coupling
    more = add(link.armature, add(modal.mass, S.dot(modal.coupling)))
    D = add(S.dot(U), more)
    if is_zero(D):
        raise ModelError(
            "a joint of the model moves no mass, so the mass matrix is singular; give its body "
            "mass and inertia (bodies.mass, bodies.inertia), or the joint armature"
        )
    inverse_D = 1.0 / D
    return I_A.without(U, inverse_D, S, more), Factor(X, S, U, inverse_D)


def to_parent(
    X: Transform, I_a: ArticulatedInertia, factor: Factor, mass: Lane | None
) -> ArticulatedInertia:
    """Compute X^T I_a X, the inertia in the axes of the parent, about its origin.

    `mass` is the result of `rigid_mass`. If it is not None, the linear block of I_a is m 1 - U U^T
    / D. Then only the vector U is rotated, in place of this block.
    """
    if mass is None:
        return X.articulated_to_parent(I_a)
    U = X.R @ factor.U.lin
    M = Sym3(mass, mass, mass, 0.0, 0.0, 0.0) - Sym3.outer(U * factor.inverse_D, U)
    turned = ArticulatedInertia(I_a.J.rotated(X.R), X.R @ I_a.H @ X.E, M)
    return turned.shifted(X.p)


def rigid_mass(
    link: LinkConstants, joint: JointMotion, I_children: ArticulatedInertia
) -> Lane | None:
    """Return the mass of a link that has a hinge and no children, or None for any other link."""
    tip = all(is_zero(x) for x in jax.tree.leaves((I_children, joint.S.lin)))
    return joint.inertia(link).m if tip else None


def aba(
    d: Driver, joints: Any, tau: Any, gravity: Vec3, f_ext: LinkForces | None = None
) -> tuple[Any, Any]:
    """Compute the joint acceleration of each link, and the factors of the mass matrix."""

    def outward(x, w_parent):
        link, joint, *_ = x
        X = joint.transform(link)
        w, c = velocity_bias(joint, X, w_parent)
        return w, VelocityStep(X, w, c)

    def inward(x, message):
        (link, joint, tau, push), motion = x
        inertia, (f, modal) = joint.inertia(link), joint.velocity_forces(motion.w)
        p_A = inertia.bias_force(motion.w) + f - push + message[1]
        I_a, factor = eliminate(link, joint, motion.X, inertia.articulated() + message[0])
        u = sub(sub(tau, joint.S.dot(p_A)), modal)
        p_a = p_A + I_a(motion.c) + factor.U * mul(u, factor.inverse_D)
        mass = rigid_mass(link, joint, message[0])
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


def transforms(d: Driver, joints: Any) -> Any:
    """Compute the pose of each link in its parent."""

    def outward(x, nothing):
        link, joint = x
        return nothing, joint.transform(link)

    return d.outward(outward, (), d.zip(d.constants, joints))


def factorize(
    d: Driver, joints: Any, extra: Any = None, inertia: Any = None, poses: Any = None
) -> Any:
    """Factorize the mass matrix, with optional terms in addition, by the inward sweep of ABA.

    extra: lane to add to the diagonal, per link; None for zero.
    inertia: `ArticulatedInertia` to add to each link, in its axes, per link; None for zero.

    poses: `transforms` of the links. A derivative that saves U and 1 / D then computes the other
        parts of the factors without them.
    """

    def inward(x, I_children):
        link, joint, more, own, *known = x
        link = replace(link, armature=add(link.armature, more))
        X = known[0] if known else joint.transform(link)
        others = I_children + own
        I_a, factor = eliminate(link, joint, X, joint.inertia(link).articulated() + others)
        return to_parent(X, I_a, factor, rigid_mass(link, joint, others)), factor

    zero = ArticulatedInertia.zero()
    extra = d.scattered({}, 0.0) if extra is None else extra
    inertia = d.scattered({}, zero) if inertia is None else inertia
    known = () if poses is None else (poses,)
    return d.inward(inward, zero, d.zip(d.constants, joints, extra, inertia, *known))


def solve(d: Driver, factors: Any, tau: Any, again: Any = None) -> Any:
    """Compute M^-1 tau from the factors: ABA without velocities and gravity.

    `again` is an optional second copy of the factors for the outward sweep, to save registers.
    """
    ys = eliminated(d, factors, tau)
    if again is not None:
        ys = d.zip(again, d.part(ys, 1))
    return accelerated(d, ys)


def eliminated(d: Driver, factors: Any, tau: Any) -> Any:
    """Run the inward sweep of `solve`. Return (factor, u) per link.

    u is the joint force that remains after the elimination of the subtree of the link.
    """

    def inward(x, p_A):
        factor, tau = x
        u = sub(tau, factor.S.dot(p_A))
        return factor.X.T(p_A + factor.U * mul(u, factor.inverse_D)), (factor, u)

    return d.inward(inward, Force.zero(), d.zip(factors, tau))


def accelerated(d: Driver, left: Any, *, twists: bool = False) -> Any:
    """Run the outward sweep of `solve`: joint accelerations from (factor, u) per link.

    twists: whether to return the spatial accelerations of the links too, in their own axes.
    """

    def outward(x, a_parent):
        factor, u = x
        a = factor.X(a_parent)
        qdd = mul(sub(u, factor.U.dot(a)), factor.inverse_D)
        a = a + factor.S * qdd
        return a, (qdd, a) if twists else qdd

    return d.outward(outward, Motion.zero(), left)


def name_factors(values: Any) -> Any:
    """Name the arrays of a pytree "factors", for policies of `jax.checkpoint`
    (`rbjax.compiler.jax.saved`)."""
    name = lambda x: checkpoint_name(x, "factors") if isinstance(x, jax.Array) else x  # noqa: E731
    return jax.tree.map(name, values)


def named(factors: Any) -> Any:
    """Name U and 1 / D of the factors of all links (`name_factors`)."""

    def one(f: Factor) -> Factor:
        U, inverse_D = name_factors((f.U, f.inverse_D))
        return f._replace(U=U, inverse_D=inverse_D)

    return jax.tree.map(one, factors, is_leaf=lambda x: isinstance(x, Factor))


def acceleration(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    tau: jax.Array,
    f_ext: LinkForces | None = None,
) -> jax.Array:
    """Compute a = M^-1 (tau - b + sum of J_i^T f_i) from checked arrays (nv, ...).

    The derivative is a custom rule (see the module). Leaves of the model and lanes of f_ext that
    are constant while tracing are not arguments of the rule, so they stay constant.
    """
    given, rebuilt = split_tracers((model, f_ext))

    def plain(*at):
        changed, q, v, tau = at
        model, f_ext = rebuilt(changed)
        d = driver(model, q.dtype)
        qdd, _ = aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity, f_ext)
        return batch_first((d.pack(qdd, tau),), at)

    def solved(changed, q, v, tau):
        model, f_ext = rebuilt(changed)
        d = driver(model, q.dtype)
        qdd, factors = aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity, f_ext)
        a, factors = checkpoint_name(d.pack(qdd, tau), "acceleration"), named(factors)
        return (a,), [lambda change: d.pack(solve(d, factors, d.lanes(change)), tau)]

    def residual(changed, q, v, tau, a):
        model, f_ext = rebuilt(changed)
        d = driver(model, q.dtype)
        forces = rnea(d, d.joints(q, v), d.lanes(a), d.prepared.gravity, f_ext)
        return tau - d.pack(forces, tau)

    return with_implicit_jvp(plain, solved, residual)(*jax_arrays(given, q, v, tau))[0]


@algorithm("q", "v", "tau", "wrenches", long=True)
def forward_dynamics(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, wrenches: jax.Array | None = None
) -> jax.Array:
    """Compute the acceleration of a robot without actuators, force elements and constraints.

    a = M^-1 (tau - b + sum_b J_b^T w_b). `rb.acceleration` includes everything in the model, and
    `rbjax.constraints.constrained_dynamics` the constraints.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        tau: (nv,) all applied generalized forces; `applied_forces` computes the model's own.
        wrenches: (nb, 6) external [moment N m; force N] on bodies, in world axes, at their origins.

    Returns:
        (nv,) the rate of v; not finite if the mass matrix is singular, as with a joint that moves
        no mass.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, zero quaternions.
        ModelError: a joint moves no mass, and its inertia is constant while tracing.

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
    model = with_constants(model, q.dtype)  # outside of the derivative rule: samples share them
    f_ext = None
    if wrenches is not None:
        d = driver(model, q.dtype)
        f_ext = wrenches_to_links(d, d.joints(q, None), wrenches)
    return acceleration(model, q, v, tau, f_ext)
