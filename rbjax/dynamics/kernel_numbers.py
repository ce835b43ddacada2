"""A model's numbers inside a Pallas kernel.

A kernel captures no arrays. What is traced (the model is an argument) travels as one flat vector,
and inside the kernel a `Table` stands where the array stood: indexing it reads a scalar. What is
concrete (the model is closed over) stays numpy, so that its zeros and ones vanish from the program.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Mat3, Sym3, Vec3
from rbjax.model import LinkConstants, Model, prepare
from rbjax.model.links import lane
from rbjax.spatial import RigidInertia


class Table:
    """An array (n,) or (n, k) somewhere in a kernel's vector of numbers."""

    def __init__(self, start: int, shape: tuple[int, ...], stride: int = 1):
        self.start, self.shape, self.stride = start, shape, stride
        self.ref: Any = None

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, tuple):  # [:, k]
            column = Table(self.start + index[1], self.shape[:1], self.shape[1])
            column.ref = self.ref
            return column
        return self.ref[self.start + self.stride * index]


class Columns:
    """An array (n, k) as its columns, each a `Table` or numpy."""

    def __init__(self, columns: list[Any]):
        self.columns = columns

    def __getitem__(self, index: Any) -> Any:
        return self.columns[index[1]]


def _row(x: Any, i: Any) -> Any:
    """The array from row i on; what is numpy is the same in all rows."""
    if isinstance(x, Columns):
        return Columns([_row(column, i) for column in x.columns])
    if isinstance(x, np.ndarray):
        return x
    row = Table(x.start + x.stride * i, (1,), x.stride)
    row.ref = x.ref
    return row


@dataclass
class Numbers:
    """The flat vector, and how the model looks inside the kernel once `bind` has given it."""

    model: Any
    prepared: Any
    by_index: Any = None
    vector: list[jax.Array] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)

    @property
    def flat(self) -> jax.Array:
        """The numbers as an array of at least one element."""
        return jnp.concatenate([x.reshape(-1) for x in self.vector])

    def one(self, i: Any, joint: Any, actuator: Any, q: Any) -> Any:
        """A model of link i alone, with its joint and one actuator; all may be traced."""
        joints, actuators = self.by_index
        return SimpleNamespace(
            topology=_ONE, nq=1, nv=1, nu=1, sites=None,
            joints=SimpleNamespace(
                stiffness=_row(joints["stiffness"], joint),
                damping=_row(joints["damping"], i),
                springref=_row(joints["springref"], q),
                forcerange=_row(joints["forcerange"], joint),
            ),
            actuators=SimpleNamespace(
                joints=(0,), sites=(-1,), **{n: _row(x, actuator) for n, x in actuators.items()}
            ),
        )  # fmt: skip

    def bind(self, ref: Any) -> None:
        """Say where the vector is; to be called first in the kernel's body."""
        for table in self.tables:
            table.ref = ref


_JOINTS = ("stiffness", "damping", "springref", "forcerange")
_ACTUATORS = ("gear", "gain", "bias", "ctrlrange", "forcerange")


_ONE = SimpleNamespace(joint_kinds=("hinge",), joint_q=(0,), joint_v=(0,), nq=1, nv=1)
_CYCLE = np.eye(3)[:, [[1, 2, 0], [2, 0, 1], [0, 1, 2]]].swapaxes(0, 1)  # z to x, y, z


def _structural(top: Any, i: int, concrete: Any, columns: Any) -> Callable[[], LinkConstants]:
    """The lanes of a known link, read when asked for. What follows from the tree alone (a ball's
    and a free joint's inner links stand on each other and weigh nothing) is literal."""
    link = top.links[i]

    def column(known: Any, table: Any) -> Any:
        return lane(known if isinstance(known, np.ndarray) else table, i)

    def read() -> LinkConstants:
        out = jax.tree.map(column, concrete, columns)
        R, p, inertia, reference = out.R, out.p, out.inertia, out.reference
        if link.part is not None:
            reference = 0.0
            if not link.first_on_body:
                before = top.links[i - 1]
                own = np.eye(3) if link.quaternion else _CYCLE[link.part]
                R, p = Mat3(*(_CYCLE[before.part].T @ own).reshape(-1).tolist()), Vec3.zero()
            elif top.joint_kinds[link.joint] == "free":
                R = Mat3(*_CYCLE[0].reshape(-1).tolist())
        if top.last_links[link.body] != i:
            inertia = RigidInertia(0.0, Vec3.zero(), Sym3.zero())
        return LinkConstants(R, p, inertia, out.armature, reference)

    return read


def numbers(model: Model, dtype: Any, *, dynamic: bool) -> Numbers:
    """The numbers of a model. `dynamic`: links are visited by index, so that columns that are not
    all zero or all one travel even where they are concrete."""
    out = Numbers(None, None, vector=[jnp.zeros(1, dtype)])
    prepared = prepare(model.replace(prepared=None, zeros=None), dtype)

    def moved(x: Any, always: bool = False) -> Any:
        if isinstance(x, (int, float)):
            return x
        concrete = not isinstance(x, jax.core.Tracer)
        if concrete:
            x = np.asarray(x, np.float64)
            if not always:
                return x if x.ndim else float(x)
            if (x == (0.0 if x.size == 0 else x.flat[0])).all():
                return x
        table = Table(sum(a.size for a in out.vector), x.shape)
        out.vector.append(jnp.asarray(x, dtype))
        out.tables.append(table)
        return table

    columns = jax.tree.map(lambda x: moved(x, dynamic), prepared.columns)
    gravity = [moved(g[None] if isinstance(g, jax.core.Tracer) else g) for g in prepared.gravity]
    shapes = prepared.columns if dynamic else columns
    fixed = [_structural(model.topology, i, shapes, columns) for i in range(model.nv)]
    out.prepared = SimpleNamespace(
        columns=columns, gravity=gravity, link=fixed.__getitem__,
        body_R=prepared.body_R, body_p=prepared.body_p,
    )  # fmt: skip
    out.model = SimpleNamespace(
        topology=model.topology, nq=model.nq, nv=model.nv, nu=model.nu, sites=model.sites,
        joints=SimpleNamespace(**{n: moved(getattr(model.joints, n)) for n in _JOINTS}),
        actuators=SimpleNamespace(
            joints=model.actuators.joints, sites=model.actuators.sites,
            **{n: moved(getattr(model.actuators, n)) for n in _ACTUATORS},
        ),
    )  # fmt: skip
    if dynamic:

        def split(x: Any) -> Any:
            return Columns([moved(c, True) for c in x.T]) if x.ndim == 2 else moved(x, True)

        out.by_index = tuple(
            {n: split(getattr(record, n)) for n in names}
            for record, names in ((model.joints, _JOINTS), (model.actuators, _ACTUATORS))
        )
    return out
