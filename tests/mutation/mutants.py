"""Small faults for a source file: each a mutant, the text that it replaces, and the lines it is on.

What says something and computes nothing is left as it is: docstrings, annotations, messages,
`raise`, imports, `__repr__`, options that change no number. (DeMillo, Lipton & Sayward, *Computer*
11(4), 1978, on mutation; the faults here are those of hand-written kinematics.)
"""

from __future__ import annotations

import ast
import difflib
import math
import random
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass

OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
NAMES = {
    "add": "sub", "sub": "add", "sin": "cos", "cos": "sin", "any": "all", "all": "any",
    "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "set": "add",
    "cross_force": "cross", "lin": "ang", "ang": "lin", "E": "R", "R": "E",
}  # fmt: skip
NUMBERS: dict[float, float] = {0: 1, 1: 0, 0.5: 0.25, 2: 3}
SMALL = range(3, 13)  # other whole numbers are sizes and thresholds
IDENTITIES = {"neg", "stop_gradient"}  # f(x) -> x
SYMMETRIC = {"add", "mul", "dot", "inner", "minimum", "maximum", "max", "min", "isinstance"}
SILENT = {"warn", "field", "cast", "TypeVar", "__repr__", "__str__", "__slots__", "__all__"}
OPTIONS = {"strict", "static", "frozen", "eq", "repr", "inline", "prevent_cse", "stacklevel"}


@dataclass(frozen=True)
class Mutant:
    """`source` of `file` with one fault: `new` for `old` on `line`."""

    file: str
    line: int
    column: int
    kind: str
    old: str
    new: str
    source: str
    #: lines of the statement; a test that executes none of them cannot see the fault
    executed: range

    @property
    def key(self) -> str:
        return f"{self.file}:{self.line}:{self.column}: {self.old} -> {self.new}"

    def diff(self, original: str) -> str:
        before, after = original.splitlines(), self.source.splitlines()
        lines = difflib.unified_diff(before, after, self.file, "mutant", n=2, lineterm="")
        return "\n".join(lines)


def mutants(file: str, text: str) -> list[Mutant]:
    """All mutants of a file's text that parse.

    >>> for mutant in mutants("file.py", "def f(x: int):\\n    return -x + 2"):
    ...     print(mutant.old, "->", mutant.new)
    -x + 2 -> zeros of its shape
    -x + 2 -> -x - 2
    -x -> x
    2 -> 3
    """
    data, found = text.encode(), {}
    starts = [0]
    for line in data.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for kind, node, new, lines in _faults(ast.parse(text)):
        first = starts[node.lineno - 1] + node.col_offset
        last = starts[node.end_lineno - 1] + node.end_col_offset
        replacement = ast.unparse(new)
        compound = (ast.BinOp, ast.BoolOp, ast.Compare, ast.IfExp, ast.Lambda)
        if isinstance(new, compound) and type(new) is not type(node):
            replacement = f"({replacement})"
        source = (data[:first] + replacement.encode() + data[last:]).decode()
        old = " ".join(data[first:last].decode().split())
        shown = {"zeros": "zeros of its shape", "removed": "nothing"}.get(kind, replacement)
        mutant = Mutant(file, node.lineno, node.col_offset, kind, old, shown, source, lines)
        try:
            ast.parse(source)
        except SyntaxError:  # an operand that was in brackets of another node
            continue
        found.setdefault(source, mutant)
    return list(found.values())


def spread(items: Iterable, group: Callable[[object], Hashable], rng: random.Random) -> list:
    """The items in an order in which a group four times as large as another comes twice as often:
    every group has its share of any beginning."""
    groups = defaultdict(list)
    for item in items:
        groups[group(item)].append(item)
    ranked = []
    for members in groups.values():
        pace = math.sqrt(len(members))
        ranked += [((i + rng.random()) / pace, x) for i, x in enumerate(members)]
    return [x for _, x in sorted(ranked, key=lambda pair: pair[0])]


Fault = tuple[str, ast.AST, ast.AST, range]


def _name(node: ast.AST) -> str:
    return getattr(node, "attr", getattr(node, "id", ""))


def _bound(node: ast.Assign) -> set[str]:
    return {x.id for target in node.targets for x in ast.walk(target) if isinstance(x, ast.Name)}


