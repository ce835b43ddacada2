"""The printer and the verifier of programs."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from rbjax.compiler.cuda.c_source import Printer
from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.operations import OF_PRIMITIVE, OPERATIONS, Operation
from rbjax.compiler.ir.statements import (
    BOOL,
    F64,
    I32,
    I64,
    Array,
    Assign,
    Barrier,
    Block,
    If,
    Load,
    Loop,
    Op,
    Reserve,
    Statement,
    Store,
    Var,
    While,
    walk,
)
from rbjax.compiler.ir.text import block_text, program_text
from rbjax.compiler.ir.verify import InvalidProgram, verify, verify_block
from rbjax.compiler.llvm.operations import Operations
from rbjax.compiler.lower.elementwise import OF_PRIMITIVE as LOWERED
from rbjax.compiler.lower.lowering import RULES
from tests.compiler.host import written

X = np.ones((2, 3))
ONE, TWO = np.float64(1), np.float64(2)
A, B, I, C = (Var(k, dtype) for k, dtype in enumerate((F64, F64, I32, BOOL)))
OPERAND = Array(10, F64, 3, "operand")
LOCAL = Array(11, F64, 3, "local")


def controlled(x):
    y = lax.fori_loop(0, 4, lambda k, c: c * x.sum(), 1.0)
    z = lax.while_loop(lambda s: s < 100.0, lambda s: s * 2.0, y)
    return jnp.where(z > 3.0, z, -z), lax.cond(x[0] > 0.0, jnp.sin, jnp.cos, x)


def test_the_text_of_a_program():
    program, _, _ = written(lambda x: 2.0 * x.sum(), X)
    assert program_text(program).splitlines() == [
        "operand a0: float64[3]",
        "result a1: float64[1]",
        "t2: float64 = a0[0]",
        "t3: float64 = a0[1]",
        "t4: float64 = a0[2]",
        "t5: float64 = add(t2, t3)",
        "t6: float64 = add(t5, t4)",
        "t7: float64 = mul(2.0, t6)",
        "a1[0] = t7",
    ]


def test_the_text_shows_every_statement():
    program, _, _ = written(controlled, X)
    text = program_text(program)
    assert len(text.splitlines()) >= sum(1 for _ in walk(program.builder.block))
    for part in ("for t", "while:", "do if t", "if t", "else:", "var t", ":= t", "select("):
        assert part in text, part
    team = Loop(I, 4, False, Block([Store(LOCAL, I, 1, TWO)]), team=True, group=3)
    assert block_text(Block([Reserve(LOCAL), team, Barrier()])).splitlines() == [
        "local a11: float64[3]", "for t2 in 0..4 team group 3:", "  a11[t2 +1] = 2.0", "barrier",
    ]  # fmt: skip


def test_programs_are_valid():
    """`written` verifies each program of the other tests; this is one with all statements."""
    program, _, _ = written(controlled, X)
    verify(program)


@pytest.mark.parametrize(
    ("message", "statements"),
    [
        ("t0 is not defined here", [Op(B, "neg", (A,))]),
        ("t1 is defined twice", [Op(B, "neg", (ONE,)), Op(B, "neg", (TWO,))]),
        ("no operation twice", [Op(B, "twice", (ONE,))]),
        ("add has 2 arguments", [Op(B, "add", (ONE,))]),
        ("types differ", [Op(B, "add", (ONE, np.float32(1)))]),
        ("types differ", [Op(I, "neg", (ONE,))]),
        ("types differ", [Op(B, "select", (ONE, ONE, ONE))]),
        ("types differ", [Load(I, OPERAND, None, 0)]),
        ("a operand array is written", [Store(OPERAND, None, 0, ONE)]),
        ("a11 is not defined here", [Store(LOCAL, None, 0, ONE)]),
        ("not an entry of 3", [Reserve(LOCAL), Load(B, LOCAL, None, 3)]),
        ("the index is not an integer", [Load(B, OPERAND, ONE, 0)]),
        ("t1 is assigned but not declared", [Op(B, "neg", (ONE,)), Assign(B, TWO)]),
        ("not a truth value", [If(ONE, Block(), Block())]),
        ("t3 is not defined here", [While(Block(), C, Block())]),
        ("not a loop of a count", [Loop(Var(9, I64), 3, False, Block())]),
        ("t1 is not defined here", [Loop(I, 3, False, Block([Op(B, "neg", (ONE,))])),
                                    Op(A, "neg", (B,))]),
        ("a barrier in a loop", [Loop(I, 3, False, Block([Barrier()]), team=True)]),
    ],
)  # fmt: skip
def test_what_is_not_valid(message: str, statements: list[Statement]):
    with pytest.raises(InvalidProgram, match=message):
        verify_block(Block(statements), [OPERAND])


def test_the_condition_of_a_while_is_a_value_of_its_test():
    test = Block([Op(C, "lt", (ONE, TWO))])
    verify_block(Block([While(test, C, Block([Op(B, "cast", (C,))]))]))


def test_each_statement_names_what_it_reads_and_writes():
    assert Op(B, "add", (A, ONE)).reads() == (A,) and Op(B, "add", (A, ONE)).writes() == (B,)
    assert Load(B, OPERAND, I, 0).reads() == (OPERAND, I)
    assert Store(LOCAL, I, 0, A).reads() == (I, A) and Store(LOCAL, I, 0, A).writes() == (LOCAL,)
    inner = Block([Op(B, "neg", (A,))])
    both = If(C, inner, Block([Op(I, "neg", (I,))]))
    assert both.reads() == (C,) and both.children()[0] is inner
    assert [type(s) for s in walk(Block([both]))] == [If, Op, Op]


def test_the_table_of_operations():
    """Each primitive of the table has the table's rule; known arguments fold to the result's type;
    operations that commute are computed once."""
    assert all(RULES[name] is RULES["add"] for name in OF_PRIMITIVE) and LOWERED is OF_PRIMITIVE
    for name, operation in OPERATIONS.items():
        args = [np.float64(0.5)] * operation.arity
        if operation.fold is None or name in {"and", "or", "xor", "not", "shl", "index_add"}:
            continue
        kind = BOOL if name in {"lt", "le", "gt", "ge", "eq", "ne", "isfinite"} else F64
        found = Builder().op(name, kind, *args)
        assert isinstance(found, np.generic) and found.dtype == kind, name
        assert name == operation.name
    for name, operation in OPERATIONS.items():
        if operation.arity == 2:
            b, kind = Builder(), I32
            x, y = b.var(kind), b.var(kind)
            same = b.op(name, kind, x, y) is b.op(name, kind, y, x)
            assert same == operation.commutes, name


def test_an_operation_is_one_row_of_the_table(monkeypatch):
    """The builder, the verifier and both back ends need nothing else."""
    row = Operation(
        "twice", 1, c=lambda kind, of, x: f"{x[0]}+{x[0]}",
        llvm=lambda w, kind, of, x: f"fadd {w.type(kind)} {x[0]}, {x[0]}", fold=lambda x: x + x,
    )  # fmt: skip
    monkeypatch.setitem(OPERATIONS, "twice", row)
    b = Builder()
    x = b.load(OPERAND, None, 0)
    y = b.op("twice", F64, x)
    assert b.op("twice", F64, np.float64(2)) == 4 and b.op("twice", F64, x) is y
    verify_block(b.block, [OPERAND])
    assert list(Printer({}).lines(b.block))[1:] == [f"const double t{y.id}=t{x.id}+t{x.id};"]
    for lanes, t in ((1, "double"), (4, "<4 x double>")):
        lines: list[str] = []
        Operations(lines.append, lanes).write(b.block.statements[-1], "%y", ["%x"])
        assert lines == [f"%y = fadd {t} %x, %x"]
