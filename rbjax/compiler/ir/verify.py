"""A verifier of programs. It reports an invalid statement before a back end fails on it.

The tests verify every program that they compile.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.operations import OPERATIONS
from rbjax.compiler.ir.program import Written
from rbjax.compiler.ir.text import statement_text

#: operations whose result may have another dtype than their arguments
FREE = {"cast", "bitcast", "isfinite", "lt", "le", "gt", "ge", "eq", "ne"}


class InvalidProgram(Exception):
    """An error: a program has an invalid statement."""


def verify(program: Written) -> None:
    """Raise `InvalidProgram` if a statement of a program is not valid.

    A program is valid if every variable is defined once and used in its scope, only declared
    variables are assigned, and dtypes agree. Each array must be an operand, a result, a table, or
    reserved before its use. Only local arrays and results may be written. A loop that a team shares
    must not contain a barrier.
    """
    arrays = (*program.operands, *program.results, *program.builder.tables)
    verify_block(program.builder.block, arrays)


def verify_block(block: ir.Block, arrays: Iterable[ir.Array] = ()) -> None:
    """Raise `InvalidProgram` if a statement of a block is not valid. arrays: arrays it may use."""
    _Scope(arrays={x.id for x in arrays}).block(block)


@dataclass
class _Scope:
    """The ids of the variables and arrays that the statements of a block may use."""

    arrays: set[int]
    variables: set[int] = field(default_factory=set)
    declared: set[int] = field(default_factory=set)
    every: set[int] = field(default_factory=set)  # variables of the whole program
    in_team_loop: bool = False

    def block(self, block: ir.Block) -> _Scope:
        """Check a block, and return its scope at the end."""
        inner = _Scope(
            {*self.arrays}, {*self.variables}, {*self.declared}, self.every, self.in_team_loop
        )
        for statement in block.statements:
            try:
                inner.statement(statement)
            except InvalidProgram as error:
                raise InvalidProgram(f"{error}: {statement_text(statement)}") from None
        return inner

    def statement(self, s: ir.Statement) -> None:
        if not isinstance(s, ir.While):  # the condition of a `while` loop is defined in its test
            for x in s.reads():
                self.known(x)
        match s:
            case ir.Op():
                _check_operation(s)
                self.define(s.dest)
            case ir.Load(dest=dest, array=array, base=base, offset=offset):
                _check_entry(array, base, offset, dest)
                self.define(dest)
            case ir.Store(array=array, base=base, offset=offset, value=value):
                self.known(array)
                _check(array.mutable, f"a {array.space} array is written")
                _check_entry(array, base, offset, value)
            case ir.Declare(var=var, value=value):
                _check(value is None or value.dtype == var.dtype, "types differ")
                self.define(var)
                self.declared.add(var.id)
            case ir.Assign(var=var, value=value):
                _check(var.id in self.declared, f"t{var.id} is assigned but not declared")
                _check(value.dtype == var.dtype, "types differ")
            case ir.Reserve(array=array):
                _check(array.space == "local", f"a {array.space} array is reserved")
                self.arrays.add(array.id)
            case ir.Loop(counter=counter, count=count, body=body):
                _check(counter.dtype == ir.I32 and count >= 0, "not a loop of a count")
                inside = _Scope({*self.arrays}, {*self.variables}, {*self.declared}, self.every)
                inside.in_team_loop = self.in_team_loop or s.team
                inside.define(counter)
                inside.block(body)
            case ir.While(test=test, condition=condition, body=body):
                inside = self.block(test)
                inside.condition(condition)
                inside.block(body)
            case ir.If(condition=condition):
                self.condition(condition)
                for inner in s.children():
                    self.block(inner)
            case ir.Barrier():
                _check(not self.in_team_loop, "a barrier in a loop that a team shares")

    def known(self, x: ir.Var | ir.Array) -> None:
        ids, name = (self.variables, "t") if isinstance(x, ir.Var) else (self.arrays, "a")
        _check(x.id in ids, f"{name}{x.id} is not defined here")

    def define(self, x: ir.Var) -> None:
        _check(x.id not in self.every, f"t{x.id} is defined twice")
        self.every.add(x.id)
        self.variables.add(x.id)

    def condition(self, x: ir.Value) -> None:
        if isinstance(x, ir.Var):
            self.known(x)
        _check(x.dtype == ir.BOOL, "the condition is not a truth value")


def _check(good: bool, message: str) -> None:
    if not good:
        raise InvalidProgram(message)


def _check_operation(s: ir.Op) -> None:
    operation = OPERATIONS.get(s.name)
    if operation is None:
        raise InvalidProgram(f"no operation {s.name}")
    _check(len(s.args) == operation.arity, f"{s.name} has {operation.arity} arguments")
    first, *rest = (x.dtype for x in s.args)
    if s.name == "select":
        _check(first == ir.BOOL and rest == [s.dest.dtype] * 2, "types differ")
    else:
        _check(all(dtype == first for dtype in rest), "types differ")
        _check(s.name in FREE or s.dest.dtype == first, "types differ")


def _check_entry(array: ir.Array, base: ir.Value | None, offset: int, x: ir.Value) -> None:
    _check(x.dtype == array.dtype, "types differ")
    if base is None and array.space in ("local", "constant"):  # operands and results have strides
        _check(0 <= offset < array.size, f"not an entry of {array.size}")
    if base is not None:
        _check(base.dtype.kind in "iu", "the index is not an integer")
