"""Whole rollouts in one kernel: the state stays in the block between the steps.

    v+ = v + dt a(q, v, u),   q+ = q (+) dt v+

Only what is saved is written out. The reverse gradient (`kernel_gradient`) runs in a kernel too,
for the initial state and the controls; where the model is differentiated `rb.rollout` takes its
`lax.scan`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.aba import aba
from rbjax.dynamics.kernel import ROLLED, Block, Plan, driver, launch, plan, scratch_rows
from rbjax.dynamics.kernel_aba import accelerations
from rbjax.dynamics.kernel_between import Between
from rbjax.dynamics.kernel_drivers import Cell, Memory, loop
from rbjax.dynamics.manifold import integrate_lanes
from rbjax.dynamics.tracing import opened
from rbjax.lanes import as_arrays
from rbjax.model import Model


class Controls:
    """The controls of step t: of each sample (T, nu, B), shared by all (T, nu), or None."""

    def __init__(self, rest: Any, columns: Any, count: int):
        self.ref, self.columns, self.count = rest[0] if rest else None, columns, count

    def __bool__(self) -> bool:
        return self.ref is not None

    def read(self, t: Any, k: Any) -> jax.Array:
        """One actuator's."""
        return self.ref[t, k] if len(self.ref.shape) == 2 else self.ref[t, k, self.columns]

    def lanes(self, t: Any, like: jax.Array, which: Any = None) -> list[jax.Array] | None:
        """Those of some actuators, or of all."""
        if self.ref is None:
            return None
        which = range(self.count) if which is None else which
        return as_arrays([self.read(t, k) for k in which], like)


def forces(applied: Any, block: Block, q: list, v: list, ctrl: list | None) -> list[jax.Array]:
    """The model's own generalized forces, as arrays."""
    return as_arrays(list(applied(block.known.model, q, v, ctrl)), block.like)


def march(
    model: Model, applied: Any, q: jax.Array, v: jax.Array, ctrls: jax.Array | None, dt: jax.Array,
    steps: int, save_every: int, how: Plan,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """States after every `save_every` steps, (T, nq, B) and (T, nv, B), without the first."""
    nq, nv, saved = model.nq, model.nv, steps // save_every
    size = q.shape[-1]
    ctrls = ctrls if model.nu else None

    def body(block: Block, ins: Any, outs: Any, memory: Memory) -> None:
        q_ref, v_ref, dt_ref, *rest = ins
        ctrl = Controls(rest, block.columns, model.nu)
        machine = _unrolled if how.driver == "unrolled" else _rolled
        state, advance, save = machine(block, memory, applied, q_ref, v_ref, dt_ref[0], ctrl)

        def segment(k: Any, state: Any) -> Any:
            state = jax.lax.fori_loop(
                0, save_every, lambda i, s: advance(k * save_every + i, s), state
            )
            save(outs, k, state)
            return state

        jax.lax.fori_loop(0, saved, segment, state)

    inputs = [q, v, dt.reshape(1)] + ([] if ctrls is None else [ctrls])
    rows = scratch_rows(model, how, 28) + nq
    qs, vs = launch(body, model, how, inputs, [(saved, nq, size), (saved, nv, size)], rows)
    return qs, vs


Machine = tuple[Any, Callable[[Any, Any], Any], Callable[[Any, Any, Any], None]]


def _unrolled(
    block: Block, memory: Memory, applied: Any, q_ref: Any, v_ref: Any, h: Any, ctrl: Controls
) -> Machine:
    """The state is a tuple of lanes."""
    top, columns = block.known.model.topology, block.columns
    nq, nv = top.nq, top.nv

    def advance(t: Any, state: tuple) -> tuple:
        q, v = list(state[:nq]), list(state[nq:])
        d = driver(block, memory)
        tau = forces(applied, block, q, v, ctrl.lanes(t, block.like))
        qdd, _ = aba(d, d.joints(q, v), tau, block.gravity)
        v = [a + h * b for a, b in zip(v, qdd, strict=True)]
        return (*integrate_lanes(top, q, [h * a for a in v]), *v)

    def save(outs: Any, k: Any, state: tuple) -> None:
        for i, x in enumerate(state):
            ref, row = (outs[0], i) if i < nq else (outs[1], i - nq)
            ref[k, row, columns] = x

    start = [q_ref[i, columns] for i in range(nq)] + [v_ref[i, columns] for i in range(nv)]
    return tuple(start), advance, save


def _rolled(
    block: Block, memory: Memory, applied: Any, q_ref: Any, v_ref: Any, h: Any, ctrl: Controls
) -> Machine:
    """The state is in rows of the memory."""
    columns, top = block.columns, block.known.model.topology
    q_row, v_row, taus = memory.take(top.nq), memory.take(top.nv), memory.take(top.nv)
    between = Between(block, applied, bool(ctrl))
    d: Any = driver(block, memory)
    used = memory.used

    def q(i: Any) -> jax.Array:
        return memory.read(q_row + i)

    def v(i: Any) -> jax.Array:
        return memory.read(v_row + i)

    def push(t: Any) -> Callable:
        def one(i, at, actuator):
            u = ctrl.read(t, jnp.maximum(actuator, 0)) if between.actuated else None
            memory.write(taus + i, between.force(i, at, actuator, q(at), v(i), u))

        return one

    def advance(t: Any, state: Any) -> Any:
        memory.used = used
        if between.rest:
            given = [q(i) for i in between.rest_q], [v(i) for i in between.rest]
            tau = between.rest_forces(*given, ctrl.lanes(t, block.like, between.rest_u))
            for i, x in zip(between.rest, tau, strict=True):
                memory.write(taus + i, x)
        between.each(push(t))
        joints = d.joints(q, Cell(row=v_row))
        qdd = accelerations(d, joints, Cell(row=taus), block.gravity)

        def move(i, at, _):
            speed = v(i) + h * memory.read(qdd.row + i)
            angle = q(at) + h * speed
            memory.write(v_row + i, speed)
            memory.write(q_row + at, angle)

        between.each(move)
        speeds = [v(i) + h * memory.read(qdd.row + i) for i in between.rest]
        moved = between.rest_moved([q(i) for i in between.rest_q], [h * x for x in speeds])
        for row, x in zip([v_row + i for i in between.rest], speeds, strict=True):
            memory.write(row, x)
        for row, x in zip([q_row + i for i in between.rest_q], moved, strict=True):
            memory.write(row, x)
        return state

    def save(outs: Any, k: Any, state: Any) -> None:
        def put(ref, row, i):
            ref[k, i, columns] = memory.read(row + i)

        every(put, outs, (q_row, v_row), (top.nq, top.nv))

    def put(ref, row, i):
        memory.write(row + i, ref[i, columns])

    every(put, (q_ref, v_ref), (q_row, v_row), (top.nq, top.nv))
    return 0, advance, save


def every(put: Callable, refs: Any, rows: Any, counts: Any) -> None:
    """`put(ref, row, i)` for the first `count` i of each ref and row, by loops."""
    for ref, row, count in zip(refs, rows, counts, strict=True):
        loop(lambda i, _, a=ref, b=row: (put(a, b, i), 0)[1], 0, 0, count)


def choose(model: Model) -> Plan:
    """The plan of a rollout: rolled wherever the model's numbers are not all known."""
    return ROLLED if opened(model)[0] else plan(model)
