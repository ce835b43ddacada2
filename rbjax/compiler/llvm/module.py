"""A program of one sample as LLVM IR: a function that is called with numpy arrays.

`int run(known, operands, results)` gets two tuples of arrays and reads their data in place. `known`
holds the address of numpy's type of arrays and those of the operands' dtypes. It returns 0; or 1 if
an operand is not an array of the type and shape of the program, whose entries lie one after
another; or -1 without memory. It knows nothing of Python, so it runs without the GIL.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from rbjax.compiler.ir.program import Written
from rbjax.compiler.llvm import numpy_abi
from rbjax.compiler.llvm.statements import MALLOC, one_sample


@dataclass(frozen=True)
class Module:
    """LLVM IR with a function `run`, and the functions outside of it that it calls."""

    text: str
    symbols: tuple[str, ...]


def module(program: Written) -> Module:
    """The function `run` of a program without a batch."""
    sample, frame = one_sample(program), _Arrays()
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
    """Reads tuples of numpy arrays."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.names = itertools.count()

    def made(self, text: str) -> str:
        name = f"%v{next(self.names)}"
        self.lines.append(f"{name} = {text}")
        return name

    def field(self, struct: str, offset: int, t: str) -> str:
        """A member of a struct."""
        place = self.made(f"getelementptr i8, ptr {struct}, i64 {offset}")
        return self.made(f"load {t}, ptr {place}")

    def data(self, arrays: str, k: int) -> str:
        """The data of the k-th array of a tuple."""
        array = self.field(arrays, numpy_abi.ITEMS + 8 * k, "ptr")
        return self.field(array, numpy_abi.DATA, "ptr")

    def operands(self, program: Written) -> list[str]:
        """The data of the operands, after checks that they are what the program expects."""
        self._expect("%xs", numpy_abi.COUNT, "i64", str(len(program.operands)))
        out = []
        for k, layout in enumerate(program.layouts[0]):
            x = self.field("%xs", numpy_abi.ITEMS + 8 * k, "ptr")
            self._expect(x, numpy_abi.TYPE, "ptr", self.field("%known", 0, "ptr"))
            self._expect(x, numpy_abi.DESCR, "ptr", self.field("%known", 8 * (k + 1), "ptr"))
            self._expect(x, numpy_abi.ND, "i32", str(len(layout.shape)))
            flags = self.field(x, numpy_abi.FLAGS, "i32")
            plain = self.made(f"and i32 {flags}, {numpy_abi.PLAIN}")
            self._same("i32", plain, str(numpy_abi.PLAIN))
            if layout.shape:
                sizes = self.field(x, numpy_abi.DIMENSIONS, "ptr")
            for axis, size in enumerate(layout.shape):
                self._expect(sizes, 8 * axis, "i64", str(size))
            out.append(self.field(x, numpy_abi.DATA, "ptr"))
        return out

    def _expect(self, x: str, offset: int, t: str, wanted: str) -> None:
        self._same(t, self.field(x, offset, t), wanted)

    def _same(self, t: str, found: str, wanted: str) -> None:
        """Goes on only if two values are equal."""
        good = f"good{next(self.names)}"
        same = self.made(f"icmp eq {t} {found}, {wanted}")
        self.lines += [f"br i1 {same}, label %{good}, label %other", f"{good}:"]
