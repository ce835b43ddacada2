"""The reverse gradient of a rollout, in one kernel that walks the steps backwards.

With a = FD(q, v, tau), ID(q, v, a) = tau. For a cotangent y of a the cotangent of tau is
b = M^-1 y, and those of q and v are b's product with -d ID(q, v, a) / d(q, v). So a step takes

    outward   angular velocities
    inward    articulated inertias; bias forces for tau and, at rest, for y
    outward   accelerations a, and b with the accelerations that b alone would cause
    inward    the transposed step of RNEA, whose cotangents of forces are those accelerations

and no ABA is differentiated (Carpentier & Mansard 2018, transposed).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from rbjax.dynamics.aba import bias_force, eliminate, swing
from rbjax.dynamics.joints import JointMotion, joint_lanes
from rbjax.dynamics.kernel import Block, Plan, driver, launch, scratch_rows
from rbjax.dynamics.kernel_drivers import _HINGE, KernelUnrolled, Memory
from rbjax.dynamics.kernel_rollout import controls, forces, march
from rbjax.dynamics.manifold import integrate_lanes
from rbjax.lanes import Vec3, as_arrays, is_literal, mul, rotation_z, sub
from rbjax.model import Model
from rbjax.spatial import ArticulatedInertia, Force, Motion


def pull(d: Any, joints: Any, tau: Any, y: Any, gravity: Vec3, like: jax.Array) -> tuple[Any, Any]:
    """b = M^-1 y per link, and per link the cotangents of its joint motion (see `_opened`)."""

    def spin(x, w_parent):
        w, moved = swing(x, w_parent)
        return w, (moved, w_parent)

    swings = d.outward(spin, Vec3.zero(), d.zip(d.constants, joints))

    def inward(x, message):
        link, joint, (motion, w_parent), tau, y = x
        p = bias_force(link.inertia, motion.w) + message[1]
        I_a, factor = eliminate(link, joint.S, motion.X, link.inertia.articulated() + message[0])
        u = mul(sub(tau, joint.S.dot(p)), factor.inverse_D)
        z = mul(sub(y, joint.S.dot(message[2])), factor.inverse_D)
        p = p + I_a(motion.c) + factor.U * u
        rest = message[2] + factor.U * z
        V = factor.U * factor.inverse_D
        X = motion.X
        return (X.articulated_to_parent(I_a), X.T(p), X.T(rest)), (X, V, u, z, motion.c, w_parent)

    zero = (ArticulatedInertia.zero(), Force.zero(), Force.zero())
    ys = d.inward(inward, zero, d.zip(d.constants, joints, swings, tau, y))

    def outward(x, parent):
        joint, (X, V, u, z, c, w_parent) = x
        a, e = X(parent[0]) + c, X(parent[1])
        qdd, b = sub(u, V.dot(a)), sub(z, V.dot(e))
        return (a + joint.S * qdd, e + joint.S * b), (qdd, b, w_parent, *parent)

    root = (Motion(Vec3.zero(), -gravity), Motion.zero())
    found = d.outward(outward, root, d.zip(joints, ys))

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
    raw, b = out
    return b, raw


def _opened(joint: JointMotion, like: jax.Array) -> tuple[list, Any]:
    """The lanes of a joint motion that vary, and the way back. A plain hinge met by index varies
    by a small turn and by its speed; any other joint by all lanes that are not literal."""
    hinge = getattr(joint, "hinge", None)
    if hinge is not None:
        c, s, qd = hinge

        def turned(raw):
            e, qd = raw
            J = rotation_z(c - s * e, s + c * e)
            return JointMotion(J, 0.0, _HINGE, Vec3(0.0, 0.0, qd), qd)

        return [jnp.zeros_like(like), qd], turned
    plain = JointMotion(joint.J, joint.slide, joint.S, joint.rate, joint.qd)
    leaves, treedef = jax.tree.flatten(plain)

    def built(raw):
        rest = iter(raw)
        return jax.tree.unflatten(treedef, [x if is_literal(x) else next(rest) for x in leaves])

    return [x for x in leaves if not is_literal(x)], built


def _closed(d: Any, known: Any, i: int, q: list, v: list, raw: tuple) -> tuple[list, list]:
    """Cotangents of all q and v from those of joint i's varying lanes."""
    constants = known.prepared.link(i)()

    def lanes(q, v):
        leaves = jax.tree.leaves(joint_lanes(d.topology.links[i], constants, q, v, i))
        return [x for x in leaves if not is_literal(x)]

    return jax.vjp(lanes, q, v)[1](list(raw))


