"""Articulated-body algorithm: forward dynamics in O(n) (Featherstone, ch. 7).

The recursion uses the classical acceleration of each link's origin (Newton-Euler form). It then
needs no linear velocities (Luh, Walker & Paul 1980). Forces add as spatial forces about the origin.

    outward   w = E w_p + rate;   c = bias acceleration;   p = [w x J w; w x (w x h)]
    inward    U = I_A S;  D = S.U + armature;  u = tau - S.p_A
              to the parent: X^T (I_A - U U^T / D),  X^T (p_A + I_a c + U u / D)
    outward   a' = X(a_p) + c;  qdd = (u - U.a') / D;  a = a' + S qdd

The coordinates of a flexible link are eliminated in the same way, after the messages of its frames
have been summed (factors.py).

The derivative does not differentiate ABA. With a = FD(q, v, tau), ID(q, v, a) = tau gives

    da = M^-1 (dtau - dID(q, v, a)),

one tangent of RNEA and one solution with the factors of ABA (Carpentier & Mansard 2018). With
flexible links, the reverse derivative of RNEA is the gradient of a virtual power (virtual_power),
and the reverse solution has the same factors, because M is symmetric. If a flexible
link carries links, the gradient needs their accelerations, from ABA, and their virtual twists: the
reverse solution has them as cotangents of bias forces p, which are zero. On a GPU the reverse
derivative reads the acceleration and the factors of the forward pass.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rbjax.arguments import ArrayLike
from rbjax.compiler.jax.function import trace
from rbjax.compiler.jax.launch import has_gpu
from rbjax.compiler.jax.primitive import run
from rbjax.dynamics.algorithms.factors import (
    AnyFactor,
    Column,
    Factor,
    FrameFactor,
    add_columns,
    columns_of_frame,
    eliminate_coordinate,
    name_link_factors,
)
from rbjax.dynamics.algorithms.kinematics import velocity_bias
from rbjax.dynamics.algorithms.rnea import (
    NO_FORCE,
    LinkForces,
    add_blocks,
    per_link,
    rnea,
    wrenches_to_links,
)
from rbjax.dynamics.algorithms.virtual_power import (
    motions_of,
    rows_of_motions,
    with_gradient_of_power,
)
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.dynamics.tracing.custom_rules import (
    jax_arrays,
    split_tracers,
    with_implicit_jvp,
)
from rbjax.errors import ModelError
from rbjax.joints import JointMotion
from rbjax.joints.joint import Block
from rbjax.lanes import Lane, Sym3, Vec3, add, batch_first, is_zero
from rbjax.model import LinkConstants, Model, with_constants
from rbjax.spatial import ArticulatedInertia, Force, Motion, Transform


class VelocityStep(NamedTuple):
    """Pose X of a link in its parent, angular velocity w, and bias acceleration c at (q, v)."""

    X: Transform
    w: Vec3
    c: Motion


class Message(NamedTuple):
    """The message of a link to its parent: articulated inertia, bias force, and the columns and
    generalized bias forces of the coordinates of a flexible link."""

    I_A: ArticulatedInertia
    p_A: Force
    columns: Sequence[Column]
    forces: Block


def eliminate(
    link: LinkConstants,
    joint: JointMotion,
    X: Transform,
    I_A: ArticulatedInertia,
    block: Sequence[Column] = (),
) -> tuple[ArticulatedInertia, AnyFactor, Sequence[Column]]:
    """Eliminate a dof.

    Return the articulated inertia that remains across it, its factor, and the columns of those
    coordinates of a flexible link that are not eliminated yet.
    """
    if joint.frame_axes is not None:
        return I_A, FrameFactor(X, joint.frame_axes), columns_of_frame(joint.frame_axes, X, I_A)
    if joint.coordinate_of is not None:
        return eliminate_coordinate(link.armature, X, I_A, block, joint.coordinate_of)
    S = joint.S
    U = I_A(S)
    D = add(S.dot(U), link.armature)
    if is_zero(D):
        raise ModelError(
            "a joint of the model moves no mass, so the mass matrix is singular; give its body "
            "mass and inertia (bodies.mass, bodies.inertia), or the joint armature"
        )
    inverse_D = 1.0 / D
    return I_A.without(U, inverse_D, S, link.armature), Factor(X, S, U, inverse_D), ()


def to_parent(
    X: Transform, I_a: ArticulatedInertia, factor: AnyFactor, mass: Lane | None
) -> ArticulatedInertia:
    """Compute X^T I_a X, the inertia in the axes of the parent, about its origin.

    `mass` is the result of `rigid_mass`. If it is not None, the linear block of I_a is m 1 - U U^T
    / D. Then only the vector U is rotated, in place of this block.
    """
    if mass is None or not isinstance(factor, Factor):
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
    rigid = joint.frame_axes is None and joint.coordinate_of is None
    return joint.inertia(link).m if tip and rigid else None


def aba(
    d: Driver,
    joints: Any,
    tau: Any,
    gravity: Vec3,
    f_ext: LinkForces | None = None,
    *,
    twists: bool = False,
) -> tuple[Any, ...]:
    """Compute the joint acceleration of each link, and the factors of the mass matrix.
    twists: whether to return the accelerations of links too, in their own axes."""

    def outward(x, w_parent):
        link, joint, *_ = x
        X = joint.transform(link)
        w, c = velocity_bias(joint, X, w_parent)
        return w, VelocityStep(X, w, c)

    def inward(x, message):
        (link, joint, tau, push), motion = x
        inertia = joint.inertia(link)
        p_A = inertia.bias_force(motion.w) - push + message.p_A
        I_A, columns, forces = inertia.articulated() + message.I_A, message.columns, message.forces
        own = joint.link_inertia(motion.w)
        if own is not None:
            I_A, p_A = I_A + own.rigid.articulated(), p_A + own.bias_force(motion.w)
            columns, forces = add_columns(own, columns), add_blocks(own.forces, forces)
        I_a, factor, columns = eliminate(link, joint, motion.X, I_A, columns)
        u, p_a, forces = factor.inward(tau, p_A, forces, I_a(motion.c))
        mass = rigid_mass(link, joint, message.I_A)
        I_parent = to_parent(motion.X, I_a, factor, mass)
        return Message(I_parent, motion.X.T(p_a), columns, forces), (factor, u, motion.c)

    zero = Message(ArticulatedInertia.zero(), Force.zero(), (), ())
    xs = d.zip(d.constants, joints, tau, per_link(d, f_ext))
    ys = d.out_and_in(outward, Vec3.zero(), inward, zero, xs)

    def accelerate(x, parent):
        factor, u, c = x
        a, qdd, block = factor.outward(u, factor.X(parent[0]) + c, parent[1])
        return (a, block), (qdd, factor, a) if twists else (qdd, factor)

    found = d.outward(accelerate, (Motion(Vec3.zero(), -gravity), ()), ys)
    return d.unzip(found, 2 + twists)


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
    inertia: values per link, and the function that converts a value to the `ArticulatedInertia` to
        add to the link, in its axes; None for zero.
    poses: `transforms` of the links; None to compute them here. With them, a derivative that saves
        U and 1 / D need not repeat the sweep for the other parts of the factors.
    """

    def inward(x, children):
        link, joint, more, own, *known = x
        link = replace(link, armature=add(link.armature, more))
        X = known[0] if known else joint.transform(link)
        others, columns = children[0] + convert(own), children[1]
        I_A, flexible = joint.inertia(link).articulated() + others, joint.link_inertia(Vec3.zero())
        if flexible is not None:
            I_A, columns = I_A + flexible.rigid.articulated(), add_columns(flexible, columns)
        I_a, factor, columns = eliminate(link, joint, X, I_A, columns)
        I_parent = to_parent(X, I_a, factor, rigid_mass(link, joint, others))
        return (I_parent, columns), factor

    zero, extra = ArticulatedInertia.zero(), d.scattered({}, 0.0) if extra is None else extra
    values, convert = (extra, lambda _: zero) if inertia is None else inertia
    given = d.constants, joints, extra, values, *(() if poses is None else (poses,))
    return d.inward(inward, (zero, ()), d.zip(*given))


