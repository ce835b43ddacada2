"""Whole rollouts in one kernel: the state stays in the block between the steps.

    v+ = v + dt a(q, v, u),   q+ = q (+) dt v+

or, with a tableau, an explicit Runge-Kutta method on the manifold (`kernel_stages`). Only what is
saved is written out. The reverse gradient (`kernel_gradient`) runs in a kernel too,
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
from rbjax.dynamics.kernel_stages import Scheme, coefficients
from rbjax.dynamics.manifold import integrate_lanes, rate_lanes
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


def forces(
    applied: Any, block: Block, q: list, v: list, ctrl: list | None, d: Any = None
) -> list[jax.Array]:
    """The model's own generalized forces, as arrays; d is the driver."""
    return as_arrays(list(applied(block.known.model, q, v, ctrl, d)), block.like)


def march(
    model: Model, applied: Any, q: jax.Array, v: jax.Array, ctrls: jax.Array | None, dt: jax.Array,
    steps: int, save_every: int, how: Plan, table: Any = None,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """States after every `save_every` steps, (T, nq, B) and (T, nv, B), without the first; by
    semi-implicit Euler, or by the tableau (a, b, stages) of an explicit Runge-Kutta method."""
    nq, nv, saved = model.nq, model.nv, steps // save_every
    size = q.shape[-1]
    ctrls = ctrls if model.nu else None

    def body(block: Block, ins: Any, outs: Any, memory: Memory) -> None:
        q_ref, v_ref, dt_ref, rows_ref, *rest = ins
        ctrl = Controls(rest, block.columns, model.nu)
        unrolled = how.driver == "unrolled"
        scheme = None if table is None else Scheme(table, rows_ref, memory, nv, unrolled)
        machine = _unrolled if unrolled else _rolled
        state, advance, save = machine(
            block, memory, applied, q_ref, v_ref, dt_ref[0], ctrl, scheme
        )

        def segment(k: Any, state: Any) -> Any:
            state = jax.lax.fori_loop(
                0, save_every, lambda i, s: advance(k * save_every + i, s), state
            )
            save(outs, k, state)
            return state

        jax.lax.fori_loop(0, saved, segment, state)

    inputs = [q, v, dt.reshape(1), coefficients(table, q.dtype)]
    inputs += [] if ctrls is None else [ctrls]
    rows = scratch_rows(model, how, 28) + nq
    if table is not None:
        rows += 2 * nv * table.stages + nq + nv
    qs, vs = launch(body, model, how, inputs, [(saved, nq, size), (saved, nv, size)], rows)
    return qs, vs


Machine = tuple[Any, Callable[[Any, Any], Any], Callable[[Any, Any, Any], None]]


def _unrolled(
    block: Block, memory: Memory, applied: Any, q_ref: Any, v_ref: Any, h: Any, ctrl: Controls,
    scheme: Scheme | None,
) -> Machine:  # fmt: skip
    """The state is a tuple of lanes."""
    top, columns = block.known.model.topology, block.columns
    nq, nv = top.nq, top.nv

    def acceleration(t: Any, q: list, v: list) -> list:
        d = driver(block, memory)
        tau = forces(applied, block, q, v, ctrl.lanes(t, block.like), d)
        return aba(d, d.joints(q, v), tau, block.gravity)[0]

    def advance(t: Any, state: tuple) -> tuple:
        q, v = list(state[:nq]), list(state[nq:])

        def rate(u: list, w: list) -> tuple[list, list]:
            w = [a + b for a, b in zip(v, w, strict=True)]
            return rate_lanes(top, u, w), acceleration(t, integrate_lanes(top, q, u), w)

        if scheme is None:
            dv = [h * a for a in acceleration(t, q, v)]
            u = [h * (a + b) for a, b in zip(v, dv, strict=True)]
        else:
            u, dv = scheme.increments(rate, h, block.like)
        v = [a + b for a, b in zip(v, dv, strict=True)]
        return tuple(as_arrays((*integrate_lanes(top, q, u), *v), block.like))

    def save(outs: Any, k: Any, state: tuple) -> None:
        for i, x in enumerate(state):
            ref, row = (outs[0], i) if i < nq else (outs[1], i - nq)
            ref[k, row, columns] = x

    start = [q_ref[i, columns] for i in range(nq)] + [v_ref[i, columns] for i in range(nv)]
    return tuple(start), advance, save


def _rolled(
    block: Block, memory: Memory, applied: Any, q_ref: Any, v_ref: Any, h: Any, ctrl: Controls,
    scheme: Scheme | None,
) -> Machine:  # fmt: skip
    """The state is in rows of the memory."""
    columns, top = block.columns, block.known.model.topology
    here = Rows(memory.take(top.nq), memory.take(top.nv), memory)
    there = here if scheme is None else Rows(memory.take(top.nq), memory.take(top.nv), memory)
    taus = memory.take(top.nv)
    between = Between(block, applied, bool(ctrl))
    d: Any = driver(block, memory)
    used = memory.used

    def acceleration(t: Any, at: Rows) -> Cell:
        """Of the state in those rows."""
        memory.used = used

        def push(i, place, actuator):
            u = ctrl.read(t, jnp.maximum(actuator, 0)) if between.actuated else None
            memory.write(taus + i, between.force(i, place, actuator, at.q(place), at.v(i), u))

        if between.rest:
            given = [at.q(i) for i in between.rest_q], [at.v(i) for i in between.rest]
            tau = between.rest_forces(*given, ctrl.lanes(t, block.like, between.rest_u))
            for i, x in zip(between.rest, tau, strict=True):
                memory.write(taus + i, x)
        between.each(push)
        joints = d.joints(at.q, Cell(row=at.v_row))
        return accelerations(d, joints, Cell(row=taus), block.gravity)

    def move(increment: Callable, to: Rows, then: Callable | None = None) -> None:
        """The state by (h u, h w) = increment(link), to its rows; then(link, h u, v + h w)."""

        def one(i, place, _):
            u, w = increment(i)
            speed, angle = here.v(i) + w, here.q(place) + u
            memory.write(to.v_row + i, speed)
            memory.write(to.q_row + place, angle)
            if then:
                then(i, speed)

        between.each(one)
        both = [increment(i) for i in between.rest]
        turned = [u for u, _ in both]
        speeds = [here.v(i) + w for i, (_, w) in zip(between.rest, both, strict=True)]
        moved = between.rest_moved([here.q(i) for i in between.rest_q], turned)
        rates = between.rest_rates(turned, speeds) if then else speeds
        for i, speed, rate in zip(between.rest, speeds, rates, strict=True):
            memory.write(to.v_row + i, speed)
            if then:
                then(i, rate)
        for row, x in zip([to.q_row + i for i in between.rest_q], moved, strict=True):
            memory.write(row, x)

    def advance(t: Any, state: Any) -> Any:
        if scheme is None:
            qdd = acceleration(t, here)

            def euler(i):
                dv = h * memory.read(qdd.row + i)
                return h * (here.v(i) + dv), dv

            move(euler, here)
            return state

        def stage(k, _):
            move(lambda i: scheme.sums(k, i, h), there, lambda i, x: scheme.keep(k, i, x))
            d.write(acceleration(t, there), lambda i, x: scheme.keep(k, top.nv + i, x))
            return 0

        loop(stage, 0, 0, scheme.stages)
        move(lambda i: scheme.sums(scheme.stages, i, h), here)
        return state

    def save(outs: Any, k: Any, state: Any) -> None:
        def put(ref, row, i):
            ref[k, i, columns] = memory.read(row + i)

        every(put, outs, (here.q_row, here.v_row), (top.nq, top.nv))

    def put(ref, row, i):
        memory.write(row + i, ref[i, columns])

    every(put, (q_ref, v_ref), (here.q_row, here.v_row), (top.nq, top.nv))
    return 0, advance, save


class Rows:
    """A state in rows of the memory."""

    def __init__(self, q_row: int, v_row: int, memory: Memory):
        self.q_row, self.v_row, self.memory = q_row, v_row, memory

    def q(self, i: Any) -> jax.Array:
        return self.memory.read(self.q_row + i)

    def v(self, i: Any) -> jax.Array:
        return self.memory.read(self.v_row + i)


def every(put: Callable, refs: Any, rows: Any, counts: Any) -> None:
    """`put(ref, row, i)` for the first `count` i of each ref and row, by loops."""
    for ref, row, count in zip(refs, rows, counts, strict=True):
        loop(lambda i, _, a=ref, b=row: (put(a, b, i), 0)[1], 0, 0, count)


def choose(model: Model) -> Plan:
    """The plan of a rollout: rolled wherever the model's numbers are not all known."""
    return ROLLED if opened(model)[0] else plan(model)


def takes(model: Model, known: bool) -> bool:
    """Whether a kernel can: with actuators at sites it is unrolled and the model closed over, whose
    numbers `known` says will still be known in the kernel."""
    at_sites = any(site >= 0 for site in model.actuators.sites)
    return model.nv > 0 and (not at_sites or (known and choose(model).driver == "unrolled"))
