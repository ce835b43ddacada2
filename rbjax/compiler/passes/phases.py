"""Inserts barriers between the statements of a team of threads.

A barrier is needed before a statement that reads entries that other threads have written since the
previous barrier, or writes entries that they may still read. A phase is the code between two
barriers. Before a barrier is inserted, later team loops that need no barrier are moved into the
phase, after the statements on which they depend (list scheduling, Graham 1969).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rbjax.compiler.ir import statements as ir


def insert_barriers(block: ir.Block) -> ir.Block:
    """Return a block with barriers, and with its statements in an order that needs few of them."""
    return _Phases(Pending()).ordered(block)


@dataclass
class Pending:
    """The accesses of arrays since the last barrier.

    read: arrays that were read.
    uniform: for each array, the entries (base, offset) that all threads wrote with equal values.
    spread: for each array, the groups of the team loops that wrote it.
    """

    read: set[ir.Array] = field(default_factory=set)
    uniform: dict[ir.Array, set] = field(default_factory=dict)
    spread: dict[ir.Array, set[int]] = field(default_factory=dict)

    def copy(self) -> Pending:
        return Pending().joined(self)

    def joined(self, other: Pending) -> Pending:
        self.read |= other.read
        for mine, more in ((self.uniform, other.uniform), (self.spread, other.spread)):
            for array, places in more.items():
                mine.setdefault(array, set()).update(places)
        return self

    def clear(self) -> None:
        self.read.clear()
        self.uniform.clear()
        self.spread.clear()

    def needs_no_barrier(self, s: ir.Statement) -> bool:
        """Return whether a statement without inner blocks, or a team loop, needs no barrier before
        it."""
        match s:
            case ir.Load(array=array):
                return array not in self.spread
            case ir.Store(array=array, base=base, offset=offset) if _is_seen(array):
                here = self.uniform.get(array, ())
                apart = all(b is base and at != offset for b, at in here)
                free = array not in self.read and array not in self.spread
                return array.write_once or (apart and free)
            case ir.Loop(team=True, body=body, group=group):
                loads, stores = _touched(body)
                return all(x not in self.spread for x in loads) and all(
                    x.write_once or self._may_spread(x, group) for x in stores
                )
        return True

    def _may_spread(self, array: ir.Array, group: int) -> bool:
        others = self.spread.get(array, set()) - ({group} if group else set())
        return array not in self.read and array not in self.uniform and not others

    def record(self, s: ir.Statement) -> None:
        """Record the array accesses of a statement."""
        match s:
            case ir.Load(array=array) if _is_seen(array):
                self.read.add(array)
            case ir.Store(array=array, base=base, offset=offset) if _is_seen(array):
                self.uniform.setdefault(array, set()).add((base, offset))
            case ir.Loop(team=True, body=body, group=group, prefetch=prefetch):
                loads, stores = _touched(body)
                self.read |= loads
                for array in () if prefetch else stores:
                    self.spread.setdefault(array, set()).add(group)


def _is_seen(array: ir.Array) -> bool:
    """Return whether several threads may access an array that changes during the program."""
    return array.shared or array.space == "result"


def _touched(*blocks: ir.Block) -> tuple[set[ir.Array], set[ir.Array]]:
    """Return the arrays that blocks read, and the arrays that they write."""
    every = [s for block in blocks for s in ir.walk(block)]
    loads = {s.array for s in every if isinstance(s, ir.Load) and _is_seen(s.array)}
    return loads, {s.array for s in every if isinstance(s, ir.Store) and _is_seen(s.array)}


class _Phases:
    """The pass of `insert_barriers`: it orders the statements of blocks and inserts barriers."""

    def __init__(self, now: Pending):
        self.now = now
        self.out: list[ir.Statement] = []

    def ordered(self, block: ir.Block) -> ir.Block:
        statements = [s for s in block.statements if not isinstance(s, ir.Reserve)]
        before = _dependencies(statements)
        left = dict.fromkeys(range(len(statements)))
        while left:
            first = next(iter(left))
            s = statements[first]
            if _has_phases(s) or not self.now.needs_no_barrier(s):
                for k in list(left):
                    s = statements[k]
                    if k in left and _is_shared(s):
                        self._hoist(statements, before, left, k)
            if first in left:
                self._write(statements[first])
                del left[first]
        own = {s.array for s in block.statements if isinstance(s, ir.Reserve)}
        return ir.Block(_declared(self.out, own))

    def _hoist(
        self, statements: list[ir.Statement], before: list[set[int]], left: dict[int, None], k: int
    ) -> None:
        """Move team loop k and its dependencies into the current phase, if none of them needs a
        barrier.
        before: dependencies of each statement. left: the statements that are not emitted yet."""
        wanted, reached = {k}, [k]
        while reached:
            more = {j for j in before[reached.pop()] if j in left} - wanted
            wanted |= more
            reached += more
        trial = self.now.copy()
        for j in sorted(wanted):
            s = statements[j]
            if _has_phases(s) or not trial.needs_no_barrier(s):
                return
            trial.record(s)
        for j in sorted(wanted):
            self._write(statements[j])
            del left[j]

    def _write(self, s: ir.Statement) -> None:
        now = self.now
        match s:
            case ir.Loop(team=False, body=body):
                s = ir.Loop(s.counter, s.count, s.reverse, self._turn(body))
            case ir.While(test=test, body=body):
                test = self._turn(test, body)
                after = now.copy()
                s = ir.While(test, s.condition, _Phases(now).ordered(body))
                now.clear()
                now.joined(after)
            case ir.If(then=then, otherwise=otherwise):
                other = now.copy()
                then = _Phases(now).ordered(then)
                s = ir.If(s.condition, then, _Phases(other).ordered(otherwise))
                now.joined(other)
            case ir.Await():
                now.clear()
            case _:
                if not now.needs_no_barrier(s):
                    self.out.append(ir.Barrier())
                    now.clear()
                now.record(s)
        self.out.append(s)

    def _turn(self, block: ir.Block, *others: ir.Block) -> ir.Block:
        """Order the body of a loop. It starts with a barrier if the loop accesses shared arrays."""
        if not any(_touched(block, *others)):
            return _Phases(self.now).ordered(block)
        self.now.clear()
        found = _Phases(self.now).ordered(block)
        waits = found.statements and isinstance(found.statements[0], ir.Await)
        return found if waits else ir.Block([ir.Barrier(), *found.statements])


def _is_shared(s: ir.Statement) -> bool:
    """Return whether a statement is a team loop."""
    return isinstance(s, ir.Loop) and s.team


def _has_phases(s: ir.Statement) -> bool:
    """Return whether a statement may contain barriers."""
    return isinstance(s, ir.Loop | ir.While | ir.If | ir.Await) and not _is_shared(s)


def _declared(statements: list[ir.Statement], own: set[ir.Array]) -> list[ir.Statement]:
    """Insert the declaration of each of a block's own arrays before its first use."""
    out: list[ir.Statement] = []
    left = set(own)
    for s in statements:
        if left:
            for array in [x for x in _uses(s)[0] | _uses(s)[1] if x in left]:
                out.append(ir.Reserve(array))
                left.remove(array)
        out.append(s)
    return out


