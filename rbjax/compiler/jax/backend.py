"""Which devices run functions of one sample as their own programs: GPUs, and the CPU by LLVM."""

from __future__ import annotations

import functools
import os

import jax

from rbjax.compiler.jax import host_call
from rbjax.errors import InputError

#: which of the choices runs functions of one sample on the CPU; `usual` if it is not set
VARIABLE = "RBJAX_CPU"
CHOICES = ("llvm", "xla")
usual = "llvm"


@functools.cache
def gpu() -> bool:
    """Whether this process has a GPU that can run kernels."""
    try:
        return bool(jax.local_devices(backend="cuda"))
    except RuntimeError:
        return False


@functools.cache
def on_cpu() -> bool:
    """Whether functions on the CPU run as machine code of LLVM, not under XLA."""
    choice = os.environ.get(VARIABLE, usual)
    if choice not in CHOICES:
        raise InputError(f"{VARIABLE}: got {choice!r}, expected one of {', '.join(CHOICES)}")
    return choice == "llvm" and host_call.works()


def wanted() -> bool:
    """Whether some device runs functions of one sample as programs of their own."""
    return gpu() or on_cpu()
