"""The rollouts of wheeled robots that are timed on every device; this file is no benchmark."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax import wheeled
from rbjax.compiler.jax.explain import explain

STEPS, DT = 100, 0.005
#: robot, fidelity, and the law of its tyres
SCENES: dict[str, tuple[str, str, Any]] = {
    "differential drive": ("differential_drive", "reduced", None),
    "omni-3": ("omni_3", "reduced", None),
    "car": ("car", "reduced", None),
    "omni-3 with slip": ("omni_3", "slipping", wheeled.Fiala(20.0, 0.8)),
    "car on tyres": ("car", "slipping", wheeled.Fiala(20.0, 0.9)),
}
METHODS = ("semi_implicit_euler", "rk4")
ROADS = ("known", "argument")


class Case(NamedTuple):
    """A rollout: what it is called, the function and its arguments, operations of one step."""

    row: dict[str, Any]
    run: Callable
    args: tuple
    operations: float


def vehicle(scene: str) -> wheeled.RobotModel:
    kind, fidelity, tyre = SCENES[scene]
    how = {} if tyre is None else {"tyre": tyre}
    return wheeled.at(wheeled.kinds()[kind].make(), fidelity, **how)


def cases(scene: str, batch: int) -> Iterator[Case]:
    """Of a batch of states that differ, with controls that all share: by each method, with a robot
    that the program knows, and with one that is an argument of the program."""
    one = vehicle(scene)
    state = wheeled.start(one, twist=[0.5, 0.0, 0.1])
    differ = 1.0 + 1e-3 * jnp.arange(batch, dtype=state.q.dtype)
    states = jax.tree.map(lambda x: (x + 0.01) * differ[:, None], state)
    u = jnp.full((STEPS, one.nu), 0.1)
    for method in METHODS:

        def last(v: Any, state: Any, u: Any, method: str = method) -> Any:
            out = wheeled.rollout(v, state, u, DT, integrator=method, save_every=STEPS)
            return out.q[..., -1, :], out.v[..., -1, :]

        def known(state: Any, u: Any, last: Callable = last) -> Any:
            return last(one, state, u)

        for road, f, own in (("known", known, ()), ("argument", last, (one,))):
            row = {"what": scene, "method": method, "robot is": road, "batch": batch}
            count = explain(f, *own, state, u).operations / STEPS
            yield Case(row, f, (*own, states, u), count)
