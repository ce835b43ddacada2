"""The C text of operations. Each function in this module is a `CText` or returns one.

A `CText` maps the dtype of the result, the dtype of the first argument, and the texts of the
arguments to the text of the operation. It returns None for unsupported dtypes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

CText = Callable[[np.dtype, np.dtype, Sequence[str]], str | None]

C_TYPES = {
    "float32": "float", "float64": "double", "bool": "bool", "int8": "signed char",
    "uint8": "unsigned char", "int16": "short", "uint16": "unsigned short", "int32": "int",
    "uint32": "unsigned", "int64": "long long", "uint64": "unsigned long long",
}  # fmt: skip


def c_type(dtype: np.dtype) -> str:
    return C_TYPES[dtype.name]


def signed(dtype: np.dtype) -> str:
    """Return the signed C integer type of the size of dtype."""
    return C_TYPES[f"int{8 * dtype.itemsize}"]


def unsigned(dtype: np.dtype, least: int = 0) -> str:
    """Return the unsigned C integer type of the size of dtype, with at least `least` bytes."""
    return C_TYPES[f"uint{8 * max(dtype.itemsize, least)}"]


def suffix(dtype: np.dtype) -> str:
    """Return the suffix of C's mathematical functions for this dtype: "f" for float32."""
    return "f" if dtype == np.float32 else ""


def narrowed(kind: np.dtype, text: str) -> str:
    """Cast integers narrower than int back to their type, because C computes them as int."""
    return f"({c_type(kind)})({text})" if kind.kind in "iu" and kind.itemsize < 4 else text


def infix(symbol: str, wraps: bool = False) -> CText:
    """Return the text of a binary operator.
    wraps: signed integers wrap around on overflow, which C leaves undefined."""

    def text(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
        if wraps and kind.kind == "i":
            u = unsigned(kind, 4)
            return f"({c_type(kind)})(({u}){x[0]}{symbol}({u}){x[1]})"
        return narrowed(kind, f"{x[0]}{symbol}{x[1]}")

    return text


def function(name: str) -> CText:
    """Return the text of a C mathematical function."""

    def text(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str | None:
        return f"{name}{suffix(kind)}({','.join(x)})" if kind.kind == "f" else None

    return text


def helper(name: str) -> CText:
    """Return the text of a call of a function template of the preamble, for the result's type."""
    return lambda kind, of, x: f"{name}<{c_type(kind)}>({x[0]},{x[1]})"


def counted(name: str) -> CText:
    """Return the text of a bit-counting function of the preamble."""

    def text(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
        u = unsigned(kind)
        return f"({c_type(kind)}){name}<{u}>(({u}){x[0]})"

    return text


def larger(symbol: str, logical: str) -> CText:
    """Return the text of the maximum or minimum. The result is nan if the first argument is nan."""

    def text(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
        if kind.kind == "b":
            return f"{x[0]}{logical}{x[1]}"
        nan = f"||{x[0]}!={x[0]}" if kind.kind == "f" else ""
        return f"({x[0]}{symbol}{x[1]}{nan})?{x[0]}:{x[1]}"

    return text


def negative(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    if kind.kind == "i":
        return f"({c_type(kind)})(0-({unsigned(kind, 4)}){x[0]})"
    return narrowed(kind, f"-{x[0]}")


def absolute(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    if kind.kind == "i":
        return f"{x[0]}<0?({c_type(kind)})(0-({unsigned(kind, 4)}){x[0]}):{x[0]}"
    return f"fabs{suffix(kind)}({x[0]})" if kind.kind == "f" else x[0]


def inverted(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    return f"!{x[0]}" if kind.kind == "b" else narrowed(kind, f"~{x[0]}")


def select(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    return f"{x[0]}?{x[1]}:{x[2]}"


def cast(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    if of.kind == "f" and kind.kind in "iu":
        return f"to_integer<{c_type(kind)},{c_type(of)}>({x[0]})"
    return f"({c_type(kind)}){x[0]}"


def bitcast(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    return f"bits_of<{c_type(kind)},{c_type(of)}>({x[0]})"


def shift_right(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    """Return the text of a logical right shift. A shift by all bits or more returns 0."""
    inside = f"{x[1]}>=0&&{x[1]}<{8 * kind.itemsize}"
    shifted = f"({c_type(kind)})(({unsigned(kind)}){x[0]}>>{x[1]})"
    return f"({inside})?{shifted}:({c_type(kind)})0"


def shift_arithmetic(kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    s = signed(kind)
    return f"({c_type(kind)})sar<{s}>(({s}){x[0]},({s}){x[1]})"


# ------------------------------ operations that C leaves undefined for some arguments, as in XLA

IDIV = """
template <class T> QUALIFIED T idiv(T a, T b) {
  if (b == 0) return (T)-1;
  return b == (T)-1 && (T)-1 < 0 ? (T)(0 - a) : (T)(a / b);
}"""
IREM = """
template <class T> QUALIFIED T irem(T a, T b) {
  if (b == 0) return a;
  return b == (T)-1 && (T)-1 < 0 ? (T)0 : (T)(a % b);
}"""
SHL = """
template <class T> QUALIFIED T shl(T a, T b) {
  return b >= 0 && b < 8 * (int)sizeof(T) ? (T)((unsigned long long)a << b) : (T)0;
}"""
SAR = """
template <class T> QUALIFIED T sar(T a, T b) {
  const int most = 8 * sizeof(T) - 1;
  return a >> (b >= 0 && b <= most ? (int)b : most);
}"""
POPCOUNT = """
template <class T> QUALIFIED int popcount(T a) {
  int n = 0;
  for (unsigned i = 0; i < 8 * sizeof(T); i++) n += (int)((a >> i) & 1);
  return n;
}"""
CLZ = """
template <class T> QUALIFIED int clz(T a) {
  int n = 0;
  for (int i = 8 * (int)sizeof(T) - 1; i >= 0 && !((a >> i) & 1); i--) n++;
  return n;
}"""
TO_INTEGER = """
template <class I, class F> QUALIFIED I to_integer(F x) {
  const I most = (I)(((unsigned long long)~0ull) >> (64 - 8 * sizeof(I) + ((I)-1 < 0)));
  const I least = (I)-1 < 0 ? (I)(-most - 1) : (I)0;
  if (x != x) return 0;
  if (x >= (F)most) return most;
  return x <= (F)least ? least : (I)x;
}"""
BITS_OF = """
template <class T, class S> QUALIFIED T bits_of(S x) {
  union { S from; T to; } both;
  both.from = x;
  return both.to;
}"""
