"""Prints a program as a CUDA kernel in which a team of threads, one block, runs each sample.

Arrays are in the block's shared memory. The iterations of a team loop are independent, and thread i
of n runs iterations i, i + n, ... . All threads run the statements outside such loops with the same
values, so they take the same branches. Barriers separate writes from the reads of other threads
(`phases`). This suits matrices of ten to thirty rows, which do not fit into one thread's registers.

Source: Valiant 1990, *A bridging model for parallel computation* (phases between barriers); Haidar
    et al. 2015, *Batched matrix computations on hardware accelerators* (a block per small matrix).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from rbjax.compiler.cuda.c_source import PREAMBLE, Printer, offset, parameters, sample_index, table
from rbjax.compiler.cuda.driver import shared_bytes_of
from rbjax.compiler.cuda.kernels import BASICS, DRIVERS_BYTES, STATEMENTS_UP_TO, WARP, Kernel
from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.c_text import c_type
from rbjax.compiler.ir.program import Written

#: threads of a team for batches of at most this many samples; a warp for larger batches
TEAMS = {600: 128, 1200: 64}
#: bytes of shared memory of a block, and of a multiprocessor
SHARED_BYTES, SHARED_BYTES_IN_ALL = 47 * 1024, shared_bytes_of("9.0")
#: blocks that should reside on a multiprocessor: of one warp, and of larger teams
RESIDENT, RESIDENT_LARGE = 16, 4
#: the most operations of a thread's iterations that are unrolled
WRITTEN_OUT = 600

HEAD = """
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
// copies that go on while the thread does other things
template <class T> QUALIFIED void copy_async(T* to, const T* from) {
  asm volatile("cp.async.ca.shared.global [%0], [%1], %2;"
    :: "r"((unsigned)__cvta_generic_to_shared(to)), "l"(from), "n"((int)sizeof(T)) : "memory");
}
QUALIFIED void wait_for_copies() { asm volatile("cp.async.wait_all;" ::: "memory"); }
#else
template <class T> QUALIFIED void copy_async(T* to, const T* from) { *to = *from; }
QUALIFIED void wait_for_copies() {}
#endif
"""


def team_size(samples: int) -> int:
    """Return the number of threads of a team for a batch of this many samples."""
    return next((n for most, n in TEAMS.items() if samples <= most), WARP)


def kernel(program: Written, name: str = "threads", team: int | None = None) -> Kernel:
    """Return the kernel of a program that was lowered for a team. The program must fit (`fits`)."""
    samples = math.prod(program.batch)
    team = team or team_size(samples)
    source = "\n".join(_lines(program, name, team))
    return Kernel(source, name, team, samples, samples, program.summed)


def fits(program: Written) -> bool:
    """Return whether the arrays fit into shared memory, and the statements into a kernel."""
    bytes = shared_bytes(program.builder.block)
    return bytes <= SHARED_BYTES and program.statements <= STATEMENTS_UP_TO


def _resident(bytes: int, team: int) -> int:
    """Return the number of blocks that should reside on a multiprocessor at once, limited by its
    shared memory."""
    wanted = RESIDENT if team == WARP else RESIDENT_LARGE
    return min(wanted, SHARED_BYTES_IN_ALL // (bytes + DRIVERS_BYTES))


def shared_bytes(block: ir.Block) -> int:
    """Return the size of the arrays that a team shares, in bytes."""
    arrays = [s.array for s in ir.walk(block) if isinstance(s, ir.Reserve) and s.array.shared]
    return sum(-(-max(a.size, 1) * a.dtype.itemsize // 16) * 16 for a in arrays)


def _lines(program: Written, name: str, team: int) -> Iterator[str]:
    ins, outs = program.layouts
    index = sample_index(program.batch)
    yield BASICS + HEAD + PREAMBLE
    for array in program.builder.tables:
        yield table(array, "static __device__ const")
    least = _resident(shared_bytes(program.builder.block), team)
    yield f'extern "C" __global__ void __launch_bounds__({team},{least}) {name}('
    yield parameters(program, "__restrict__") + "){"
    yield "const long long b=blockIdx.x;"
    yield "const int lane=threadIdx.x;"
    names: dict[int, str] = {}
    for k, (array, layout) in enumerate(zip(program.operands, ins, strict=True)):
        names[array.id] = f"x{k}"
        yield f"const {c_type(array.dtype)}* __restrict__ x{k}=p{k}+({offset(layout, index)});"
    for k, (array, layout) in enumerate(zip(program.results, outs, strict=True)):
        names[array.id] = f"y{k}"
        # each block stores its own part of a sum over the batch
        start = f"b*{array.size}" if program.summed[k] else offset(layout, index)
        yield f"{c_type(array.dtype)}* __restrict__ y{k}=r{k}+({start});"
    yield from TeamPrinter(names, team).lines(program.builder.block)
    yield "}"


class TeamPrinter(Printer):
    """A printer of statements for one thread of a team."""

    def __init__(self, names: dict[int, str], team: int):
        super().__init__(names)
        self.team = team
        self._early = False

    @property
    def barrier(self) -> str:
        return "__syncwarp();" if self.team == WARP else "__syncthreads();"

    def _lines(self, statement: ir.Statement) -> Iterator[str]:
        match statement:
            case ir.Barrier():
                yield self.barrier
            case ir.Await():
                yield f"wait_for_copies();{self.barrier}"
            case ir.Reserve(array=array) if array.shared:
                yield f"__shared__ {c_type(array.dtype)} a{array.id}[{max(array.size, 1)}];"
            case ir.Loop(team=True):
                yield from self._turns(statement)
            case ir.Load(dest=dest, array=array, base=base, offset=offset) if self._early:
                yield f"const auto* {self.value(dest)}=&{self.place(array, base, offset)};"
            case ir.Store(array=array, base=base, offset=offset, value=value) if self._early:
                yield f"copy_async(&{self.place(array, base, offset)},{self.value(value)});"
            case _:
                yield from super()._lines(statement)

    def _turns(self, loop: ir.Loop) -> Iterator[str]:
        """Print a loop over iterations that the threads of a team share: each thread runs every
        n-th one."""
        i, count, team = self.value(loop.counter), loop.count, self.team
        self._early = loop.prefetch
        body = list(self.lines(loop.body))
        self._early = False
        rounds = -(-count // team)
        if rounds == 1:
            yield "{" if count == team else f"if(lane<{count}){{"
            yield f"const int {i}=lane;"
        else:
            ops = sum(isinstance(s, (ir.Op, ir.Load, ir.Store)) for s in ir.walk(loop.body))
            yield "#pragma unroll" if rounds * ops <= WRITTEN_OUT else "#pragma unroll 1"
            yield f"for(int r{i}=0;r{i}<{rounds};r{i}++){{"
            yield f"const int {i}=r{i}*{team}+lane;"
            if count % team:
                yield f"if(r{i}<{rounds - 1}||{i}<{count}){{"
            else:
                yield "{"
        yield from body
        yield "}" if rounds == 1 else "}}"
