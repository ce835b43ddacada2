"""Compiled code on disk, next to JAX's own compilation cache if the caller has enabled that."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax


def cached(name: str, make: Callable[[], bytes]) -> bytes:
    """The bytes of the file of this name, made at the first time."""
    folder = _folder()
    if folder is None:
        return make()
    if (folder / name).exists():
        return (folder / name).read_bytes()
    made = make()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile("wb", dir=folder, delete=False) as file:
        file.write(made)
    os.replace(file.name, folder / name)  # atomic
    return made


def _folder() -> Path | None:
    config: Any = jax.config  # its type does not list all names
    folder = config.jax_compilation_cache_dir
    if not folder or "://" in folder or not config.jax_enable_compilation_cache:
        return None
    return Path(folder) / "rbjax-threads"