def _uses(s: ir.Statement) -> tuple[set[ir.Name], set[ir.Name]]:
    """Return the variables and arrays that a statement and its inner blocks read, and write."""
    reads: set[ir.Name] = set()
    writes: set[ir.Name] = set()
    for x in ir.walk(ir.Block([s])):
        reads.update(x.reads())
        writes.update(x.writes())
    return reads, writes


def _dependencies(statements: list[ir.Statement]) -> list[set[int]]:
    """Return, for each statement, the numbers of the earlier statements on which it depends."""
    out: list[set[int]] = []
    writers: dict[ir.Name, list[int]] = {}
    readers: dict[ir.Name, list[int]] = {}
    fence: int | None = None
    for k, s in enumerate(statements):
        before = set() if fence is None else {fence}
        reads, writes = _uses(s)
        for x in reads:
            before.update(writers.get(x, ()))
            readers.setdefault(x, []).append(k)
        for x in writes:
            if isinstance(x, ir.Array) and x.write_once:  # each entry is written once
                writers.setdefault(x, []).append(k)
                continue
            before.update(writers.get(x, ()), readers.get(x, ()))
            writers[x], readers[x] = [k], []
        if isinstance(s, ir.Await):
            before, fence = set(range(k)), k
        out.append(before - {k})
    return out
