"""Text of a program, for its reader: one statement a line, inner blocks indented.

operand a0: float64[3]
result a1: float64[]
for t4 in 0..3:
  t5: float64 = a0[t4]
  t6: float64 = mul(t5, 2.0)
"""

from __future__ import annotations

from collections.abc import Iterator

from rbjax.compiler.ir.program import Written
from rbjax.compiler.ir.statements import (
    Array,
    Assign,
    Await,
    Barrier,
    Block,
    Declare,
    If,
    Load,
    Loop,
    Op,
    Reserve,
    Statement,
    Store,
    Value,
    Var,
    While,
)

INDENT = "  "


def program_text(program: Written) -> str:
    """The text of a program: its arrays, then its statements."""
    arrays = (*program.operands, *program.results, *program.builder.tables)
    lines = [f"{'table' if x.space == 'constant' else x.space} {_array(x)}" for x in arrays]
    return "\n".join([*lines, *_lines(program.builder.block)])


def block_text(block: Block) -> str:
    """The text of a block."""
    return "\n".join(_lines(block))


def statement_text(statement: Statement) -> str:
    """The text of a statement, without its inner blocks."""
    match statement:
        case Op(dest=dest, name=name, args=args):
            return f"{_typed(dest)} = {name}({', '.join(map(_value, args))})"
        case Load(dest=dest, array=array, base=base, offset=offset):
            return f"{_typed(dest)} = {_entry(array, base, offset)}"
        case Store(array=array, base=base, offset=offset, value=value):
            return f"{_entry(array, base, offset)} = {_value(value)}"
        case Declare(var=var, value=value):
            return f"var {_typed(var)}" + ("" if value is None else f" = {_value(value)}")
        case Assign(var=var, value=value):
            return f"{_value(var)} := {_value(value)}"
        case Reserve(array=array):
            return f"local {_array(array)}"
        case Loop(counter=counter, count=count):
            turns = f"{count}..0" if statement.reverse else f"0..{count}"
            team = f" team group {statement.group}" if statement.team else ""
            return f"for {_value(counter)} in {turns}{team}{' prefetch' * statement.prefetch}:"
        case While():
            return "while:"
        case If(condition=condition):
            return f"if {_value(condition)}:"
        case Await() | Barrier():
            return type(statement).__name__.lower()
    raise TypeError(f"no such statement: {statement!r}")


def _lines(block: Block, indent: str = "") -> Iterator[str]:
    inner = indent + INDENT
    for statement in block.statements:
        yield indent + statement_text(statement)
        match statement:
            case Loop(body=body):
                yield from _lines(body, inner)
            case While(test=test, condition=condition, body=body):
                yield from _lines(test, inner)
                yield f"{indent}do if {_value(condition)}:"
                yield from _lines(body, inner)
            case If(then=then, otherwise=otherwise):
                yield from _lines(then, inner)
                if otherwise.statements:
                    yield f"{indent}else:"
                    yield from _lines(otherwise, inner)


def _value(x: Value) -> str:
    return f"t{x.id}" if isinstance(x, Var) else str(x)


def _typed(x: Var) -> str:
    return f"t{x.id}: {x.dtype}"


def _array(x: Array) -> str:
    return f"a{x.id}: {x.dtype}[{x.size}]{' shared' * x.shared}"


def _entry(array: Array, base: Value | None, offset: int) -> str:
    if base is None:
        return f"a{array.id}[{offset}]"
    return f"a{array.id}[{_value(base)}{f' {offset:+d}' if offset else ''}]"
