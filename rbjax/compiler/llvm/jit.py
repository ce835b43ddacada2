"""Compiles LLVM IR to machine code of this processor, by llvmlite, whose wheel contains LLVM.

The code is cached on disk next to JAX's own compilation cache, if that is enabled.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import functools
import hashlib
import threading
from dataclasses import dataclass
from typing import Any, NamedTuple

from rbjax.compiler.disk_cache import read_or_make


@dataclass(frozen=True)
class Module:
    """LLVM IR with a function `run`, and the external functions that it calls."""

    text: str
    symbols: tuple[str, ...]


class OptimizationLevels(NamedTuple):
    """Levels of LLVM's optimization.

    passes: names of passes on the IR, or one of LLVM's own levels.
    selection: level of the instruction selection.
    features: processor features in addition to those of this processor.
    """

    passes: tuple[str, ...] | int
    selection: int
    features: str = ""


#: Stack variables become registers, and instructions are combined. Higher levels take longer and do
#: not give faster code; without passes, loops are slower.
LEVELS = OptimizationLevels(("sroa", "instruction_combine"), 1)
#: for short compile times; the code is slower
QUICK_LEVELS = OptimizationLevels((), 0)
#: for matrix products and `while` loops of one sample: from level 2 on, neighboring operations
#: become vector operations, as those of equal limbs. A step with contacts is 6 to 19 % faster and
#: takes about 1.7 times as long to compile; one without loops gains little. Gather instructions are
#: disabled, because they are slow on AMD processors
SAMPLE_LEVELS = OptimizationLevels(2, 1, "+prefer-no-gather")
#: the most operations of such a program with loops, which bounds the time to compile it
SAMPLE_STATEMENTS = 20_000


class NoCompiler(RuntimeError):
    """An error: llvmlite is missing, or does not run on this machine."""


@dataclass(frozen=True)
class Code:
    """A compiled function. The engine owns its memory.

    address: address of the function `run`.
    key: hash of the IR and the compiler.
    """

    address: int
    engine: Any
    key: str


@functools.cache
def _llvm() -> Any:
    try:
        from llvmlite import binding
    except (ImportError, OSError) as error:
        raise NoCompiler("llvmlite is missing; pip install llvmlite") from error
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding


@functools.cache
def _libm() -> ctypes.CDLL:
    return ctypes.CDLL(ctypes.util.find_library("m"))


def _address(function: str) -> int | None:
    """Return the address of a function of C's mathematical library, or of the system."""
    library = _libm() if hasattr(_libm(), function) else ctypes.CDLL(None)
    return ctypes.cast(getattr(library, function), ctypes.c_void_p).value


@functools.cache
def _processor() -> tuple[str, str, str]:
    """Return the target triple, the name and the features of this processor."""
    llvm = _llvm()
    features = llvm.get_host_cpu_features().flatten()
    return llvm.get_process_triple(), llvm.get_host_cpu_name(), features


def register_bytes() -> int:
    """Return the size of a vector register of this processor, in bytes."""
    features = _processor()[2].split(",")
    return 64 if "+avx512f" in features else 32 if "+avx" in features else 16


def _machine(levels: OptimizationLevels) -> Any:
    """Make a target machine. An engine that receives it destroys it."""
    triple, cpu, features = _processor()
    if levels.features and triple.startswith("x86_64"):
        features = f"{features},{levels.features}"
    return _llvm().Target.from_triple(triple).create_target_machine(
        cpu=cpu, features=features, opt=levels.selection, jit=True, reloc="pic",
        codemodel="jitdefault",
    )  # fmt: skip


#: the code that was used last, least recently used first, by the hash of its IR and the compiler
_codes: dict[str, Code] = {}
KEPT = 128
_lock = threading.Lock()


def compile_module(module: Module, levels: OptimizationLevels = LEVELS) -> Code:
    """Compile a module's function `run`, or return the cached code of an equal module.

    Raises:
        NoCompiler: llvmlite is missing, or LLVM does not compile for this machine.
    """
    how = (*_processor(), str((_llvm().llvm_version_info, *levels)))
    key = hashlib.sha256("\n".join((module.text, *how)).encode()).hexdigest()
    with _lock:
        code = _codes.pop(key, None) or _loaded(module, levels, key)
        _codes[key] = code
        if len(_codes) > KEPT:
            del _codes[next(iter(_codes))]
    return code


def _loaded(module: Module, levels: OptimizationLevels, key: str) -> Code:
    llvm = _llvm()
    try:
        code = read_or_make(
            f"{key}.o", lambda: compile_object(module.text, levels.passes, _machine(levels))
        )
        for function in module.symbols:
            llvm.add_symbol(function, _address(function))
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine(levels))
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        return Code(engine.get_function_address("run"), engine, key)
    except (RuntimeError, OSError, AttributeError) as error:
        raise NoCompiler(f"LLVM does not compile for this machine: {error}") from error


def compile_object(text: str, passes: tuple[str, ...] | int, machine: Any) -> bytes:
    """Compile IR to an object file for a target machine."""
    llvm = _llvm()
    parsed = llvm.parse_assembly(text)
    options = llvm.create_pipeline_tuning_options()
    if isinstance(passes, int):
        options.speed_level, options.loop_unrolling = passes, False
        options.slp_vectorization = options.loop_vectorization = passes > 1
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(parsed, builder)
    elif passes:
        manager = llvm.create_new_function_pass_manager()
        for name in passes:
            getattr(manager, f"add_{name}_pass")()
        builder = llvm.create_pass_builder(machine, options)
        for function in parsed.functions:
            if not function.is_declaration:
                manager.run(function, builder)
    return machine.emit_object(parsed)