def solve(d: Driver, factors: Any, tau: Any, outward: Any = None, p: Any = None) -> Any:
    """Compute M^-1 (tau - sum of J_i^T p_i) from the factors: ABA without velocities and gravity.

    outward: an optional second copy of the factors for the outward sweep, to save registers.
    p: lanes of the bias forces (6), in the axes of the links, per link; None for zero.
    """
    ys = solve_inward(d, factors, tau, p)
    if outward is not None:
        ys = d.zip(outward, d.part(ys, 1))
    return solve_outward(d, ys)


def solve_inward(d: Driver, factors: Any, tau: Any, p: Any = None) -> Any:
    """Run the inward sweep of `solve`. Return (factor, u) per link.

    u is the joint force that remains after the elimination of the subtree of the link.
    p: lanes of the bias forces (6), in the axes of the links, per link; None for zero.
    """

    def inward(x, children):
        factor, tau, *p = x
        own = sum(map(Force.from_lanes, p), children[0])
        u, p_a, block = factor.inward(tau, own, children[1], Force.zero())
        return (factor.X.T(p_a), block), (factor, u)

    return d.inward(inward, NO_FORCE, d.zip(factors, tau, *(() if p is None else (p,))))


def solve_outward(d: Driver, ys: Any, *, twists: bool = False) -> Any:
    """Run the outward sweep of `solve`: joint accelerations from (factor, u) per link.
    twists: whether to return the spatial accelerations of the links too, in their own axes."""

    def outward(x, parent):
        factor, u = x
        a, qdd, block = factor.outward(u, factor.X(parent[0]), parent[1])
        return (a, block), (qdd, a) if twists else qdd

    return d.outward(outward, (Motion.zero(), ()), ys)


