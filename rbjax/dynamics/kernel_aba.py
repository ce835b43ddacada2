"""ABA with a second right-hand side, and the transposed derivative of forward dynamics.

With a = FD(q, v, tau), ID(q, v, a) = tau. For a cotangent y of a the cotangent of tau is
b = M^-1 y, and those of q and v are b's product with -d ID(q, v, a) / d(q, v). So a step takes

    outward   angular velocities
    inward    articulated inertias; bias forces for tau and, at rest, for y
    outward   accelerations a, and b with the accelerations that b alone would cause
    inward    the transposed step of RNEA, whose cotangents of forces are those accelerations

and no ABA is differentiated (Carpentier & Mansard 2018, transposed). The first three sweeps,
without y, are forward dynamics.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.aba import bias_force, eliminate, swing
from rbjax.dynamics.joints import JointMotion
from rbjax.dynamics.kernel_drivers import HINGE, KernelRolled
from rbjax.lanes import Mat3, Vec3, as_arrays, is_literal, mul, rotation_z, sub
from rbjax.spatial import ArticulatedInertia, Force, Motion


def accelerations(d: KernelRolled, joints: Any, tau: Any, gravity: Vec3) -> Any:
    """FD per link, by the rolled driver."""
    return _sweeps(d, joints, tau, None, gravity)[0]


def pull(d: Any, joints: Any, tau: Any, y: Any, gravity: Vec3, like: jax.Array) -> tuple[Any, Any]:
    """b = M^-1 y per link, and per link the cotangents of its joint motion (see `_opened`).

    Those of a floating base wait in `d.arrived` for `FloatingBase.transposed`."""
    b, found, keep = _sweeps(d, joints, tau, y, gravity)

    def transposed(x, message):
        link, joint, (qdd, b, w_parent, a_parent, e_parent) = x
        children, w_bar, a_bar = message
        raw, build = _opened(joint, like)

        def local(raw, w_parent, a_parent):
            joint = build(raw)
            w, moved = swing((link, joint), w_parent)
            a = moved.X(a_parent) + moved.c + joint.S * qdd
            f = link.inertia(a) + bias_force(link.inertia, w) + children
            return as_arrays((w, a, moved.X.T(f), joint.S.dot(f)), like)

        given = as_arrays((raw, w_parent, a_parent), like)
        (_, _, f, _), back = jax.vjp(local, *given)
        force_bar = Force(-e_parent.ang, -e_parent.lin)
        bars = as_arrays((w_bar, a_bar, force_bar, -b), like)
        raw_bar, w_bar, a_bar = back(bars)
        return (f, w_bar, a_bar), (tuple(raw_bar), b)

    zero = (Force.zero(), Vec3.zero(), Motion.zero())
    out = d.inward(transposed, zero, d.zip(d.constants, joints, found))
    if isinstance(out, list):
        return [b for _, b in out], [raw for raw, _ in out]
    if d.base is not None:
        d.arrived = (d.arrived, *keep())
    return b, out and out[0]


def _sweeps(d: Any, joints: Any, tau: Any, y: Any, gravity: Vec3) -> tuple[Any, Any, Any]:
    """The first three sweeps: accelerations (or b, where y is given), and what the fourth needs."""
    twice = y is not None

    def spin(x, w_parent):
        w, moved = swing(x, w_parent)
        return w, (moved, w_parent) if twice else (moved, None)

    w_root = Vec3.zero() if d.base is None else d.base.spin
    swings = d.outward(spin, w_root, d.zip(d.constants, joints))

    def inward(x, message):
        link, joint, (motion, w_parent), tau, *y = x
        p = bias_force(link.inertia, motion.w) + message[1]
        I_a, factor = eliminate(link, joint.S, motion.X, link.inertia.articulated() + message[0])
        X, U = motion.X, factor.U
        u = mul(sub(tau, joint.S.dot(p)), factor.inverse_D)
        p = p + I_a(motion.c) + U * u
        up = X.articulated_to_parent(I_a), X.T(p)
        V = U * factor.inverse_D
        if not twice:
            return up, (X, V, u, motion.c)
        z = mul(sub(y[0], joint.S.dot(message[2])), factor.inverse_D)
        return (*up, X.T(message[2] + U * z)), (X, V, u, motion.c, z, w_parent)

    zero = (ArticulatedInertia.zero(), Force.zero(), Force.zero())[: 3 if twice else 2]
    rest = (tau, y) if twice else (tau,)
    ys = d.inward(inward, zero, d.zip(d.constants, joints, swings, *rest))
    a_root, e_root, keep = Motion(Vec3.zero(), -gravity), Motion.zero(), None
    if d.base is not None:
        forces = [None if x is None else [d.at(x, i) for i in range(6)] for x in (tau, y)]
        a_root, qdd, e, b = d.base.solve(d.arrived, *forces, gravity)
        e_root = e if twice else e_root
        keep = d.memory.keep((a_root, e_root) if twice else None)
        head = d.memory.keep(b if twice else qdd)

    def outward(x, parent):
        joint, (X, V, u, c, *second) = x
        a = X(parent[0]) + c
        qdd = sub(u, V.dot(a))
        a = a + joint.S * qdd
        if not twice:
            return (a,), qdd
        z, w_parent = second
        e = X(parent[1])
        b = sub(z, V.dot(e))
        return (a, e + joint.S * b), (qdd, b, w_parent, *parent)

    root = (a_root, e_root) if twice else (a_root,)
    found = d.outward(outward, root, d.zip(joints, ys))
    if isinstance(found, list):
        return None, found, keep
    result = found and (found[1] if twice else found)
    if d.base is not None:
        result = d.joined(head(), result)
    return result, found, keep


def _opened(joint: JointMotion, like: jax.Array) -> tuple[list, Any]:
    """The lanes of a joint motion that vary, and the way back. A link of a loop varies by a small
    turn and its speed, and by slide and rate where joints differ in kind; a link written out by
    all lanes that are not literal."""
    none = jnp.zeros_like(like)
    if not hasattr(joint, "hinge"):
        leaves, treedef = jax.tree.flatten(joint)

        def built(raw):
            rest = iter(raw)
            return jax.tree.unflatten(treedef, [x if is_literal(x) else next(rest) for x in leaves])

        return [x for x in leaves if not is_literal(x)], built
    if joint.hinge is not None:
        c, s, qd = joint.hinge

        def turned(raw):
            e, qd = raw
            J = rotation_z(c - s * e, s + c * e)
            return JointMotion(J, 0.0, HINGE, Vec3(0.0, 0.0, qd), qd)

        return [none, qd], turned

    def moved(raw):
        x, y, z, slide, *rate, qd = raw
        J = joint.J @ Mat3(1.0, -z, y, z, 1.0, -x, -y, x, 1.0)
        return JointMotion(J, slide, joint.S, Vec3(*rate), qd)

    return [none, none, none, joint.slide, *joint.rate, joint.qd], moved
