"""A readable text form of a program, with one statement per line and indented inner blocks.

operand a0: float64[3]
result a1: float64[]
for t4 in 0..3:
  t5: float64 = a0[t4]
  t6: float64 = mul(t5, 2.0)
"""

from __future__ import annotations

from collections.abc import Iterator

from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.program import Written

INDENT = "  "


def program_text(program: Written) -> str:
    """Return the text of a program: its arrays, then its statements."""
    arrays = (*program.operands, *program.results, *program.builder.tables)
    lines = [f"{'table' if x.space == 'constant' else x.space} {_array(x)}" for x in arrays]
    return "\n".join([*lines, *_lines(program.builder.block)])


def block_text(block: ir.Block) -> str:
    """Return the text of a block."""
    return "\n".join(_lines(block))


def statement_text(statement: ir.Statement) -> str:
    """Return the text of a statement without its inner blocks."""
    match statement:
        case ir.Op(dest=dest, name=name, args=args):
            return f"{_typed(dest)} = {name}({', '.join(map(_value, args))})"
        case ir.Load(dest=dest, array=array, base=base, offset=offset):
            return f"{_typed(dest)} = {_entry(array, base, offset)}"
        case ir.Store(array=array, base=base, offset=offset, value=value):
            return f"{_entry(array, base, offset)} = {_value(value)}"
        case ir.Declare(var=var, value=value):
            return f"var {_typed(var)}" + ("" if value is None else f" = {_value(value)}")
        case ir.Assign(var=var, value=value):
            return f"{_value(var)} := {_value(value)}"
        case ir.Reserve(array=array):
            return f"local {_array(array)}"
        case ir.Loop(counter=counter, count=count):
            turns = f"{count}..0" if statement.reverse else f"0..{count}"
            team = f" team group {statement.group}" if statement.team else ""
            return f"for {_value(counter)} in {turns}{team}{' prefetch' * statement.prefetch}:"
        case ir.While():
            return "while:"
        case ir.If(condition=condition):
            return f"if {_value(condition)}:"
        case ir.Await() | ir.Barrier():
            return type(statement).__name__.lower()
    raise TypeError(f"no such statement: {statement!r}")


def _lines(block: ir.Block, indent: str = "") -> Iterator[str]:
    inner = indent + INDENT
    for statement in block.statements:
        yield indent + statement_text(statement)
        match statement:
            case ir.Loop(body=body):
                yield from _lines(body, inner)
            case ir.While(test=test, condition=condition, body=body):
                yield from _lines(test, inner)
                yield f"{indent}do if {_value(condition)}:"
                yield from _lines(body, inner)
            case ir.If(then=then, otherwise=otherwise):
                yield from _lines(then, inner)
                if otherwise.statements:
                    yield f"{indent}else:"
                    yield from _lines(otherwise, inner)


def _value(x: ir.Value) -> str:
    return f"t{x.id}" if isinstance(x, ir.Var) else str(x)


def _typed(x: ir.Var) -> str:
    return f"t{x.id}: {x.dtype}"


def _array(x: ir.Array) -> str:
    return f"a{x.id}: {x.dtype}[{x.size}]{' shared' * x.shared}"


def _entry(array: ir.Array, base: ir.Value | None, offset: int) -> str:
    if base is None:
        return f"a{array.id}[{offset}]"
    return f"a{array.id}[{_value(base)}{f' {offset:+d}' if offset else ''}]"