def symmetric_solve(d: Driver, factors: Any, tau: jax.Array, *p: jax.Array) -> list[jax.Array]:
    """Compute a = M^-1 (tau - sum of J_i^T p_i) from the factors, as a program that is its own
    transpose.

    p: nothing, or bias forces (6, links) of `links_in_motion`. The second result is then the twists
        J_i a of these links.
    """

    def both(tau: jax.Array, *p: jax.Array) -> list[jax.Array]:
        ys = solve_inward(d, factors, d.lanes(tau), *(motions_of(d, x) for x in p))
        a, twists = d.unzip(solve_outward(d, ys, twists=True), 2)
        return [d.pack(a, tau), *(rows_of_motions(d, twists, tau) for _ in p)]

    plain, closed_over = trace(both, (tau, *p))
    n = len(closed_over)

    def vjp(moving: tuple[bool, ...], args: Any, _: Any, bars: Any) -> list[jax.Array]:
        pairs = zip(bars, plain.outputs, strict=True)
        w, *z = (jnp.zeros(y.shape, y.dtype) if x is None else x for x, y in pairs)
        if any(moving[:n]):  # by the factors, in a second derivative
            has_cotangent = (True,) * len(bars)
            return run(plain.transposed(moving, has_cotangent), [*args, w, *z])
        # by tau: M^-1 (w + sum of J_i^T z_i), by p_i: -J_i times this
        a, *twists = run(program, [*args[:n], w, *(-x for x in z)])
        return list(itertools.compress([a, *(-x for x in twists)], moving[n:]))

    program = replace(plain, vjp=vjp)
    return run(program, [*closed_over, tau, *p])


def saves_factors(model: Model, *args: Any, **others: Any) -> bool:
    """Return whether a reverse derivative saves the acceleration and the factors: on a GPU, for a
    tree with flexible links. One kernel for both passes exceeds the 128 KiB instruction cache."""
    return bool(model.topology.frames) and has_gpu()


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
    top = model.topology
    in_series = any(parent >= top.nv for parent in top.parents)  # a flexible link carries a link

    def plain(*at):
        changed, q, v, tau = at
        model, f_ext = rebuilt(changed)
        d = driver(model, q.dtype)
        qdd, _ = aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity, f_ext)
        return batch_first((d.pack(qdd, tau),), at)

    def solved(changed, q, v, tau):
        model, f_ext = rebuilt(changed)
        d = driver(model, q.dtype)
        joints, forces = d.joints(q, v), d.lanes(tau)
        qdd, factors, *links = aba(d, joints, forces, d.prepared.gravity, f_ext, twists=in_series)
        a, factors = checkpoint_name(d.pack(qdd, tau), "acceleration"), name_link_factors(factors)
        rows = [checkpoint_name(rows_of_motions(d, x, tau), "acceleration") for x in links]

        if not top.frames:
            return (a,), [lambda change: d.pack(solve(d, factors, d.lanes(change[0])), tau)]
        return (a,), [lambda change: symmetric_solve(d, factors, *change)[0]], *rows

    def residual(changed, q, v, tau, a, *links):
        model, f_ext = rebuilt(changed)
        if model.topology.frames:
            forces, *p = with_gradient_of_power(rnea, model, q, v, a, f_ext, *links)
            return [tau - forces, *p]
        d = driver(model, q.dtype)
        forces = rnea(d, d.joints(q, v), d.lanes(a), d.prepared.gravity, f_ext)
        return [tau - d.pack(forces, tau)]

    return with_implicit_jvp(plain, solved, residual)(*jax_arrays(given, q, v, tau))[0]


@algorithm("q", "v", "tau", "wrenches", long=True, saves=saves_factors)
def forward_dynamics(
    model: Model, q: ArrayLike, v: ArrayLike, tau: ArrayLike, wrenches: ArrayLike | None = None
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
