"""Forward dynamics of the bundled scenes as one GPU thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import jax

from rbjax.compiler import Explanation, explain
from rbjax.demo.report import Section
from rbjax.dynamics import forward_dynamics
from rbjax.loading import load
from rbjax.model import Model

_CODE = """\
cost = rb.threads(lambda q, v, tau: (rb.forward_dynamics(model, q, v, tau) ** 2).sum())
slopes = jax.vmap(jax.grad(cost))(q, v, tau)       # on a GPU one kernel, one robot a thread"""


def _explained(model: Model, gradient: bool) -> Explanation:
    state = model.random_state(jax.random.key(0))

    def cost(q: jax.Array, v: jax.Array, tau: jax.Array) -> jax.Array:
        return (forward_dynamics(model, q, v, tau) ** 2).sum()

    return explain(jax.grad(cost) if gradient else cost, state.q, state.v, 0 * state.v)


def threads(
    folder: Path, say: Callable[[str], None], *,
    scenes: Sequence[str] = ("pendulum", "cart_pole", "arm7", "quadrotor"),
) -> Section:  # fmt: skip
    """Statements and bytes of a cost of the accelerations, and of its gradient."""
    rows = []
    for scene in scenes:
        say(f"{scene} as a GPU thread")
        model = load(scene).replace(driver="unrolled")
        value, slope = (_explained(model, gradient) for gradient in (False, True))
        cells = [value.statements, slope.statements, slope.array_bytes, slope.moved_bytes]
        if value.seconds is not None and slope.seconds is not None:
            cells += [round(x.batch / x.seconds / 1e6) for x in (value, slope) if x.seconds]
        rows.append((scene, *(f"{cell:,}" for cell in cells)))
    columns: tuple[str, ...] = ("scene", "statements", "of the gradient", "bytes of arrays",
                                "bytes read and written")  # fmt: skip
    note = "no GPU here: these are the programs that a GPU would run"
    if len(rows[0]) > len(columns):
        columns, note = (*columns, "M/s", "gradients, M/s"), ""
    return Section(
        title="GPU threads: one robot a thread",
        text=(
            "On a GPU the traced function of one robot is compiled to one kernel; each robot of "
            "a batch is a thread. The table counts the statements of such threads: a cost of the "
            "accelerations, and its gradient by the configuration.",
        ),
        columns=columns,
        rows=tuple(rows),
        note=note,
        code=_CODE,
    )
