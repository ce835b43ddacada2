"""Setup of the tests of the compiler."""

import weakref

import pytest

from rbjax.compiler.jax import kernel_code


@pytest.fixture(autouse=True)
def own_kernel_codes(monkeypatch):
    """Each test compiles its kernels, since some have a stand-in for NVRTC."""
    monkeypatch.setattr(kernel_code, "_codes", weakref.WeakValueDictionary())
