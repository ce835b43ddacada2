"""A program as C, for both NVRTC and a host's C compiler.

Only the code around it (`frame`) depends on the compiler.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from rbjax.compiler.ir.program import (
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
    Store,
    Value,
    Var,
    While,
)
from rbjax.compiler.lower.lowering import Unsupported

C_TYPES = {
    "float32": "float", "float64": "double", "bool": "bool", "int8": "signed char",
    "uint8": "unsigned char", "int16": "short", "uint16": "unsigned short", "int32": "int",
    "uint32": "unsigned", "int64": "long long", "uint64": "unsigned long long",
}  # fmt: skip

INFIX = {
    "index_add": "+", "index_mul": "*", "index_div": "/", "index_mod": "%", "add": "+", "sub": "-",
    "mul": "*", "div": "/",
    "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!=", "and": "&", "or": "|",
    "xor": "^",
}  # fmt: skip
#: functions of C's mathematics, f appended for float
MATH = {
    "sqrt": "sqrt", "cbrt": "cbrt", "exp": "exp", "exp2": "exp2", "expm1": "expm1", "log": "log",
    "log1p": "log1p", "log2": "log2", "sin": "sin", "cos": "cos", "tan": "tan", "asin": "asin",
    "acos": "acos", "atan": "atan", "sinh": "sinh", "cosh": "cosh", "tanh": "tanh",
    "asinh": "asinh", "acosh": "acosh", "atanh": "atanh", "erf": "erf", "erfc": "erfc",
    "lgamma": "lgamma", "floor": "floor", "ceil": "ceil", "rint": "rint", "round": "round",
    "atan2": "atan2", "pow": "pow", "fmod": "fmod", "nextafter": "nextafter",
    "copysign": "copysign",
}  # fmt: skip

#: operations that C leaves undefined, as XLA defines them
PREAMBLE = """
template <class T> QUALIFIED T idiv(T a, T b) {
  if (b == 0) return (T)-1;
  return b == (T)-1 && (T)-1 < 0 ? (T)(0 - a) : (T)(a / b);
}
template <class T> QUALIFIED T irem(T a, T b) {
  if (b == 0) return a;
  return b == (T)-1 && (T)-1 < 0 ? (T)0 : (T)(a % b);
}
template <class T> QUALIFIED T shl(T a, T b) {
  return b >= 0 && b < 8 * (int)sizeof(T) ? (T)((unsigned long long)a << b) : (T)0;
}
template <class T> QUALIFIED T sar(T a, T b) {
  const int most = 8 * sizeof(T) - 1;
  return a >> (b >= 0 && b <= most ? (int)b : most);
}
template <class T> QUALIFIED int popcount(T a) {
  int n = 0;
  for (unsigned i = 0; i < 8 * sizeof(T); i++) n += (int)((a >> i) & 1);
  return n;
}
template <class T> QUALIFIED int clz(T a) {
  int n = 0;
  for (int i = 8 * (int)sizeof(T) - 1; i >= 0 && !((a >> i) & 1); i--) n++;
  return n;
}
template <class I, class F> QUALIFIED I to_integer(F x) {
  const I most = (I)(((unsigned long long)~0ull) >> (64 - 8 * sizeof(I) + ((I)-1 < 0)));
  const I least = (I)-1 < 0 ? (I)(-most - 1) : (I)0;
  if (x != x) return 0;
  if (x >= (F)most) return most;
  return x <= (F)least ? least : (I)x;
}
template <class T, class S> QUALIFIED T bits_of(S x) {
  union { S from; T to; } both;
  both.from = x;
  return both.to;
}
"""


def c_type(dtype: Any) -> str:
    return C_TYPES[np.dtype(dtype).name]


#: turns of a loop that moves entries that run at a time, and statements of such a loop
GROUP, SHORT_BODY = 16, 10


def literal(x: Any) -> str:
    """A known number."""
    kind = x.dtype.kind
    if kind == "b":
        return "true" if x else "false"
    if kind in "iu":
        suffix = {"int64": "ll", "uint64": "ull", "uint32": "u"}.get(x.dtype.name, "")
        if x.dtype == np.int64 and x == np.iinfo(np.int64).min:
            return "(-9223372036854775807ll-1)"
        if x.dtype == np.int32 and x == np.iinfo(np.int32).min:
            return "(-2147483647-1)"
        text = f"{int(x)}{suffix}"
        return f"({text})" if x < 0 else text
    f = "f" if x.dtype == np.float32 else ""
    if np.isnan(x):
        return f"((c_{c_type(x.dtype)})NAN)"
    if np.isinf(x):
        return f"({'-' if x < 0 else ''}(c_{c_type(x.dtype)})INFINITY)"
    text = f"{float(x)!r}{f}"
    return f"({text})" if np.signbit(x) else text


def _moves_entries(loop: Loop) -> bool:
    """Whether a loop is a few loads and operations whose results go to local arrays that it does
    not read: a thread waits for memory once for several turns, and not at each."""
    body = loop.body.statements
    if loop.count < GROUP or loop.reverse or len(body) > SHORT_BODY:
        return False
    if not all(isinstance(s, Op | Load | Store) for s in body):
        return False
    read = {s.array for s in body if isinstance(s, Load)}
    written = {s.array for s in body if isinstance(s, Store)}
    return bool(written) and not read & written and all(a.space == "local" for a in written)


class Printer:
    """Prints blocks; `address(array)` gives the C name of an array that is indexed."""

    def __init__(self, names: dict[int, str]):
        self.names = names

    def value(self, x: Value) -> str:
        return f"t{x.id}" if isinstance(x, Var) else literal(x)

    def place(self, array: Array, base: Value | None, offset: int) -> str:
        name = self.names.get(array.id) or self.names.setdefault(array.id, _name(array))
        if base is None:
            return f"{name}[{offset}]"
        return f"{name}[{self.value(base)}{f'+{offset}' if offset > 0 else offset or ''}]"

    def lines(self, block: Block) -> Iterator[str]:
        for statement in block.statements:
            yield from self._lines(statement)

    def _lines(self, statement: Any) -> Iterator[str]:
        v = self.value
        match statement:
            case Op(dest=dest):
                yield f"const {c_type(dest.dtype)} {v(dest)}={self.expression(statement)};"
            case Load(dest=dest, array=array, base=base, offset=offset):
                yield f"const {c_type(dest.dtype)} {v(dest)}={self.place(array, base, offset)};"
            case Store(array=array, base=base, offset=offset, value=value):
                yield f"{self.place(array, base, offset)}={v(value)};"
            case Declare(var=var, value=None):
                yield f"{c_type(var.dtype)} {v(var)};"
            case Declare(var=var, value=value):
                yield f"{c_type(var.dtype)} {v(var)}={v(value)};"
            case Assign(var=var, value=value):
                yield f"{v(var)}={v(value)};"
            case Reserve(array=array):
                yield f"{c_type(array.dtype)} a{array.id}[{max(array.size, 1)}];"
            case Loop() if _moves_entries(statement):
                yield from self._in_groups(statement)
            case Loop(counter=counter, count=count, reverse=reverse, body=body):
                i = v(counter)
                yield "#pragma unroll 1"
                if reverse:
                    yield f"for(int {i}={count - 1};{i}>=0;{i}--){{"
                else:
                    yield f"for(int {i}=0;{i}<{count};{i}++){{"
                yield from self.lines(body)
                yield "}"
            case While(test=test, condition=condition, body=body):
                yield "#pragma unroll 1"
                yield "for(;;){"
                yield from self.lines(test)
                yield f"if(!({v(condition)}))break;"
                yield from self.lines(body)
                yield "}"
            case If(condition=condition, then=then, otherwise=otherwise):
                yield f"if({v(condition)}){{"
                yield from self.lines(then)
                if otherwise.statements:
                    yield "}else{"
                    yield from self.lines(otherwise)
                yield "}"
            case Await() | Barrier():  # of a team
                return
            case _:
                raise TypeError(f"no such statement: {statement}")

    def _in_groups(self, loop: Loop) -> Iterator[str]:
        """Some turns at a time, which read all that they read before they write."""
        body, i = loop.body.statements, self.value(loop.counter)
        own = {self.value(s.dest) for s in body if not isinstance(s, Store)} | {i}
        name = re.compile("|".join(rf"\b{x}\b" for x in own))
        first = [s for s in body if not isinstance(s, Store)]
        last = [s for s in body if isinstance(s, Store)]
        reads, writes = ([x for s in some for x in self._lines(s)] for some in (first, last))
        rounds, rest = divmod(loop.count, GROUP)
        for start, turns, size in ((0, rounds, GROUP), (rounds * GROUP, 1, rest)):
            if not turns * size:
                continue
            yield "#pragma unroll 1"
            yield f"for(int g{i}={start};g{i}<{start + turns * size};g{i}+={size}){{"
            yield from (f"const int {i}_{k}=g{i}+{k};" for k in range(size))
            for lines in (reads, writes):
                for k in range(size):
                    yield from (name.sub(rf"\g<0>_{k}", x) for x in lines)
            yield "}"

    def expression(self, op: Op) -> str:
        x = [self.value(a) for a in op.args]
        kind, name = op.dest.dtype, op.name
        f = "f" if kind == np.float32 else ""
        if kind.kind == "i" and name in ("add", "sub", "mul", "neg", "abs"):
            return self._wrapping(kind, name, x)
        if name in INFIX:
            return self._narrow(kind, f"{x[0]}{INFIX[name]}{x[1]}")
        if name == "neg":
            return self._narrow(kind, f"-{x[0]}")
        if name == "not":
            return f"!{x[0]}" if kind.kind == "b" else self._narrow(kind, f"~{x[0]}")
        if name == "select":
            return f"{x[0]}?{x[1]}:{x[2]}"
        if name == "cast":
            return self._cast(op, x[0])
        if name in ("max", "min"):
            if kind.kind == "b":
                return f"{x[0]}{'|' if name == 'max' else '&'}{x[1]}"
            test = f"{x[0]}{'>' if name == 'max' else '<'}{x[1]}"
            nan = f"||{x[0]}!={x[0]}" if kind.kind == "f" else ""
            return f"({test}{nan})?{x[0]}:{x[1]}"
        if name == "abs":
            return f"fabs{f}({x[0]})" if kind.kind == "f" else x[0]
        if name == "rsqrt":
            return f"RSQRT{f}({x[0]})"
        if name == "isfinite":
            return f"(bool)isfinite({x[0]})"
        if name == "bitcast":
            return f"bits_of<{c_type(kind)},{c_type(op.args[0].dtype)}>({x[0]})"
        if name == "sar":
            signed = C_TYPES[f"int{8 * kind.itemsize}"]
            return f"({c_type(kind)})sar<{signed}>(({signed}){x[0]},({signed}){x[1]})"
        if name in ("idiv", "irem", "shl"):
            return f"{name}<{c_type(kind)}>({x[0]},{x[1]})"
        if name == "shr":
            unsigned = C_TYPES[f"uint{8 * kind.itemsize}"]
            inside = f"{x[1]}>=0&&{x[1]}<{8 * kind.itemsize}"
            return f"({inside})?({c_type(kind)})(({unsigned}){x[0]}>>{x[1]}):({c_type(kind)})0"
        if name in ("popcount", "clz"):
            unsigned = C_TYPES[f"uint{8 * kind.itemsize}"]
            return f"({c_type(kind)}){name}<{unsigned}>(({unsigned}){x[0]})"
        if name in MATH and kind.kind == "f":
            return f"{MATH[name]}{f}({','.join(x)})"
        raise Unsupported(f"operation {name} of {kind}")

    def _cast(self, op: Op, x: str) -> str:
        to, source = op.dest.dtype, op.args[0].dtype
        if source.kind == "f" and to.kind in "iu":
            return f"to_integer<{c_type(to)},{c_type(source)}>({x})"
        return f"({c_type(to)}){x}"

    def _wrapping(self, kind: np.dtype, name: str, x: list[str]) -> str:
        """Overflow of signed integers, which C leaves undefined."""
        unsigned = C_TYPES[f"uint{8 * max(kind.itemsize, 4)}"]
        u = [f"({unsigned}){a}" for a in x]
        if name == "abs":
            return f"{x[0]}<0?({c_type(kind)})(0-{u[0]}):{x[0]}"
        if name == "neg":
            return f"({c_type(kind)})(0-{u[0]})"
        return f"({c_type(kind)})({u[0]}{INFIX[name]}{u[1]})"

    def _narrow(self, kind: np.dtype, text: str) -> str:
        """Casts back integers narrower than int, which C computes as int."""
        return f"({c_type(kind)})({text})" if kind.kind in "iu" and kind.itemsize < 4 else text


def _by_bits(array: Array) -> bool:
    """Whether a table has infinities or nan. CUDA does not accept their names as constants, but it
    accepts their bits."""
    return array.data is not None and array.dtype.kind == "f" and not np.isfinite(array.data).all()


def _name(array: Array) -> str:
    if _by_bits(array):
        return f"((const {c_type(array.dtype)}*)a{array.id})"
    return f"a{array.id}"


def table(array: Array, qualifier: str) -> str:
    """The definition of a constant array."""
    data = array.data
    if _by_bits(array):
        data = np.asarray(data).view(f"uint{8 * array.dtype.itemsize}")
    assert data is not None
    numbers = ",".join(literal(x) for x in data) or "0"
    return f"{qualifier} {c_type(data.dtype)} a{array.id}[{max(array.size, 1)}]={{{numbers}}};"
