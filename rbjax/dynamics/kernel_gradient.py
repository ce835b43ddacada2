"""The reverse gradient of a rollout, in one kernel that walks the steps backwards.

A step's cotangents are those of motion (q+ = q (+) dt v+), of forward dynamics (`kernel_aba.pull`)
and of the model's own forces, in this order.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.experimental import pallas as pl

from rbjax.dynamics.joints import joint_lanes
from rbjax.dynamics.kernel import Block, Plan, driver, gradient_plan, launch, scratch_rows
from rbjax.dynamics.kernel_aba import pull
from rbjax.dynamics.kernel_base import quaternion_cotangent
from rbjax.dynamics.kernel_between import Between
from rbjax.dynamics.kernel_drivers import Cell, KernelRolled, Memory
from rbjax.dynamics.kernel_layout import is_plain
from rbjax.dynamics.kernel_rollout import Controls, every, forces, march
from rbjax.dynamics.manifold import integrate_lanes
from rbjax.dynamics.tracing import opened
from rbjax.lanes import Vec3, as_arrays, is_literal
from rbjax.model import Model


def rollout(
    model: Model, q: jax.Array, v: jax.Array, ctrls: jax.Array | None, dt: jax.Array, *,
    applied: Callable, scan: Callable, steps: int, save_every: int, how: Plan, table: Any = None,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """`kernel_rollout.march` with a reverse gradient: one more kernel for state and controls, and
    `scan(model, q, v, ctrls, dt)` where the model or dt is differentiated, a tableau is given or
    actuators are at sites. No forward mode."""
    given, whole = opened((model, dt))
    plain_only = table is not None or any(site >= 0 for site in model.actuators.sites)

    def run(others, q, v, ctrls, every):
        model, dt = whole(others)
        return march(model, applied, q, v, ctrls, jnp.asarray(dt), steps, every, how, table)

    @jax.custom_vjp
    def f(others, q, v, ctrls):
        return run(others, q, v, ctrls, save_every)

    def forward(*args):
        others, q, v, ctrls = jax.tree.map(lambda x: x.value, args, is_leaf=_is_primal)
        if plain_only or any(x.perturbed for x in args[0]):

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
    return f(given, q, v, ctrls)


def _is_primal(x: Any) -> bool:
    return hasattr(x, "perturbed")


def backward(
    model: Model, applied: Any, q: jax.Array, v: jax.Array, ctrls: jax.Array | None,
    dt: jax.Array, path: tuple[jax.Array, jax.Array], bars: tuple[jax.Array, jax.Array],
    save_every: int, how: Plan,
) -> tuple[jax.Array, jax.Array, jax.Array | None]:  # fmt: skip
    """Cotangents of q, v, ctrls from all states after the first and cotangents of the saved."""
    nq, nv, nu = model.nq, model.nv, model.nu
    steps, size = path[0].shape[0], q.shape[-1]
    how = gradient_plan(model, how)
    if ctrls is not None and not nu:
        out = backward(model, applied, q, v, None, dt, path, bars, save_every, how)
        return out[0], out[1], jnp.zeros_like(ctrls)

    def body(block: Block, ins: Any, outs: Any, memory: Memory) -> None:
        dt_ref, rest = ins[2], ins[7:]
        past = Past(ins, block, steps, save_every)
        ctrl = Controls(rest, block.columns, nu)
        # cotangents of q and v
        rows = memory.take(nq), memory.take(nv)
        every(lambda _, row, i: memory.write(row + i, 0.0), outs[:2], rows, (nq, nv))
        machine = _unrolled if how.driver == "unrolled" else _rolled
        retreat = machine(block, memory, applied, past, rows, dt_ref[0], ctrl, outs)
        jax.lax.fori_loop(0, steps, lambda k, _: (retreat(steps - 1 - k), 0)[1], 0)

        def put(ref, row, i):
            ref[i, block.columns] = memory.read(row + i)

        every(put, outs[:2], rows, (nq, nv))

    inputs = [q, v, dt.reshape(1), *path, *bars] + ([] if ctrls is None else [ctrls])
    shapes: list[tuple] = [(nq, size), (nv, size)]
    if ctrls is not None:
        shapes.append((steps, nu, size))
    need = scratch_rows(model, Plan("rolled"), 56) + 2 * nq
    out = launch(body, model, how, inputs, shapes, need)
    if ctrls is None:
        return out[0], out[1], None
    return out[0], out[1], out[2] if ctrls.ndim == 3 else out[2].sum(-1)


class Past:
    """States before and after step t, and the cotangents of what was saved after it."""

    def __init__(self, refs: Any, block: Block, steps: int, save_every: int):
        self.first, self.path, self.bars = refs[:2], refs[3:5], refs[5:7]
        self.columns, self.like, self.save_every = block.columns, block.like, save_every

    def before(self, which: int, t: Any, i: Any) -> jax.Array:
        """Coordinate i of q (which = 0) or v (1) before step t."""
        earlier = self.path[which][jnp.maximum(t - 1, 0), i, self.columns]
        return jnp.where(t == 0, self.first[which][i, self.columns], earlier)

    def after(self, which: int, t: Any, i: Any) -> jax.Array:
        return self.path[which][t, i, self.columns]

    def bar(self, which: int, t: Any, i: Any) -> jax.Array:
        every = jnp.asarray(self.save_every, t.dtype)  # (lax: Triton has no jnp.remainder)
        is_saved = jax.lax.rem(t + 1, every) == 0
        bar = self.bars[which][jax.lax.div(t, every), i, self.columns]
        return jnp.where(is_saved, bar, jnp.zeros_like(self.like))


def _unrolled(
    block: Block, memory: Memory, applied: Any, past: Past, rows: Any, h: Any, ctrl: Controls,
    outs: Any,
) -> Callable[[Any], None]:  # fmt: skip
    """One step backwards, all links written out."""
    top, like = block.known.model.topology, block.like
    nq, nv = top.nq, top.nv

    def retreat(t: Any) -> None:
        q_bar = [memory.read(rows[0] + i) + past.bar(0, t, i) for i in range(nq)]
        v_bar = [memory.read(rows[1] + i) + past.bar(1, t, i) for i in range(nv)]
        q, v = ([past.before(w, t, i) for i in range(n)] for w, n in ((0, nq), (1, nv)))
        moved = [h * past.after(1, t, i) for i in range(nv)]
        back = jax.vjp(lambda q, dq: as_arrays(integrate_lanes(top, q, dq), like), q, moved)[1]
        q_bar, dq_bar = back(q_bar)
        v_bar = [a + h * b for a, b in zip(v_bar, dq_bar, strict=True)]
        y = [h * x for x in v_bar]
        u = ctrl.lanes(t, like) or []
        act = functools.partial(forces, applied, block)

        def pushed(q, v, u):
            return act(q, v, u if ctrl else None)

        tau, back = jax.vjp(pushed, q, v, u)
        d = driver(block, memory)
        b, raws = pull(d, d.joints(q, v), tau, y, block.gravity, like)
        parts = [back(as_arrays(b, like))]
        parts += [(*_closed(d, block.known, i, q, v, raw), None) for i, raw in enumerate(raws)]
        for q_more, v_more, _ in parts:
            q_bar = [a + x for a, x in zip(q_bar, q_more, strict=True)]
            v_bar = [a + x for a, x in zip(v_bar, v_more, strict=True)]
        for row, lanes in zip(rows, (q_bar, v_bar), strict=True):
            for i, x in enumerate(lanes):
                memory.write(row + i, x)
        for i, x in enumerate(parts[0][2]):
            outs[2][t, i, block.columns] = x

    return retreat


def _closed(d: Any, known: Any, i: int, q: list, v: list, raw: tuple) -> tuple[list, list]:
    """Cotangents of all q and v from those of joint i's varying lanes."""
    constants = known.prepared.link(i)()

    def lanes(q, v):
        leaves = jax.tree.leaves(joint_lanes(d.topology.links[i], constants, q, v, i))
        return [x for x in leaves if not is_literal(x)]

    return jax.vjp(lanes, q, v)[1](list(raw))


