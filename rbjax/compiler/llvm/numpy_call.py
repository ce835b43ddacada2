"""A program of one sample as LLVM IR: a function that is called with numpy arrays.

`int run(known, operands, results)` receives two tuples of arrays and reads their data in place.
`known` contains the addresses of the type `np.ndarray` and of the operands' dtypes. The function
returns 0, or 1 if an operand is not a contiguous array of the program's dtype and shape, or -1 if
memory runs out. It does not call Python, so it runs without the GIL.

Tuples and arrays have the memory layout of `PyTupleObject` and `PyArrayObject`:

    object header | count | ... | items
    object header | data | nd | dimensions | strides | base | descr | flags

Arrays have had this layout since numpy 1.7. `layout_is_known` compares it with live objects, so
another Python (without the GIL, or of 32 bits) is detected before code relies on the layout.
"""

from __future__ import annotations

import ctypes
import functools
import itertools

import numpy as np

from rbjax.compiler.ir.program import Written
from rbjax.compiler.llvm.jit import Module
from rbjax.compiler.llvm.statements import MALLOC, write_sample

TYPE, DATA, ND, DIMENSIONS, DESCR, FLAGS = 8, 16, 24, 32, 56, 64
COUNT, ITEMS = 16, tuple.__basicsize__
#: numpy's flags C_CONTIGUOUS and ALIGNED
PLAIN = 0x1 | 0x100


@functools.cache
def layout_is_known() -> bool:
    """Return whether arrays of this Python and this numpy have the expected memory layout."""
    if np.ndarray.__basicsize__ < FLAGS + 8 or object.__basicsize__ != DATA:
        return False
    x = np.empty((2, 3), np.float32)
    some: tuple[np.ndarray, ...] = (x, x.T, np.empty((), np.int64), np.empty(0, bool))
    count = ctypes.c_ssize_t.from_address(id(some) + COUNT).value
    items = (ctypes.c_size_t * len(some)).from_address(id(some) + ITEMS)
    same = count == len(some) and [*items] == [id(y) for y in some]
    return same and all(map(_has_layout, some))


def _has_layout(x: np.ndarray) -> bool:
    def word(offset: int) -> int:
        return ctypes.c_size_t.from_address(id(x) + offset).value

    def number(offset: int) -> int:
        return ctypes.c_int.from_address(id(x) + offset).value

    if number(ND) != x.ndim or (word(TYPE), word(DESCR)) != (id(type(x)), id(x.dtype)):
        return False
    shape = (ctypes.c_ssize_t * x.ndim).from_address(word(DIMENSIONS)) if x.ndim else ()
    plain = x.flags.c_contiguous and x.flags.aligned
    same = word(DATA) == x.ctypes.data and tuple(shape) == x.shape
    return same and (number(FLAGS) & PLAIN == PLAIN) == plain


def write_module(program: Written) -> Module:
    """Print the function `run` of a program without a batch."""
    sample, frame = write_sample(program), _Arrays()
    xs = frame.operands(program)
    ys = [frame.data("%ys", k) for k in range(len(program.results))]
    space, lines = "null", [*frame.lines]
    if sample.workspace:
        space = "%space"
        lines += [
            f"%space = call ptr @malloc(i64 {sample.workspace})",
            "%nothing = icmp eq ptr %space, null",
            "br i1 %nothing, label %full, label %start",
            "full:", "ret i32 -1", "start:",
        ]  # fmt: skip
    lines.append(sample.call([*xs, *ys], space))
    if sample.workspace:
        lines.append("call void @free(ptr %space)")
    parts = [
        *(MALLOC if sample.workspace else ()), *sample.outside, sample.text,
        "define i32 @run(ptr %known, ptr %xs, ptr %ys) nounwind {",
        *lines, "ret i32 0", "other:", "ret i32 1", "}",
    ]  # fmt: skip
    return Module("\n".join(parts), sample.libm)


class _Arrays:
    """An emitter of instructions that read tuples of numpy arrays."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.names = itertools.count()

    def made(self, text: str) -> str:
        name = f"%v{next(self.names)}"
        self.lines.append(f"{name} = {text}")
        return name

    def field(self, struct: str, offset: int, t: str) -> str:
        """Emit the load of a member of a struct."""
        place = self.made(f"getelementptr i8, ptr {struct}, i64 {offset}")
        return self.made(f"load {t}, ptr {place}")

    def data(self, arrays: str, k: int) -> str:
        """Emit the load of the data address of the k-th array of a tuple."""
        array = self.field(arrays, ITEMS + 8 * k, "ptr")
        return self.field(array, DATA, "ptr")

    def operands(self, program: Written) -> list[str]:
        """Emit checks of the operands' types and shapes. Return the addresses of their data."""
        self._expect("%xs", COUNT, "i64", str(len(program.operands)))
        out = []
        for k, layout in enumerate(program.layouts[0]):
            x = self.field("%xs", ITEMS + 8 * k, "ptr")
            self._expect(x, TYPE, "ptr", self.field("%known", 0, "ptr"))
            self._expect(x, DESCR, "ptr", self.field("%known", 8 * (k + 1), "ptr"))
            self._expect(x, ND, "i32", str(len(layout.shape)))
            flags = self.field(x, FLAGS, "i32")
            plain = self.made(f"and i32 {flags}, {PLAIN}")
            self._same("i32", plain, str(PLAIN))
            if layout.shape:
                sizes = self.field(x, DIMENSIONS, "ptr")
            for axis, size in enumerate(layout.shape):
                self._expect(sizes, 8 * axis, "i64", str(size))
            out.append(self.field(x, DATA, "ptr"))
        return out

    def _expect(self, x: str, offset: int, t: str, wanted: str) -> None:
        self._same(t, self.field(x, offset, t), wanted)

    def _same(self, t: str, found: str, wanted: str) -> None:
        """Emit a branch to the failure label `other` unless two values are equal."""
        good = f"good{next(self.names)}"
        same = self.made(f"icmp eq {t} {found}, {wanted}")
        self.lines += [f"br i1 {same}, label %{good}, label %other", f"{good}:"]
