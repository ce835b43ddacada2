"""The builder of programs, with constant folding and common subexpression elimination."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.operations import OPERATIONS


def fold(name: str, dtype: np.dtype, args: tuple) -> ir.Value | None:
    """Evaluate an operation on constants. Return None if the program must compute it."""
    operation = OPERATIONS[name]
    if operation.fold is None or dtype.kind not in operation.fold_types:
        return None
    if name == "cast" and args[0].dtype.kind == "f" and dtype.kind != "f":
        return None  # numpy and XLA convert large numbers and nan differently
    with np.errstate(all="ignore"):
        return dtype.type(operation.fold(*args))


def simplify(builder: Builder, name: str, args: tuple) -> ir.Value | None:
    """Return the simplified result of an operation, such as x + 0 = x; None if there is none."""
    match name, args:
        case ("select", (c, a, b)) if isinstance(c, np.generic):
            return a if c else b
        case ("select", (_, a, b)) if a is b:
            return a
        case ("neg", (a,)) if not isinstance(a, np.generic) and a.id in builder.negated:
            return builder.negated[a.id]
        case ("add" | "index_add", (a, b)) if ir.is_number(b, 0):
            return a
        case ("add" | "index_add", (a, b)) if ir.is_number(a, 0):
            return b
        case ("sub", (a, b)) if ir.is_number(b, 0):
            return a
        case ("mul" | "index_mul" | "index_div" | "div", (a, b)) if ir.is_number(b, 1):
            return a
        case ("mul" | "index_mul", (a, b)) if ir.is_number(a, 1):
            return b
        case ("mul", (a, b)) if ir.is_number(b, -1):
            return builder.op("neg", a.dtype, a)
        case ("mul", (a, b)) if ir.is_number(a, -1):
            return builder.op("neg", b.dtype, b)
        case ("mul" | "index_mul", (a, b)) if a.dtype.kind in "iu":
            return a.dtype.type(0) if ir.is_number(a, 0) or ir.is_number(b, 0) else None
        case ("and", (a, b)) if a.dtype == ir.BOOL and isinstance(a, np.generic):
            return b if a else a
        case ("and", (a, b)) if b.dtype == ir.BOOL and isinstance(b, np.generic):
            return a if b else b
        case ("or", (a, b)) if a.dtype == ir.BOOL and isinstance(a, np.generic):
            return a if a else b
        case ("or", (a, b)) if b.dtype == ir.BOOL and isinstance(b, np.generic):
            return b if b else a
    return None


def value_keys(name: str, args: Sequence[ir.Value]) -> list:
    """Return keys of an operation's arguments, in a fixed order if the operation commutes."""
    keys: list = [(a.dtype.char, a.tobytes()) if isinstance(a, np.generic) else a.id for a in args]
    if OPERATIONS[name].commutes and _order(keys[0]) > _order(keys[1]):
        keys.reverse()
    return keys


def _order(key: tuple | int) -> tuple:
    return (1, *key) if isinstance(key, tuple) else (0, key)


