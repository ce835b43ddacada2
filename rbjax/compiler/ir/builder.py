"""The builder, which writes the statements of a program.

It folds known values, and computes equal expressions once.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from rbjax.compiler.ir.folding import folded, keys_of, simpler
from rbjax.compiler.ir.statements import (
    I32,
    Array,
    Assign,
    Block,
    Declare,
    If,
    Load,
    Loop,
    Op,
    Reserve,
    Store,
    Value,
    Var,
    is_number,
)


class Builder:
    """Writes statements. Equal expressions in scope of each other become one variable.

    platform: where the program runs, "cuda" or "cpu", for functions that depend on it. team:
    whether a team of threads runs it. matrices: whether one sample's matrices are to fill the
    vectors of a CPU.
    """

    def __init__(self, platform: str = "cuda", team: bool = False, matrices: bool = False) -> None:
        self.platform, self.matrices = platform, matrices
        self.in_team = team  # here; not in what each thread of a team does by itself
        self._group, self._groups = 0, itertools.count(1)
        self.block = Block()
        self.ids = itertools.count()
        self.time = 0  # advances whenever earlier loads may be out of date
        self._tables: dict[tuple, Array] = {}
        self._known: dict[tuple, Value] = {}
        self._scopes: list[list[tuple]] = [[]]
        self.negated: dict[int, Value] = {}
        self.inverses: dict[Value, Value] = {}  # of numbers whose inverses were computed first
        self.solved: dict[Array, Any] = {}  # systems that a team has solved (`factorise`)
        self._entered = 0  # blocks entered and left: memory differs in a loop's second iteration

    # ---------------------------------------------------------------- scalars

    def var(self, dtype: DTypeLike) -> Var:
        return Var(next(self.ids), np.dtype(dtype))

    def op(self, name: str, dtype: DTypeLike, *args: Value) -> Value:
        """name(args), of the given type."""
        dtype = np.dtype(dtype)
        known = [a for a in args if not isinstance(a, Var)]
        if len(known) == len(args):
            known_result = folded(name, dtype, args)
            if known_result is not None:
                return known_result
        if known or name in ("neg", "select"):
            simple = simpler(self, name, args)
            if simple is not None:
                return simple
        key = (name, dtype.char, *keys_of(name, args))
        dest = self._known.get(key)
        if dest is None:
            dest = self.var(dtype)
            self.block.statements.append(Op(dest, name, args))
            self._remember(key, dest)
            if name == "neg":
                self.negated[dest.id] = args[0]
        return dest

    def cast(self, x: Value, dtype: DTypeLike) -> Value:
        """x as another type."""
        return x if x.dtype == dtype else self.op("cast", dtype, x)

    def select(self, condition: Value, yes: Value, no: Value) -> Value:
        """yes if the condition holds, else no."""
        return self.op("select", yes.dtype, condition, yes, no)

    def declare(self, dtype: DTypeLike, value: Value | None = None) -> Var:
        """A variable that is assigned later."""
        var = self.var(dtype)
        self.block.statements.append(Declare(var, value))
        return var

    def assign(self, var: Var, value: Value) -> None:
        if var is not value:
            self.block.statements.append(Assign(var, value))

    # ---------------------------------------------------------------- memory

    def local(self, dtype: DTypeLike, size: int) -> Array:
        array = Array(next(self.ids), np.dtype(dtype), size, "local", shared=self.in_team)
        self.block.statements.append(Reserve(array))
        return array

    def external_array(
        self, dtype: DTypeLike, size: int, space: str, index: DTypeLike = I32
    ) -> Array:
        """An operand or a result."""
        return Array(next(self.ids), np.dtype(dtype), size, space, index=np.dtype(index))

    def table(self, data: np.ndarray) -> Array:
        """Known numbers in memory; equal tables are shared."""
        key = (data.dtype.char, data.tobytes())
        if key not in self._tables:
            flat = data.reshape(-1)
            self._tables[key] = Array(next(self.ids), data.dtype, data.size, "constant", flat)
        return self._tables[key]

    @property
    def tables(self) -> list[Array]:
        return list(self._tables.values())

    def load(self, array: Array, base: Value | None, offset: int) -> Value:
        """array[base + offset]."""
        base, offset = _at(base, offset)
        if array.data is not None and base is None:
            return array.data[offset]
        since = (array.version, self._entered) if array.mutable else 0
        key = ("load", array.id, base.id if base is not None else None, offset, since)
        dest = self._known.get(key)
        if dest is None:
            dest = self.var(array.dtype)
            self.block.statements.append(Load(dest, array, base, offset))
            self._remember(key, dest)
        return dest

    def store(self, array: Array, base: Value | None, offset: int, value: Value) -> None:
        """array[base + offset] = value."""
        base, offset = _at(base, offset)
        self.block.statements.append(Store(array, base, offset, value))
        self.written(array)

    def written(self, array: Array) -> None:
        """From here on, earlier loads of this array are repeated."""
        self.time += 1
        array.version = self.time

    # ---------------------------------------------------------------- blocks

    @contextmanager
    def inside(self, block: Block) -> Iterator[None]:
        """Write into an inner block; its values are out of scope afterwards."""
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
    def loop(self, count: int, *, reverse: bool = False) -> Iterator[Var]:
        """A loop over a counter."""
        counter, body = self.var(I32), Block()
        self.block.statements.append(Loop(counter, count, reverse, body))
        with self.inside(body):
            yield counter

    @contextmanager
    def team_loop(self, count: int, prefetch: bool = False) -> Iterator[Var]:
        """A loop over a counter whose turns a team shares."""
        counter, body = self.var(I32), Block()
        loop = Loop(counter, count, False, body, True, prefetch, self._group)
        self.block.statements.append(loop)
        with self.inside(body), self.per_thread():
            yield counter

    @contextmanager
    def per_thread(self) -> Iterator[None]:
        """What each thread of a team does by itself."""
        before, self.in_team = self.in_team, False
        try:
            yield
        finally:
            self.in_team = before

    @contextmanager
    def disjoint_writes(self) -> Iterator[None]:
        """Loops of a team that write different entries of one array."""
        before, self._group = self._group, next(self._groups)
        try:
            yield
        finally:
            self._group = before

    @contextmanager
    def when(self, condition: Value) -> Iterator[None]:
        """Statements that run where a condition holds."""
        then = Block()
        self.block.statements.append(If(condition, then, Block()))
        with self.inside(then):
            yield

    def _remember(self, key: tuple, value: Value) -> None:
        self._known[key] = value
        self._scopes[-1].append(key)

    def memoize(self, key: tuple, make: Callable[[], Any]) -> Any:
        """make(), or what it gave for this key in the same scope."""
        if key not in self._known:
            self._remember(key, make())
        return self._known[key]

    def index(self, array: Array, *terms: tuple[Value, int]) -> Value | None:
        """Sum of value * stride over the terms, in the array's type of index; None for 0."""
        total: Value = array.index.type(0)
        for value, stride in terms:
            step = self.op(
                "index_mul", array.index, self.cast(value, array.index), array.index.type(stride)
            )
            total = self.op("index_add", array.index, total, step)
        return None if is_number(total, 0) else total


def _at(base: Value | None, offset: int) -> tuple[Var | None, int]:
    if base is None or isinstance(base, Var):
        return base, offset
    return None, offset + int(base)
