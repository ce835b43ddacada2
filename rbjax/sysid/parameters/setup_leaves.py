"""Leaves of a set-up by their dotted names: to read them, and to replace them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import UnknownName
from rbjax.model import Model


def put(array: Any, index: Any, new: Any) -> jax.Array:
    """The array with another entry. By numpy, in a hundredth of the time, if neither is traced."""
    if any(isinstance(x, jax.core.Tracer) for x in (array, new)):
        return jnp.asarray(array).at[index].set(new)
    out = np.array(array)
    out[index] = new
    return jnp.asarray(out)


def leaf_of(target: Any, leaf: str) -> Any:
    """An array of floating-point numbers of a pytree, by its dotted name."""
    value = target
    try:
        for part in _parts(target, leaf):
            value = _child(value, part)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        value = None
    numeric = eqx.is_array(value) or isinstance(value, float)
    if not numeric or not jnp.issubdtype(jnp.result_type(value), jnp.floating):
        paths = jax.tree_util.tree_flatten_with_path(target)[0]
        keys = [jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in paths]
        known = [key.removeprefix("model.") for key in keys]
        raise UnknownName(f"leaf of {type(target).__name__}", leaf, known)
    return value


def with_leaf(target: Any, leaf: str, new: Any) -> Any:
    """The pytree with another array at a dotted name. A `Model` computes its derived values
    again."""
    return _with(target, _parts(target, leaf), new)


def _parts(target: Any, leaf: str) -> list[str]:
    parts = leaf.split(".")
    inner = getattr(target, "model", None)
    if isinstance(inner, Model) and not hasattr(target, parts[0]):
        return ["model", *parts]
    return parts


def _child(value: Any, part: str) -> Any:
    if isinstance(value, Mapping):
        return value[part]
    return value[int(part)] if isinstance(value, (tuple, list)) else getattr(value, part)


def _with(value: Any, parts: list[str], new: Any) -> Any:
    if not parts:
        return new
    part, rest = parts[0], parts[1:]
    child = _with(_child(value, part), rest, new)
    if isinstance(value, Model):
        return value.replace(**{part: child})
    return eqx.tree_at(lambda x: _child(x, part), value, child, is_leaf=lambda x: x is None)