def _silent(node: ast.AST) -> bool:
    """Whether a node says something and computes nothing."""
    if isinstance(node, ast.Call):
        return _name(node.func) in SILENT or _name(node.func).endswith(("Error", "Warning"))
    if isinstance(node, ast.FunctionDef):
        return node.name in SILENT
    if isinstance(node, ast.Assign):
        return _name(node.targets[0]) in SILENT
    if isinstance(node, ast.If):
        return _name(node.test) == "TYPE_CHECKING"
    if isinstance(node, ast.keyword):
        return node.arg in OPTIONS
    if isinstance(node, ast.Expr):
        return isinstance(node.value, (ast.Constant, ast.Yield, ast.YieldFrom))
    return isinstance(node, (ast.Raise, ast.Import, ast.ImportFrom, ast.JoinedStr, ast.Assert))


def _faults(node: ast.AST, lines: range = range(0), bound: frozenset = frozenset()) -> Iterator:
    """The faults of a node and of all below it. `bound`: the names that have a value already."""
    if _silent(node):
        return
    if isinstance(node, ast.stmt):
        body = getattr(node, "body", None)
        end = body[0].lineno - 1 if body else node.end_lineno
        lines = range(node.lineno, max(node.lineno, end) + 1)
        yield from ((*fault, lines) for fault in _of_statement(node, bound))
    if isinstance(node, ast.FunctionDef):
        arguments = node.args
        bound = frozenset(x.arg for x in [*arguments.args, *arguments.kwonlyargs])
    if isinstance(node, ast.expr):
        yield from ((*fault, lines) for fault in _of_expression(node))
    left_out = {"annotation", "returns", "decorator_list", "bases", "type_params"}
    for field, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and field not in left_out:
                yield from _faults(child, lines, bound)
                if isinstance(child, ast.Assign):
                    bound |= _bound(child)


def _of_statement(node: ast.stmt, bound: frozenset) -> Iterator[tuple[str, ast.AST, ast.AST]]:
    again = isinstance(node, ast.Assign) and _bound(node) & bound
    if again or isinstance(node, (ast.AugAssign, ast.Expr)):
        yield "removed", node, ast.Pass()
    if isinstance(node, ast.If):
        yield "branch", node.test, ast.Constant(False)
        if not isinstance(node.body[0], ast.Raise):
            yield "branch", node.test, ast.Constant(True)
    if isinstance(node, ast.Return) and isinstance(node.value, (ast.Call, ast.Tuple, ast.BinOp)):
        zeros = f"__import__('jax').tree.map(lambda x: x * 0, {ast.unparse(node.value)})"
        yield "zeros", node.value, ast.parse(zeros, mode="eval").body


def _of_expression(node: ast.expr) -> Iterator[tuple[str, ast.AST, ast.AST]]:
    match node:
        case ast.BinOp(left, op, right) if type(op) in OPERATORS:
            yield "operator", node, ast.BinOp(left, OPERATORS[type(op)](), right)
        case ast.UnaryOp(ast.USub() | ast.Not(), operand):
            yield "sign", node, operand
        case ast.BoolOp(op, values):
            yield "operator", node, ast.BoolOp(OPERATORS[type(op)](), values)
        case ast.Compare(left, [op], right):
            yield "compared", node, ast.Compare(left, [OPERATORS[type(op)]()], right)
        case ast.IfExp(_, yes, no):
            yield from (("branch", node, yes), ("branch", node, no))
        case ast.Constant(bool(x)):
            yield "constant", node, ast.Constant(not x)
        case ast.Constant(int(x) | float(x)) if x in NUMBERS or x in SMALL:
            yield "constant", node, ast.Constant(type(x)(NUMBERS.get(x, x + 1)))
        case ast.Attribute(value, "T"):
            yield "transpose", node, value
        case ast.Attribute(value, name, ctx) if name in NAMES and isinstance(ctx, ast.Load):
            yield "name", node, ast.Attribute(value, NAMES[name], ctx)
        case ast.Call(ast.Name(name), args, keywords) if name in NAMES:
            yield "name", node, ast.Call(ast.Name(NAMES[name]), args, keywords)
    match node:
        case ast.Call(f, [x]) if _name(f) in IDENTITIES:
            yield "sign", node, x
        case ast.Call(ast.Attribute(a, "cross", ctx), [b], []):
            yield "swapped", node, ast.Call(ast.Attribute(b, "cross", ctx), [a], [])
        case ast.Call(f, [*args], keywords) if len(args) > 1 and _name(f) not in SYMMETRIC:
            i = 1 if _name(f) == "where" and len(args) == 3 else 0
            if type(args[i]) is type(args[i + 1]) or i:
                swapped = [*args[:i], args[i + 1], args[i], *args[i + 2 :]]
                yield "swapped", node, ast.Call(f, swapped, keywords)
