"""Setup of the tests of the compiler."""

import weakref

import pytest

from rbjax.compiler.jax import kernel_code, launch, primitive


@pytest.fixture(autouse=True)
def own_kernel_codes(monkeypatch):
    """Each test compiles its kernels, since some have a stand-in for NVRTC."""
    monkeypatch.setattr(kernel_code, "_codes", weakref.WeakValueDictionary())


@pytest.fixture
def gpu(monkeypatch):
    """A process that assumes that kernels work."""
    monkeypatch.setattr(launch, "capability", lambda: "9.0")
    monkeypatch.setattr(launch, "ordinal", lambda: 0)
    monkeypatch.setattr(launch, "kernels_work", lambda: True)
    primitive._warn.cache_clear()
