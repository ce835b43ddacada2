"""Records: immutable pytrees with named fields, of which a model is made."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnknownName

#: up to so many numbers are looked at on the host; more stay where they are
FEW = 10_000


class Record(eqx.Module):
    """An immutable pytree with named fields."""

    def replace(self, **changes: Any):
        """A copy with the given fields changed; shapes of arrays must stay, values be numbers."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        for name, value in changes.items():
            if name not in fields:
                raise UnknownName(f"field of {type(self).__name__}", name, fields)
            old = fields[name]
            fields[name] = self._array_like(name, value, old) if eqx.is_array(old) else value
        return type(self)(**fields)

    def may_be_endless(self, name: str) -> bool:
        """Whether infinity stands for something in a field: no limit, in a range."""
        return name.endswith("range")

    def _array_like(self, name: str, value: Any, old: Any) -> jax.Array:
        """The value as an array of the old one's shape and dtype."""
        where = f"{type(self).__name__}.replace({name}=...)"
        try:
            shape = np.shape(value)
            if isinstance(value, np.ndarray) and value.dtype.kind not in "biufV":
                raise TypeError(f"dtype {value.dtype}")
            new = jnp.asarray(value, old.dtype) if shape == np.shape(old) else None
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"{where}: got {type(value).__name__}, expected numbers of shape {np.shape(old)}"
            ) from error
        if new is None:
            raise InputError(
                f"{where}: got shape {shape}, expected {np.shape(old)}; build a new model to "
                "change its size, or jax.vmap over models to have many"
            )
        check_numbers(where, new, endless=self.may_be_endless(name))
        return new


def check_numbers(where: str, x: Any, *, endless: bool) -> None:
    """Refuse known values that are no real numbers: NaN, and infinity unless it is allowed."""
    if not hasattr(x, "dtype"):
        x = np.asarray(x)
    real = (jnp.floating, jnp.integer, jnp.bool_)
    if not any(jnp.issubdtype(x.dtype, kind) for kind in real):
        raise InputError(f"{where}: got numbers of dtype {x.dtype}, expected real ones")
    if isinstance(x, jax.core.Tracer) or not jnp.issubdtype(x.dtype, jnp.floating):
        return
    xp = np if x.size <= FEW else jnp
    wrong = xp.isnan(x) if endless else ~xp.isfinite(x)
    if wrong.any():
        at = tuple(map(int, np.argwhere(np.asarray(wrong))[0]))
        raise InputError(f"{where}: got {x[at]} at {list(at)}, expected finite numbers")
