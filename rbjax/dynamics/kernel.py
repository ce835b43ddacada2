"""Forward dynamics as one Pallas (Triton) kernel, for large batches on a GPU.

The third way to run the recursions of `aba`: one program takes a block of the batch, and nothing
but q, v, tau and the accelerations passes through the GPU's memory. `kernel_drivers` says how links
are walked, `kernel_rollout` keeps whole rollouts inside. On the CPU the kernels run in Pallas's
interpreter, for tests.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from rbjax.dynamics.aba import aba
from rbjax.dynamics.kernel_aba import accelerations
from rbjax.dynamics.kernel_drivers import SLOT, Cell, KernelRolled, KernelUnrolled, Memory
from rbjax.dynamics.kernel_layout import base_links, is_plain, layout, slots
from rbjax.dynamics.kernel_numbers import Numbers, numbers
from rbjax.dynamics.tracing import opened
from rbjax.lanes import Vec3
from rbjax.materialize import inside_a_kernel
from rbjax.model import Model

#: up to this many velocity coordinates a kernel is unrolled (benchmarks/results/gpu-*.json),
UNROLLED_UP_TO = 9
#: and up to this many a kernel of a gradient: at 7 it is 3 times as fast and compiles for 80 s
UNROLLED_GRADIENT_UP_TO = 3
#: whether Pallas's interpreter runs the kernels; None: on the CPU alone
INTERPRET: bool | None = None
#: programs that a GPU is given to walk the batch with (rolled): their scratch stays in its cache
PROGRAMS = 132 * 2


@dataclass(frozen=True)
class Plan:
    """How a kernel runs: its driver, samples in a block, warps in a block, programs at most."""

    driver: str
    block: int = 128
    warps: int = 4
    programs: int | None = None


ROLLED = Plan("rolled", block=256, warps=4, programs=PROGRAMS)


def plan(model: Model) -> Plan:
    """The measured choice for a model: unrolled where the tree is small and its numbers literal."""
    small = model.driver == "auto" and not opened(model)[0] and model.nv <= UNROLLED_UP_TO
    return Plan("unrolled") if model.driver == "unrolled" or small else ROLLED


def gradient_plan(model: Model, how: Plan) -> Plan:
    """The plan of a gradient where `how` is that of the rollout."""
    unrolled = how.driver == "unrolled" and model.nv <= UNROLLED_GRADIENT_UP_TO
    if unrolled or how.driver == "rolled" or model.driver == "unrolled":
        return how
    return Plan("rolled", block=128, warps=4, programs=2 * PROGRAMS)


class Block:
    """What a kernel's body works with: its columns of the batch, the model's numbers, scratch."""

    def __init__(
        self, known: Numbers, how: Plan, columns: Any, index: Any, memory: Any, dtype: Any
    ):
        self.known, self.how, self.columns = known, how, columns
        self.like = jnp.zeros(how.block, dtype)
        self.index, self._memory = index, memory
        self.gravity = Vec3(*(_scalar(g) for g in known.prepared.gravity))

    def memory(self, columns: Any) -> Memory:
        return Memory(self._memory, columns, self.like)


def _scalar(g: Any) -> Any:
    return g if isinstance(g, (int, float)) else g[0]


def launch(
    body: Callable,
    model: Model,
    how: Plan,
    inputs: list[jax.Array],
    outputs: list[tuple],
    rows: int,
) -> list[jax.Array]:
    """Run `body(block, in_refs, out_refs, memory)` over blocks of the last axis.

    Inputs and outputs have the batch last; one whose last axis is not the batch is given whole.
    `rows` is the scratch, in rows a block wide.
    """
    size = max(x.shape[-1] for x in inputs[:1])
    dtype = inputs[0].dtype
    blocks = -(-size // how.block)
    padded = blocks * how.block
    programs = min(blocks, how.programs or blocks)
    visits = -(-blocks // programs)

    def pad(x: jax.Array) -> jax.Array:
        if x.shape[-1] != size or padded == size:
            return x
        return jnp.concatenate([x, jnp.repeat(x[..., -1:], padded - size, -1)], -1)

    known = numbers(model, dtype, dynamic=how.driver == "rolled")
    index = jnp.asarray(layout(model.topology, model.actuators.joints))
    shapes = [jax.ShapeDtypeStruct((*s[:-1], padded), dtype) for s in outputs]
    shapes.append(jax.ShapeDtypeStruct((max(rows, 1), programs * how.block), dtype))
    count = len(inputs)

    def kernel(number_ref: Any, index_ref: Any, *refs: Any) -> None:
        known.bind(number_ref)
        ins, outs, scratch = refs[:count], refs[count:-1], refs[-1]
        here = pl.program_id(0)

        def visit(k: Any) -> None:
            at = jnp.minimum(here + k * programs, blocks - 1)
            block = Block(known, how, pl.ds(at * how.block, how.block), index_ref, scratch, dtype)
            mine = block.memory(pl.ds(here * how.block, how.block))
            body(block, ins, outs, mine)

        with inside_a_kernel():
            if visits == 1:
                visit(0)
            else:
                jax.lax.fori_loop(0, visits, lambda k, _: (visit(k), 0)[1], 0)

    run = pl.pallas_call(
        kernel,
        out_shape=shapes,
        grid=(programs,),
        interpret=INTERPRET if INTERPRET is not None else jax.default_backend() == "cpu",
        compiler_params=triton.CompilerParams(num_warps=how.warps, num_stages=1),
        name="rbjax",
    )
    out = run(known.flat, index, *(pad(x) for x in inputs))
    return [x[..., :size] if padded != size else x for x in out[:-1]]


def driver(block: Block, memory: Memory) -> KernelUnrolled | KernelRolled:
    """The plan's driver in this block."""
    if block.how.driver == "unrolled":
        return KernelUnrolled(block.known)
    return KernelRolled(block.known, memory, block.index)


def scratch_rows(model: Model, how: Plan, per_link: int) -> int:
    """Rows of scratch: `per_link` for each link, more where joints differ in kind, and slots at
    branch points."""
    if how.driver == "unrolled":
        return 1
    top = model.topology
    plain = all(is_plain(link) for link in top.links[base_links(top) :])
    per_link += 0 if plain else 24
    return per_link * model.nv + SLOT * slots(top)[0] + 24


def forward_dynamics(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, *, how: Plan | None = None
) -> jax.Array:
    """Accelerations (nv, B) of q (nq, B), v (nv, B), tau (nv, B). Not differentiable."""
    how = how or plan(model)

    def body(block: Block, ins: Any, outs: Any, memory: Memory) -> None:
        qs, vs, taus = (functools.partial(_read, ref, block.columns) for ref in ins)
        d = driver(block, memory)
        if isinstance(d, KernelUnrolled):
            joints = d.joints([qs(i) for i in range(model.nq)], [vs(i) for i in range(model.nv)])
            qdd, _ = aba(d, joints, [taus(i) for i in range(model.nv)], block.gravity)
            for i, x in enumerate(qdd):
                outs[0][i, block.columns] = x
            return
        joints = d.joints(qs, Cell(read=vs))
        qdd = accelerations(d, joints, Cell(read=taus), block.gravity)
        d.write(qdd, functools.partial(_write, outs[0], block.columns))

    return launch(body, model, how, [q, v, tau], [tau.shape], scratch_rows(model, how, 24))[0]


def _read(ref: Any, columns: Any, i: Any) -> jax.Array:
    return ref[i, columns]


def _write(ref: Any, columns: Any, i: Any, x: jax.Array) -> None:
    ref[i, columns] = x
