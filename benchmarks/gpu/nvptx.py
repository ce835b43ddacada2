"""Forward dynamics as a GPU kernel by two compilers: CUDA C by NVRTC, LLVM IR by LLVM's NVPTX.

`python -m benchmarks.gpu.nvptx [--robots panda humanoid ...]` prints registers, stack, spills and
code size of both kernels, as `ptxas -v` gives them for sm_90, f32. It needs NVRTC, llvmlite, and
`ptxas` and libdevice of the CUDA toolkit, but no GPU. With a GPU it also runs both kernels and
compares their results, and writes results/gpu-nvptx-<gpu>.json.

The program is the same in both: the batch is the last axis, so that neighbouring threads read
neighbouring entries in place. The kernel of LLVM calls the function of one sample of rbjax's LLVM
back end, not split into several functions, with all arrays on the stack and fused multiply-adds.
"""

from __future__ import annotations

import argparse
import ctypes
import glob
import importlib.util
import re
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from llvmlite import binding as llvm

import rbjax as rb
from benchmarks.shared import robots
from benchmarks.shared.timing import markdown_table, save
from rbjax.compiler.cuda import driver, nvrtc
from rbjax.compiler.cuda.kernels import kernel
from rbjax.compiler.ir.program import Written, batch_last
from rbjax.compiler.llvm import statements
from rbjax.compiler.llvm.operations import ATTRIBUTES
from rbjax.compiler.llvm.samples import Lines
from rbjax.compiler.lower.write import write_program

TARGET, ARCH, CAPABILITY = "nvptx64-nvidia-cuda", "sm_90", "9.0"
BLOCK, BATCH, RUNS = 32, 65536, 20
COLUMNS = ("robot", "compiler", "compile s", "registers", "stack", "spill stores", "spill loads",
           "code", "us", "error")  # fmt: skip


class _OneFunction(statements.Writer):
    """An emitter that does not split a program, which costs a GPU thread loads and stores."""

    def cuts(self, program: Written) -> None:
        return None


def program_of(model: rb.Model) -> Written:
    """The program of forward dynamics, with the batch as the last axis of all arrays."""

    def f(q: jax.Array, v: jax.Array, tau: jax.Array) -> list[jax.Array]:
        return [rb.forward_dynamics(model, q, v, tau)]

    one = [jax.ShapeDtypeStruct((n,), jnp.float32) for n in (model.nq, model.nv, model.nv)]
    layouts = [batch_last(x.shape, (BATCH,)) for x in one]
    closed = jax.make_jaxpr(f)(*one)
    return write_program(closed, (BATCH,), layouts, [layouts[1]], platform="cuda")


def newest(pattern: str) -> str:
    """The newest file of the CUDA packages of this environment, or of the system's toolkits."""
    spec = importlib.util.find_spec("nvidia")
    places = [*(spec.submodule_search_locations or () if spec else ()), "/usr/local/cuda*"]
    found = [x for place in places for x in glob.glob(f"{place}/**/{pattern}", recursive=True)]
    if not found:
        raise SystemExit(f"{pattern} not found: install the CUDA toolkit, or nvidia-cuda-nvcc")
    return nvrtc.newest_first(found)[0]


def ptx_of_llvm(program: Written) -> str:
    """The PTX of LLVM's NVPTX, with the mathematical functions of libdevice."""
    statements.STACK_ARRAY_BYTES = statements.STACK_BYTES = 1 << 30
    sample = statements.write_function(_OneFunction(), program, "sample")
    lines, pointers = Lines(), []
    arrays, layouts = (
        (*program.operands, *program.results),
        (*program.layouts[0], *program.layouts[1]),
    )
    for k, (array, layout) in enumerate(zip(arrays, layouts, strict=True)):
        t = statements.memory_type(array.dtype)
        pointers.append(lines.sample(f"%p{k}", t, layout, program.batch, "%b"))
    takes = ", ".join(f"ptr noalias %p{k}" for k in range(len(arrays)))
    text = "\n".join([
        f'target triple = "{TARGET}"', *sample.outside, sample.text,
        *(f"declare i32 @llvm.nvvm.read.ptx.sreg.{x}.x()" for x in ("ctaid", "tid")),
        f"define ptx_kernel void @threads({takes}) #0 {{",
        'call void asm sideeffect ".pragma \\22enable_smem_spilling\\22;", ""()',
        "%c = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()",
        "%t = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()",
        f"%s = mul i32 %c, {BLOCK}", "%i = add i32 %s, %t", "%b = sext i32 %i to i64",
        *lines, sample.call(pointers, "null"), "ret void", "}",
        f'attributes #0 = {{ "nvvm.maxntid"="{BLOCK}" }}',
    ])  # fmt: skip
    text = text.replace(ATTRIBUTES, "nounwind alwaysinline")
    for name in sample.libm:
        plain = name[:-1] if name.endswith("f") else name
        text = re.sub(rf"@{name}\b", f"@__nv_{plain}{'f' if name != plain else ''}", text)
    module = llvm.parse_assembly(text)
    module.link_in(llvm.parse_bitcode(Path(newest("libdevice.10.bc")).read_bytes()))
    for function in module.functions:
        if not function.is_declaration and function.name != "threads":
            function.linkage = "internal"
    machine = llvm.Target.from_triple(TARGET).create_target_machine(
        cpu=ARCH, features="+ptx87", opt=3
    )
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_unrolling = options.slp_vectorization = options.loop_vectorization = False
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)
    return machine.emit_assembly(module)