def rollout(
    model: Model, q: jax.Array, v: jax.Array, ctrls: jax.Array | None, dt: jax.Array, *,
    applied: Callable, scan: Callable, steps: int, save_every: int, how: Plan,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """`kernel_rollout.march` with a reverse gradient: one more kernel for state and controls, and
    `scan(model, q, v, ctrls, dt)` where the model or dt is differentiated. No forward mode."""
    leaves, treedef = jax.tree.flatten((model, dt))
    moving = [i for i, x in enumerate(leaves) if isinstance(x, jax.core.Tracer)]

    def whole(others: list) -> tuple[Model, jax.Array]:
        filled = list(leaves)
        for i, x in zip(moving, others, strict=True):
            filled[i] = x
        return jax.tree.unflatten(treedef, filled)

    def run(others, q, v, ctrls, every):
        model, dt = whole(others)
        return march(model, applied, q, v, ctrls, jnp.asarray(dt), steps, every, how)

    @jax.custom_vjp
    def f(others, q, v, ctrls):
        return run(others, q, v, ctrls, save_every)

    def forward(*args):
        others, q, v, ctrls = jax.tree.map(lambda x: x.value, args, is_leaf=_is_primal)
        if any(x.perturbed for x in args[0]):

            def plain(others, q, v, ctrls):
                model, dt = whole(others)
                return scan(model, q, v, ctrls, dt)

            out, back = jax.vjp(plain, others, q, v, ctrls)
            return out, (back, None)
        path = run(others, q, v, ctrls, 1)
        return tuple(x[save_every - 1 :: save_every] for x in path), (
            None, (others, q, v, ctrls, path)
        )  # fmt: skip

    def reverse(kept, bars):
        zeros = [jnp.zeros(x.shape, x.dtype) if isinstance(x, SymbolicZero) else x for x in bars]
        back, given = kept
        if back is not None:
            return back(tuple(zeros))
        others, q, v, ctrls, path = given
        model, dt = whole(others)
        out = backward(
            model, applied, q, v, ctrls, jnp.asarray(dt), path, tuple(zeros), save_every, how
        )
        return (None, *out)

    f.defvjp(forward, reverse, symbolic_zeros=True)
    return f([leaves[i] for i in moving], q, v, ctrls)


def _is_primal(x: Any) -> bool:
    return hasattr(x, "perturbed")


def backward(
    model: Model, applied: Any, q: jax.Array, v: jax.Array, ctrls: jax.Array | None,
    dt: jax.Array, path: tuple[jax.Array, jax.Array], bars: tuple[jax.Array, jax.Array],
    save_every: int, how: Plan,
) -> tuple[jax.Array, jax.Array, jax.Array | None]:  # fmt: skip
    """Cotangents of q, v, ctrls from all states after the first and cotangents of the saved."""
    top, nq, nv, nu = model.topology, model.nq, model.nv, model.nu
    steps, size = path[0].shape[0], q.shape[-1]

    def body(block: Block, ins: Any, outs: Any, memory: Memory) -> None:
        q_ref, v_ref, dt_ref, qs_ref, vs_ref, q_bars, v_bars, *rest = ins
        h, cols, like = dt_ref[0], block.columns, block.like
        state, speed, taus, ys = (memory.take(n) for n in (nq + nv, nv, nv, nv))
        q_now = memory.take(nq)
        for i in range(nq + nv):
            memory.write(state + i, 0.0)
        d: Any = driver(block, memory)
        used = memory.used

        def arrays(x: Any) -> Any:
            return as_arrays(x, like)

        def advance(k: Any, _: Any) -> Any:
            memory.used = used
            t = steps - 1 - k
            q_bar = [memory.read(state + i) for i in range(nq)]
            v_bar = [memory.read(state + nq + i) for i in range(nv)]
            every = jnp.asarray(save_every, t.dtype)  # (lax: Triton has no jnp.remainder)
            is_saved = jax.lax.rem(t + 1, every) == 0
            s = jax.lax.div(t, every)

            def given(ref, i):
                return jnp.where(is_saved, ref[s, i, cols], jnp.zeros_like(like))

            q_bar = [x + given(q_bars, i) for i, x in enumerate(q_bar)]
            v_bar = [x + given(v_bars, i) for i, x in enumerate(v_bar)]
            before = jnp.maximum(t - 1, 0)
            is_first = t == 0
            q = [jnp.where(is_first, q_ref[i, cols], qs_ref[before, i, cols]) for i in range(nq)]
            v = [jnp.where(is_first, v_ref[i, cols], vs_ref[before, i, cols]) for i in range(nv)]
            moved = [h * vs_ref[t, i, cols] for i in range(nv)]
            back = jax.vjp(lambda q, dq: arrays(integrate_lanes(top, q, dq)), q, moved)[1]
            q_bar, dq_bar = back(q_bar)
            v_bar = [a + h * b for a, b in zip(v_bar, dq_bar, strict=True)]
            y = [h * x for x in v_bar]
            ctrl = controls(rest[0] if rest else None, cols, nu, t)
            ctrl = [] if ctrl is None else arrays(ctrl)
            act = functools.partial(forces, applied, block)

            def pushed(q, v, ctrl):
                return act(q, v, ctrl if rest else None)

            tau = pushed(q, v, ctrl)
            if isinstance(d, KernelUnrolled):
                b, raws = pull(d, d.joints(q, v), tau, y, block.gravity, like)
                q_bar, v_bar = list(q_bar), list(v_bar)
            else:
                for i in range(nv):
                    memory.write(speed + i, v[i])
                    memory.write(taus + i, tau[i])
                    memory.write(ys + i, y[i])
                for i in range(nq):
                    memory.write(q_now + i, q[i])
                joints = d.joints(
                    lambda i: memory.read(q_now + i), lambda i: memory.read(speed + i), speed
                )
                b, raw = pull(d, joints, d.rows(taus), d.rows(ys), block.gravity, like)
                b = [d.read(b, i) for i in range(nv)]
                raws = [jax.tree.map(lambda c: memory.read(c.row), x) for x in raw.head]
                q = [memory.read(q_now + i) for i in range(nq)]
                v = [memory.read(speed + i) for i in range(nv)]
                q_bar, v_bar = list(q_bar), list(v_bar)
                for i in range(d.head, nv):
                    turn, rate = (memory.read(c.row + i) for c in raw.body)
                    at = top.links[i].q
                    q_bar[at], v_bar[i] = q_bar[at] + turn, v_bar[i] + rate
            b = arrays(b)
            parts = [jax.vjp(pushed, q, v, ctrl)[1](b)]
            for i, raw_i in enumerate(raws):
                parts.append((*_closed(d, block.known, i, q, v, raw_i), None))
            for q_more, v_more, _ in parts:
                q_bar = [a + x for a, x in zip(q_bar, q_more, strict=True)]
                v_bar = [a + x for a, x in zip(v_bar, v_more, strict=True)]
            for i, x in enumerate([*q_bar, *v_bar]):
                memory.write(state + i, x)
            for i, x in enumerate(parts[0][2]):
                outs[2][t, i, cols] = x
            return 0

        jax.lax.fori_loop(0, steps, advance, 0)
        for i in range(nq):
            outs[0][i, cols] = memory.read(state + i)
        for i in range(nv):
            outs[1][i, cols] = memory.read(state + nq + i)

    inputs = [q, v, dt.reshape(1), *path, *bars] + ([] if ctrls is None else [ctrls])
    shapes: list[tuple] = [(nq, size), (nv, size)]
    if ctrls is not None:
        shapes.append((steps, nu, size))
    rows = scratch_rows(model, Plan("rolled"), 64) + 2 * nq + 4 * nv
    out = launch(body, model, how, inputs, shapes, rows)
    if ctrls is None:
        return out[0], out[1], None
    return out[0], out[1], out[2] if ctrls.ndim == 3 else out[2].sum(-1)