def _rolled(
    block: Block, memory: Memory, applied: Any, past: Past, rows: Any, h: Any, ctrl: Controls,
    outs: Any,
) -> Callable[[Any], None]:  # fmt: skip
    """One step backwards, by loops over the links."""
    top, like, columns = block.known.model.topology, block.like, block.columns
    q_bar, v_bar = rows
    q_row = memory.take(top.nq)
    v_row, taus, ys = (memory.take(top.nv) for _ in range(3))
    between = Between(block, applied, bool(ctrl))
    d: Any = driver(block, memory)
    used = memory.used

    def q(i: Any) -> jax.Array:
        return memory.read(q_row + i)

    def v(i: Any) -> jax.Array:
        return memory.read(v_row + i)

    def more(row: Any, x: Any) -> None:
        memory.write(row, memory.read(row) + x)

    # In a loop all rows are read before any is written: a read after a write would wait for it.

    def enter(t: Any) -> Callable:
        """A joint's state before the step, its cotangents after it, and its force."""

        def one(i, at, actuator):
            angle, speed = past.before(0, t, at), past.before(1, t, i)
            angle_bar = memory.read(q_bar + at) + past.bar(0, t, at)
            speed_bar = memory.read(v_bar + i) + past.bar(1, t, i) + h * angle_bar
            u = ctrl.read(t, jnp.maximum(actuator, 0)) if between.actuated else None
            tau = between.force(i, at, actuator, angle, speed, u)
            for row, x in (
                (q_row + at, angle), (v_row + i, speed), (q_bar + at, angle_bar),
                (v_bar + i, speed_bar), (taus + i, tau), (ys + i, h * speed_bar),
            ):  # fmt: skip
                memory.write(row, x)

        return one

    def enter_rest(t: Any) -> None:
        """The same for joints that are written out."""
        for row, bar, which, places in (
            (q_row, q_bar, 0, between.rest_q), (v_row, v_bar, 1, between.rest),
        ):  # fmt: skip
            for i in places:
                memory.write(row + i, past.before(which, t, i))
                more(bar + i, past.bar(which, t, i))
        given = [q(i) for i in between.rest_q], [v(i) for i in between.rest]
        moved = [h * past.after(1, t, i) for i in between.rest]
        back = jax.vjp(between.rest_moved, given[0], moved)[1]
        q_more, dq_bar = back([memory.read(q_bar + i) for i in between.rest_q])
        for i, x in zip(between.rest_q, q_more, strict=True):
            memory.write(q_bar + i, x)
        tau = between.rest_forces(*given, ctrl.lanes(t, like, between.rest_u))
        for i, x, bar in zip(between.rest, tau, dq_bar, strict=True):
            more(v_bar + i, h * bar)
            memory.write(taus + i, x)
            memory.write(ys + i, h * memory.read(v_bar + i))

    def leave(t: Any, b: Any, raw: Any) -> Callable:
        """Cotangents of a joint's force, and of its motion where all are hinges."""

        def one(i, at, actuator):
            given = [q(at), v(i)]
            if between.actuated:
                u = ctrl.read(t, jnp.maximum(actuator, 0))
                given.append(jnp.broadcast_to(u, like.shape))

            def pushed(q, v, u=None):
                return between.force(i, at, actuator, q, v, u)

            bars = jax.vjp(pushed, *given)[1](memory.read(b.row + i))
            turn, rate = d.at(raw, i) if d.plain else (0.0, 0.0)
            angle_bar = memory.read(q_bar + at) + (bars[0] + turn)
            speed_bar = memory.read(v_bar + i) + (bars[1] + rate)
            memory.write(q_bar + at, angle_bar)
            memory.write(v_bar + i, speed_bar)
            if not between.actuated:
                return
            if between.all_actuated:
                outs[2][t, actuator, columns] = bars[2]
                return

            @pl.when(actuator >= 0)
            def _():
                outs[2][t, actuator, columns] = bars[2]

        return one

    def leave_rest(t: Any, b: Any) -> None:
        """Cotangents of the forces on joints that are written out."""
        u = ctrl.lanes(t, like, between.rest_u) or []

        def pushed(q, v, u):
            return between.rest_forces(q, v, u if ctrl else None)

        given = [q(i) for i in between.rest_q], [v(i) for i in between.rest]
        back = jax.vjp(pushed, *given, u)[1]
        q_more, v_more, u_bar = back([memory.read(b.row + i) for i in between.rest])
        for row, places, lanes in ((q_bar, between.rest_q, q_more), (v_bar, between.rest, v_more)):
            for i, x in zip(places, lanes, strict=True):
                more(row + i, x)
        for k, x in zip(between.rest_u, u_bar, strict=False):  # (none without controls)
            outs[2][t, k, columns] = x

    def retreat(t: Any) -> None:
        memory.used = used
        if between.rest or between.rest_u:
            enter_rest(t)
        between.each(enter(t))
        joints = d.joints(q, Cell(row=v_row))
        b, raw = pull(d, joints, Cell(row=taus), Cell(row=ys), block.gravity, like)
        if d.base is not None:
            turn, spin = d.base.transposed(*d.arrived, like)
            for i, x in enumerate(turn):
                more(q_bar + 3 + i, x)
            for i, x in enumerate(spin):
                more(v_bar + 3 + i, x)
        between.each(leave(t, b, raw))
        if between.rest or between.rest_u:
            leave_rest(t, b)
        left = between.rest if d.plain else range(top.nv)
        _close(d, raw, more, q, rows, [i for i in left if i >= d.first])

    return retreat


def _close(
    d: KernelRolled, raw: Any, more: Callable, q: Callable, rows: Any, links: list[int]
) -> None:
    """Add what turns, slides and speeds of the links say to the cotangents of q and v."""
    q_bar, v_bar = rows
    for i in links:
        link = d.topology.links[i]
        lanes = d.at(raw, i)
        if d.plain:
            more(q_bar + link.q, lanes[0])
            more(v_bar + i, lanes[1])
            continue
        x, y, z, slide, *rate, qd = lanes
        more(v_bar + i, qd)
        if link.kind == "slide":
            more(q_bar + link.q, slide)
        elif is_plain(link):
            more(q_bar + link.q, z)
            more(v_bar + i, rate[2])
        elif link.quaternion:  # its axes are z, x, y of the body
            turn = quaternion_cotangent([q(link.q + k) for k in range(4)], Vec3(z, x, y))
            for k, bar in enumerate(turn):
                more(q_bar + link.q + k, bar)
            for k, bar in zip((1, 2, 0), rate, strict=True):
                more(v_bar + i + k, bar)