def assembled(ptx: str) -> dict[str, Any]:
    """What `ptxas -v` prints of a kernel."""
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder, "k.ptx"), Path(folder, "k.cubin")
        source.write_text(ptx)
        program = shutil.which("ptxas") or newest("bin/ptxas")
        done = subprocess.run(
            [program, "-v", f"-arch={ARCH}", str(source), "-o", str(out)],
            capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode:
            raise SystemExit(done.stderr[:2000])
        code = code_bytes(out.read_bytes())
    numbers = {
        "registers": r"Used (\d+) registers", "stack": r"(\d+) bytes stack frame",
        "spill stores": r"(\d+) bytes spill stores", "spill loads": r"(\d+) bytes spill loads",
    }  # fmt: skip
    found = {k: re.findall(x, done.stderr) for k, x in numbers.items()}
    return {k: int(x[-1]) if x else 0 for k, x in found.items()} | {"code": code}


def code_bytes(cubin: bytes) -> int:
    """The bytes of the executable sections of an ELF file."""
    start = int.from_bytes(cubin[0x28:0x30], "little")
    size, count = (int.from_bytes(cubin[k : k + 2], "little") for k in (0x3A, 0x3C))
    headers = [cubin[start + k * size : start + (k + 1) * size] for k in range(count)]
    runs = [h for h in headers if h[4:8] == b"\1\0\0\0" and h[8] & 4]
    return sum(int.from_bytes(h[0x20:0x28], "little") for h in runs)


def run(ptx: str, grid: int, block: int, model: rb.Model, robot: str) -> tuple[float, float]:
    """The shortest time of a launch in us, and the largest relative error against `jax.jit`."""
    cuda = driver._driver()
    q, v, tau, _ = robots.batch(robots.compiled(robot), BATCH, last=True)
    f = jax.vmap(lambda *x: rb.forward_dynamics(model, *x), in_axes=-1, out_axes=-1)
    want = np.asarray(jax.jit(f)(q, v, tau))
    arrays = jax.block_until_ready([q, v, tau, 0 * v])
    addresses = [ctypes.c_void_p(x.unsafe_buffer_pointer()) for x in arrays]
    given = (ctypes.c_void_p * 4)(*(ctypes.addressof(x) for x in addresses))
    function, times = ctypes.c_void_p(), []
    with driver._context(cuda, 0), driver._module(cuda, ptx) as module:
        assert cuda.cuModuleGetFunction(ctypes.byref(function), module, b"threads") == 0
        for _ in range(RUNS):
            cuda.cuCtxSynchronize()
            start = time.perf_counter()
            for _ in range(10):  # hides the overhead of a launch
                launched = cuda.cuLaunchKernel(
                    function, grid, 1, 1, block, 1, 1, 0, None, given, None
                )
            assert launched == 0 and cuda.cuCtxSynchronize() == 0
            times.append((time.perf_counter() - start) / 10)
    error = np.abs(np.asarray(arrays[3]) - want).max(0) / np.abs(want).max(0)
    return 1e6 * min(times), float(error.max())


def rows_of(robot: str, on_gpu: bool) -> list[dict[str, Any]]:
    with jax.enable_x64(False):
        model = robots.ours(robot)
        program = program_of(model)
        ours = kernel(program)
        kernels = {
            "NVRTC": (lambda: nvrtc.ptx(ours.source, CAPABILITY), ours.grid, ours.block),
            "LLVM": (lambda: ptx_of_llvm(program), BATCH // BLOCK, BLOCK),
        }
        rows = []
        for name, (make, *shape) in kernels.items():
            start = time.perf_counter()
            ptx = make()
            row = {"robot": robot, "compiler": name, "compile s": time.perf_counter() - start}
            row |= assembled(ptx)
            if on_gpu:
                row["us"], row["error"] = run(ptx, *shape, model, robot)
            rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=robots.ALL)
    names = parser.parse_args().robots
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    llvm.set_option("rbjax", "--nvptx-fma-level=2")  # as NVRTC does by default
    on_gpu = jax.default_backend() == "gpu"
    rows = [row for robot in names for row in rows_of(robot, on_gpu)]
    print(markdown_table(rows, COLUMNS))
    if on_gpu:
        save("gpu-nvptx", rows)


if __name__ == "__main__":
    main()
