"""A disk cache of compiled code, next to JAX's compilation cache if that is enabled.

If the folder cannot be read or written, code is compiled again and a warning names the folder.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

#: bytes of the digest at the beginning of a file; the code is compiled again if its digest differs
DIGEST = hashlib.sha256().digest_size


def read_or_make(name: str, make: Callable[[], bytes]) -> bytes:
    """Return the content of the cached file `name`, or make() and cache it."""
    folder = _folder()
    if folder is None:
        return make()
    found = _read(folder / name)
    if found is not None:
        return found
    made = make()
    try:
        _write(folder, name, made)
    except OSError as error:
        _warn(str(folder), str(error))
    return made


def _read(file: Path) -> bytes | None:
    """Return the content of a file; None if it is missing, unreadable or damaged."""
    try:
        found = file.read_bytes()
    except OSError:
        return None
    digest, content = found[:DIGEST], found[DIGEST:]
    return content if digest == hashlib.sha256(content).digest() else None


def _write(folder: Path, name: str, content: bytes) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile("wb", dir=folder, delete=False) as file:
        try:
            file.write(hashlib.sha256(content).digest() + content)
            file.close()
            os.replace(file.name, folder / name)  # atomic
        except OSError:
            with contextlib.suppress(OSError):
                os.unlink(file.name)
            raise


@functools.cache
def _warn(folder: str, reason: str) -> None:
    warnings.warn(
        f"rbjax.compiler: compiled code is not kept on disk ({reason}), so each process compiles "
        f"it again; make {folder} writable, or set JAX_COMPILATION_CACHE_DIR to another folder",
        stacklevel=2,
    )


def _folder() -> Path | None:
    config: Any = jax.config  # jax.config's type lacks some names
    folder = config.jax_compilation_cache_dir
    if not folder or "://" in folder or not config.jax_enable_compilation_cache:
        return None
    return Path(folder) / "rbjax-threads"
