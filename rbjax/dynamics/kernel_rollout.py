"""Whole rollouts in one kernel: the state stays in the block between the steps.

    v+ = v + dt a(q, v, u),   q+ = q (+) dt v+

Only what is saved is written out. The reverse gradient (`kernel_gradient`) runs in a kernel too,
for the initial state and the controls; where the model is differentiated `rb.rollout` takes its
`lax.scan`.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.aba import aba
from rbjax.dynamics.kernel import ROLLED, Block, Plan, driver, launch, plan, scratch_rows
from rbjax.dynamics.kernel_drivers import KernelRolled, Memory
from rbjax.dynamics.manifold import integrate_lanes
from rbjax.lanes import add
from rbjax.model import Model


def controls(ref: Any, columns: Any, count: int, t: Any) -> list[jax.Array] | None:
    """The controls of step t: of each sample, or shared by all (then the ref is (T, nu))."""
    if ref is None:
        return None
    if len(ref.shape) == 2:
        return [ref[t, k] for k in range(count)]
    return [ref[t, k, columns] for k in range(count)]


def forces(applied: Any, block: Block, q: list, v: list, ctrl: list | None) -> list[jax.Array]:
    """The model's own generalized forces, as arrays."""
    like = block.like
    return [
        jnp.broadcast_to(jnp.asarray(x, like.dtype), like.shape)
        for x in applied(block.known.model, q, v, ctrl)
    ]


def march(
    model: Model, applied: Any, q: jax.Array, v: jax.Array, ctrls: jax.Array | None, dt: jax.Array,
    steps: int, save_every: int, how: Plan,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """States after every `save_every` steps, (T, nq, B) and (T, nv, B), without the first."""
    top, nq, nv, saved = model.topology, model.nq, model.nv, steps // save_every
    size = q.shape[-1]

    def body(block: Block, ins: Any, outs: Any, memory: Memory) -> None:
        q_ref, v_ref, dt_ref, *rest = ins
        h = dt_ref[0]
        at = functools.partial(controls, rest[0] if rest else None, block.columns, model.nu)
        start = [q_ref[i, block.columns] for i in range(nq)]
        start += [v_ref[i, block.columns] for i in range(nv)]
        step = _unrolled if how.driver == "unrolled" else _rolled
        read, advance = step(block, memory, applied, start, h, at, top)

        def segment(k: Any, state: Any) -> Any:
            state = jax.lax.fori_loop(
                0, save_every, lambda i, s: advance(k * save_every + i, s), state
            )
            for i, x in enumerate(read(state)):
                ref, row = (outs[0], i) if i < nq else (outs[1], i - nq)
                ref[k, row, block.columns] = x
            return state

        jax.lax.fori_loop(0, saved, segment, tuple(start) if how.driver == "unrolled" else 0)

    inputs = [q, v, dt.reshape(1)] + ([] if ctrls is None else [ctrls])
    rows = scratch_rows(model, how, 36) + nq
    qs, vs = launch(body, model, how, inputs, [(saved, nq, size), (saved, nv, size)], rows)
    return qs, vs


def _unrolled(block, memory, applied, start, h, controls_at, top):
    """The state is a tuple of lanes."""

    def advance(t: Any, state: tuple) -> tuple:
        q, v = list(state[: top.nq]), list(state[top.nq :])
        d = driver(block, memory)
        tau = forces(applied, block, q, v, controls_at(t))
        qdd, _ = aba(d, d.joints(q, v), tau, block.gravity)
        v = [a + h * b for a, b in zip(v, qdd, strict=True)]
        return (*integrate_lanes(top, q, [h * a for a in v]), *v)

    return (lambda state: state), advance


def _rolled(block, memory, applied, start, h, controls_at, top):
    """The state is in rows of the memory."""
    nq, nv = top.nq, top.nv
    first = memory.take(nq + nv)
    for i, x in enumerate(start):
        memory.write(first + i, x)
    taus = memory.take(nv)
    d: Any = driver(block, memory)
    used = memory.used

    def read(_: Any) -> list[jax.Array]:
        return [memory.read(first + i) for i in range(nq + nv)]

    def advance(t: Any, state: Any) -> Any:
        memory.used = used
        lanes = read(None)
        q, v = lanes[:nq], lanes[nq:]
        for i, x in enumerate(forces(applied, block, q, v, controls_at(t))):
            memory.write(taus + i, x)
        joints = d.joints(
            lambda i: memory.read(first + i), lambda i: memory.read(first + nq + i), first + nq
        )
        qdd, _ = aba(d, joints, d.rows(taus), block.gravity)
        q, v = (x for x in (read(None)[:nq], read(None)[nq:]))
        v = [add(a, h * d.read(qdd, i)) for i, a in enumerate(v)]
        for i, x in enumerate([*integrate_lanes(top, q, [h * a for a in v]), *v]):
            memory.write(first + i, x)
        return state

    return read, advance


def choose(model: Model, concrete: bool) -> Plan:
    """Unrolled where the tree is small and its numbers are literal, else rolled."""
    how = plan(model)
    return how if how.driver == "rolled" or concrete else ROLLED


__all__ = ["KernelRolled", "choose", "controls", "forces", "march"]