class Builder:
    """An emitter of the statements of a program. It emits equal operations once per scope.

    platform: "cuda" or "cpu", for lowering rules that depend on it.
    team: whether a block of GPU threads runs one sample together.
    matrices: whether the loops over a sample's matrices use the vectors of a CPU.
    """

    def __init__(self, platform: str = "cuda", team: bool = False, matrices: bool = False) -> None:
        self.platform, self.matrices = platform, matrices
        self.in_team = team  # False inside statements that each thread runs by itself
        self._group, self._groups = 0, itertools.count(1)
        self.block = ir.Block()
        self.ids = itertools.count()
        self.time = 0  # advances at each store
        self._tables: dict[tuple, ir.Array] = {}
        self._known: dict[tuple, ir.Value] = {}
        self._scopes: list[list[tuple]] = [[]]
        self.negated: dict[int, ir.Value] = {}
        self.inverses: dict[ir.Value, ir.Value] = {}  # precomputed inverses of values
        self.solved: dict[ir.Array, Any] = {}  # triangular systems solved by a team (`factorise`)
        self._entered = 0  # counts entries and exits of blocks, for loads

    # ---------------------------------------------------------------- scalars

    def var(self, dtype: DTypeLike) -> ir.Var:
        return ir.Var(next(self.ids), np.dtype(dtype))

    def op(self, name: str, dtype: DTypeLike, *args: ir.Value) -> ir.Value:
        """Emit the operation name(args) with a result of this dtype, and return the result."""
        dtype = np.dtype(dtype)
        known = [a for a in args if not isinstance(a, ir.Var)]
        if len(known) == len(args):
            known_result = fold(name, dtype, args)
            if known_result is not None:
                return known_result
        if known or name in ("neg", "select"):
            simple = simplify(self, name, args)
            if simple is not None:
                return simple
        key = (name, dtype.char, *value_keys(name, args))
        dest = self._known.get(key)
        if dest is None:
            dest = self.var(dtype)
            self.block.statements.append(ir.Op(dest, name, args))
            self._remember(key, dest)
            if name == "neg":
                self.negated[dest.id] = args[0]
        return dest

    def cast(self, x: ir.Value, dtype: DTypeLike) -> ir.Value:
        """Convert x to another dtype."""
        return x if x.dtype == dtype else self.op("cast", dtype, x)

    def select(self, condition: ir.Value, yes: ir.Value, no: ir.Value) -> ir.Value:
        """Return `yes` if the condition is true, else `no`, without a branch."""
        return self.op("select", yes.dtype, condition, yes, no)

    def declare(self, dtype: DTypeLike, value: ir.Value | None = None) -> ir.Var:
        """Declare a variable that may be assigned several times."""
        var = self.var(dtype)
        self.block.statements.append(ir.Declare(var, value))
        return var

    def assign(self, var: ir.Var, value: ir.Value) -> None:
        if var is not value:
            self.block.statements.append(ir.Assign(var, value))

    # ---------------------------------------------------------------- memory

    def local(self, dtype: DTypeLike, size: int) -> ir.Array:
        array = ir.Array(next(self.ids), np.dtype(dtype), size, "local", shared=self.in_team)
        self.block.statements.append(ir.Reserve(array))
        return array

    def external_array(
        self, dtype: DTypeLike, size: int, space: str, index: DTypeLike = ir.I32
    ) -> ir.Array:
        """Return an array that the caller of the program provides: an operand or a result."""
        return ir.Array(next(self.ids), np.dtype(dtype), size, space, index=np.dtype(index))

    def table(self, data: np.ndarray) -> ir.Array:
        """Return a constant array in memory. Equal tables are stored once."""
        key = (data.dtype.char, data.tobytes())
        if key not in self._tables:
            flat = data.reshape(-1)
            self._tables[key] = ir.Array(next(self.ids), data.dtype, data.size, "constant", flat)
        return self._tables[key]

    @property
    def tables(self) -> list[ir.Array]:
        return list(self._tables.values())

    def load(self, array: ir.Array, base: ir.Value | None, offset: int) -> ir.Value:
        """Return the value of array[base + offset], from a new load or an earlier valid one."""
        base, offset = _at(base, offset)
        if array.data is not None and base is None:
            return array.data[offset]
        since = (array.version, self._entered) if array.mutable else 0
        key = ("load", array.id, base.id if base is not None else None, offset, since)
        dest = self._known.get(key)
        if dest is None:
            dest = self.var(array.dtype)
            self.block.statements.append(ir.Load(dest, array, base, offset))
            self._remember(key, dest)
        return dest

    def store(self, array: ir.Array, base: ir.Value | None, offset: int, value: ir.Value) -> None:
        """Emit array[base + offset] = value."""
        base, offset = _at(base, offset)
        self.block.statements.append(ir.Store(array, base, offset, value))
        self.written(array)

    def written(self, array: ir.Array) -> None:
        """Invalidate earlier loads of this array."""
        self.time += 1
        array.version = self.time

    # ---------------------------------------------------------------- blocks

    @contextmanager
    def inside(self, block: ir.Block) -> Iterator[None]:
        """Emit into an inner block. Its values are out of scope after the `with` block."""
        outer, self.block = self.block, block
        self._scopes.append([])
        self._entered += 1
        try:
            yield
        finally:
            for key in self._scopes.pop():
                self._known.pop(key, None)
            self._entered += 1
            self.block = outer

    @contextmanager
    def loop(self, count: int, *, reverse: bool = False) -> Iterator[ir.Var]:
        """Emit a loop, whose counter runs over 0 ... count - 1. Its body is the `with` block."""
        counter, body = self.var(ir.I32), ir.Block()
        self.block.statements.append(ir.Loop(counter, count, reverse, body))
        with self.inside(body):
            yield counter

    @contextmanager
    def team_loop(self, count: int, prefetch: bool = False) -> Iterator[ir.Var]:
        """Emit a loop whose independent iterations are divided among the threads of a team.
        prefetch: the loop copies entries that are first read after the next `Await`."""
        counter, body = self.var(ir.I32), ir.Block()
        loop = ir.Loop(counter, count, False, body, True, prefetch, self._group)
        self.block.statements.append(loop)
        with self.inside(body), self.per_thread():
            yield counter

    @contextmanager
    def per_thread(self) -> Iterator[None]:
        """Emit statements that each thread of a team runs by itself."""
        before, self.in_team = self.in_team, False
        try:
            yield
        finally:
            self.in_team = before

    @contextmanager
    def disjoint_writes(self) -> Iterator[None]:
        """Emit team loops that write disjoint entries of an array, so they need no barriers."""
        before, self._group = self._group, next(self._groups)
        try:
            yield
        finally:
            self._group = before

    @contextmanager
    def when(self, condition: ir.Value) -> Iterator[None]:
        """Emit statements that run if a condition is true."""
        then = ir.Block()
        self.block.statements.append(ir.If(condition, then, ir.Block()))
        with self.inside(then):
            yield

    def _remember(self, key: tuple, value: ir.Value) -> None:
        self._known[key] = value
        self._scopes[-1].append(key)

    def memoize(self, key: tuple, make: Callable[[], Any]) -> Any:
        """Return make(), or its earlier result for this key in the same scope."""
        if key not in self._known:
            self._remember(key, make())
        return self._known[key]

    def index(self, array: ir.Array, *terms: tuple[ir.Value, int]) -> ir.Value | None:
        """Return the sum of value * stride over the terms, as an array index; None for 0."""
        total: ir.Value = array.index.type(0)
        for value, stride in terms:
            step = self.op(
                "index_mul", array.index, self.cast(value, array.index), array.index.type(stride)
            )
            total = self.op("index_add", array.index, total, step)
        return None if ir.is_number(total, 0) else total


def _at(base: ir.Value | None, offset: int) -> tuple[ir.Var | None, int]:
    if base is None or isinstance(base, ir.Var):
        return base, offset
    return None, offset + int(base)
