"""Emits accesses to samples in memory as LLVM IR: pointers, tiles of vectors, and sums."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

from rbjax.compiler.ir.program import BatchLayout
from rbjax.compiler.llvm.operations import splat


class Lines(list):
    """A list of LLVM instructions, with fresh names."""

    def __init__(self, like: Lines | None = None):
        super().__init__()
        self.names: Iterator[int] = like.names if like else itertools.count()
        self.declared: list[str] = []

    def made(self, text: str) -> str:
        name = f"%v{next(self.names)}"
        self.append(f"{name} = {text}")
        return name

    def sample(
        self, base: str, t: str, layout: BatchLayout, batch: tuple[int, ...], sample: str
    ) -> str:
        """Emit the pointer to a sample of an array. sample: linear index in the batch."""
        rest, place = sample, base
        for k in reversed(range(len(batch))):
            index = rest
            if k:
                index = self.made(f"urem i64 {rest}, {batch[k]}")
                rest = self.made(f"udiv i64 {rest}, {batch[k]}")
            if layout.steps[k]:
                far = self.made(f"mul i64 {index}, {layout.steps[k]}")
                place = self.made(f"getelementptr {t}, ptr {place}, i64 {far}")
        return place

    def each(
        self, base: str, t: str, layout: BatchLayout, batch: tuple[int, ...], lanes: int,
        step: int | None,
    ) -> list[str]:  # fmt: skip
        """Emit the pointers to `lanes` samples, the first of which has the number %b."""
        if step is not None:
            first = self.sample(base, t, layout, batch, "%b")
            return [self.made(f"getelementptr {t}, ptr {first}, i64 {k * step}")
                    for k in range(lanes)]  # fmt: skip
        return [
            self.sample(base, t, layout, batch, self.made(f"add i64 %b, {k}")) for k in range(lanes)
        ]

    def fill(self, table: str, pointers: Sequence[str]) -> None:
        """Emit the stores of pointers, one for each lane, into a table in memory."""
        for k, place in enumerate(pointers):
            slot = self.made(f"getelementptr ptr, ptr {table}, i64 {k}")
            self.append(f"store ptr {place}, ptr {slot}")

    def loop(self, count: int) -> tuple[str, list[str]]:
        """Begin a loop. Return its counter, and the lines that end it."""
        n = next(self.names)
        self += [
            f"br label %before{n}", f"before{n}:", f"br label %turn{n}", f"turn{n}:",
            f"%i{n} = phi i64 [0, %before{n}], [%j{n}, %turn{n}]",
        ]  # fmt: skip
        return f"%i{n}", [
            f"%j{n} = add i64 %i{n}, 1", f"%more{n} = icmp slt i64 %j{n}, {count}",
            f"br i1 %more{n}, label %turn{n}, label %after{n}", f"after{n}:",
        ]  # fmt: skip

    def blocks(self, lanes: int, count: int) -> tuple[int, str, list[str]]:
        """Begin a loop over blocks of entries, of which the last may overlap the one before it.
        Return the size of a block, its first entry, and the lines that end the loop."""
        size = min(lanes, 1 << count.bit_length() - 1)
        k, end = self.loop(-(-count // size))
        first = self.made(f"mul i64 {k}, {size}")
        return size, self.made(f"call i64 @llvm.smin.i64(i64 {first}, i64 {count - size})"), end

    def tile_of_rows(self, tile: str, rows: Sequence[str], t: str, count: int) -> None:
        """Emit the transposition of rows, one per lane, to a tile of one vector per entry."""
        lanes = len(rows)
        size, i, end = self.blocks(lanes, count)
        one = f"<{size} x {t}>"
        places = [self.made(f"getelementptr {t}, ptr {row}, i64 {i}") for row in rows]
        found = [self.made(f"load {one}, ptr {place}, align 1") for place in places]
        groups = [self.turned(found[k : k + size], t) for k in range(0, lanes, size)]
        for e, pieces in enumerate(zip(*groups, strict=True)):
            place = self.made(f"getelementptr <{lanes} x {t}>, ptr {tile}, i64 {i}")
            place = self.made(f"getelementptr <{lanes} x {t}>, ptr {place}, i64 {e}")
            self.append(f"store <{lanes} x {t}> {self.joined(pieces, size, t)}, ptr {place}")
        self += end

    def rows_of_tile(self, rows: Sequence[str], tile: str, t: str, count: int) -> None:
        """Emit the transposition of a tile of one vector per entry to rows, one per lane."""
        lanes = len(rows)
        size, i, end = self.blocks(lanes, count)
        many, one, found = f"<{lanes} x {t}>", f"<{size} x {t}>", []
        for e in range(size):
            place = self.made(f"getelementptr {many}, ptr {tile}, i64 {i}")
            place = self.made(f"getelementptr {many}, ptr {place}, i64 {e}")
            found.append(self.made(f"load {many}, ptr {place}"))
        for k in range(0, lanes, size):
            pieces = [self.shuffled(x, x, range(k, k + size), lanes, t) for x in found]
            for row, x in zip(rows[k : k + size], self.turned(pieces, t), strict=True):
                place = self.made(f"getelementptr {t}, ptr {row}, i64 {i}")
                self.append(f"store {one} {x}, ptr {place}, align 1")
        self += end

    def turned(self, x: Sequence[str], t: str) -> list[str]:
        """Transpose a square matrix of entries, one vector per row, by recursive exchanges."""
        x, n, far = list(x), len(x), 1
        while far < n:
            for k in (k for k in range(n) if not k & far):
                a, b = x[k], x[k + far]
                low = [n + j - far if j & far else j for j in range(n)]
                high = [n + j if j & far else j + far for j in range(n)]
                x[k], x[k + far] = (self.shuffled(a, b, where, n, t) for where in (low, high))
            far *= 2
        return x

    def joined(self, pieces: Sequence[str], size: int, t: str) -> str:
        """Emit the concatenation of vectors of `size` entries."""
        while len(pieces) > 1:
            pairs = zip(pieces[::2], pieces[1::2], strict=True)
            pieces = [self.shuffled(a, b, range(2 * size), size, t) for a, b in pairs]
            size *= 2
        return pieces[0]

    def shuffled(self, a: str, b: str, where: Iterable[int], size: int, t: str) -> str:
        """Emit the selection of entries of two vectors. where: indices into both vectors."""
        indices = [f"i32 {k}" for k in where]
        many = f"<{size} x {t}>"
        return self.made(f"shufflevector {many} {a}, {many} {b}, <{len(indices)} x i32> "
                         f"<{', '.join(indices)}>")  # fmt: skip

    def add_up(self, total: str, term: str, t: str, count: int, lanes: int) -> None:
        """Emit total[i] += term[i], summed over the lanes."""
        if not count:
            return
        add = "fadd" if t in ("float", "double") else "add"
        of = t if lanes == 1 else f"<{lanes} x {t}>"
        i, end = self.loop(count)
        to = self.made(f"getelementptr {t}, ptr {total}, i64 {i}")
        x = self.made(f"load {t}, ptr {to}")
        y = self.made(f"load {of}, ptr {self.made(f'getelementptr {of}, ptr {term}, i64 {i}')}")
        y = y if lanes == 1 else self.sum_of(y, t, lanes)
        self += [f"store {t} {self.made(f'{add} {t} {x}, {y}')}, ptr {to}", *end]

    def sum_of(self, x: str, t: str, lanes: int) -> str:
        """Emit the sum over lanes, without lanes whose samples were already summed."""
        many, kind = f"<{lanes} x {t}>", {"float": "f32", "double": "f64"}.get(t, t)
        counts = ", ".join(f"i64 {k}" for k in range(lanes))
        again = self.made("sub i64 %wanted, %b")
        run = splat(self.made, lanes, "i64", again)
        first = self.made(f"icmp uge <{lanes} x i64> <{counts}>, {run}")
        y = self.made(f"select <{lanes} x i1> {first}, {many} {x}, {many} zeroinitializer")
        if kind == t:
            name = f"llvm.vector.reduce.add.v{lanes}{t}"
            self.declared.append(f"declare {t} @{name}({many})")
            return self.made(f"call {t} @{name}({many} {y})")
        name = f"llvm.vector.reduce.fadd.v{lanes}{kind}"
        self.declared.append(f"declare {t} @{name}({t}, {many})")
        return self.made(f"call reassoc {t} @{name}({t} -0.0, {many} {y})")
