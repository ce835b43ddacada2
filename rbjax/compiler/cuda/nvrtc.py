"""Compiles CUDA C to PTX by NVRTC, which comes with JAX for CUDA.

PTX is cached on disk next to JAX's own compilation cache, if that is enabled.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import glob
import hashlib
import importlib.util
import re
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from rbjax.compiler.disk_cache import read_or_make

OPTIONS = ("--std=c++17", "--restrict", "-default-device")
#: options for programs that run only for seconds, to compile them faster, and NVRTC's first version
QUICK, QUICK_SINCE = ("--Ofast-compile=max",), (13, 0)
_fast: ContextVar[bool] = ContextVar("quick", default=False)


class CompileError(RuntimeError):
    """An error: NVRTC is missing, or does not compile a program."""


@contextlib.contextmanager
def fast_compile(wanted: bool = True) -> Iterator[None]:
    """Compile kernels quickly instead of for speed, inside a `with` block."""
    before = _fast.set(wanted)
    try:
        yield
    finally:
        _fast.reset(before)


def compiles_fast() -> bool:
    """Return whether a short compile time is preferred to fast kernels."""
    return _fast.get()


def options() -> tuple[str, ...]:
    """Return NVRTC's options; they differ inside `fast_compile`."""
    new = tuple(map(int, version().split("."))) >= QUICK_SINCE
    return (*OPTIONS, *QUICK) if compiles_fast() and new else OPTIONS


@functools.cache
def library() -> ctypes.CDLL:
    """Load the NVRTC library of the installed CUDA packages, or of the system."""
    places = []
    with contextlib.suppress(ImportError, ValueError):
        spec = importlib.util.find_spec("nvidia")
        for root in spec.submodule_search_locations or () if spec else ():
            places += newest_first(glob.glob(f"{root}/**/libnvrtc.so*", recursive=True))
    places += [f"libnvrtc.so.{n}" for n in (13, 12)] + ["libnvrtc.so"]
    places += newest_first(glob.glob("/usr/local/cuda*/lib64/libnvrtc.so*"))
    for place in places:
        with contextlib.suppress(OSError):
            return ctypes.CDLL(place)
    raise CompileError('found no libnvrtc; install it with pip install "rbjax[cuda]"')


def newest_first(files: list[str]) -> list[str]:
    """Sort library files by the version in their names ("libnvrtc.so.13"), the newest first."""
    return sorted(files, key=lambda file: [int(n) for n in re.findall(r"\d+", Path(file).name)],
                  reverse=True)  # fmt: skip


def ptx(source: str, capability: str) -> str:
    """Compile CUDA C source to PTX for a compute capability ("9.0")."""
    arch = f"compute_{capability.replace('.', '')}"
    key = hashlib.sha256("\n".join((source, arch, *options(), version())).encode()).hexdigest()
    return read_or_make(f"{key}.ptx", lambda: _compile(source, arch).encode()).decode()


@functools.cache
def version() -> str:
    """Return NVRTC's version, such as "13.0"."""
    major, minor = ctypes.c_int(), ctypes.c_int()
    library().nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    return f"{major.value}.{minor.value}"


def _compile(source: str, arch: str) -> str:
    nvrtc, program = library(), ctypes.c_void_p()
    _check(nvrtc.nvrtcCreateProgram(
        ctypes.byref(program), source.encode(), b"threads.cu", 0, None, None))  # fmt: skip
    try:
        words = [f"--gpu-architecture={arch}".encode(), *(o.encode() for o in options())]
        failed = nvrtc.nvrtcCompileProgram(
            program, len(words), (ctypes.c_char_p * len(words))(*words)
        )
        if failed:
            log = _text(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, program)
            raise CompileError(f"NVRTC does not compile a kernel: {log[:2000]}")
        return _text(nvrtc.nvrtcGetPTXSize, nvrtc.nvrtcGetPTX, program)
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def _text(size_of, read, program: ctypes.c_void_p) -> str:
    size = ctypes.c_size_t()
    _check(size_of(program, ctypes.byref(size)))
    buffer = ctypes.create_string_buffer(size.value)
    _check(read(program, buffer))
    return buffer.value.decode()


def _check(status: int) -> None:
    if status:
        raise CompileError(f"NVRTC fails with status {status}")
