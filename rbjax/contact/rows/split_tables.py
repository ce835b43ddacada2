"""Tables of parameters in a loop over their rows: constants of the program, or operands of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


def entry(table: Any, index: Any) -> Any:
    """Return a row of a table, without a gather if the table or the index is constant."""
    if not isinstance(table, np.ndarray):
        return table[index]
    if _uniform(table):
        return table[0]
    return table[index] if isinstance(index, int) else jnp.asarray(table)[index]


class SplitTables(NamedTuple):
    """A pytree split into JAX arrays, which may be traced, and constant leaves."""

    arrays: list[jax.Array]
    leaves: list[Any]
    where: list[int]
    tree: Any

    @classmethod
    def of(cls, tree: Any) -> SplitTables:
        leaves, treedef = jax.tree.flatten(tree)
        where = [i for i, x in enumerate(leaves) if isinstance(x, jax.Array)]
        return cls([leaves[i] for i in where], leaves, where, treedef)

    def filled(self, rows: Sequence[Any], index: Any) -> Any:
        """Return the pytree with rows for its arrays. Constant tables have the row of an index."""
        out = list(self.leaves)
        for i, x in enumerate(out):
            if index is not None and isinstance(x, np.ndarray):
                out[i] = np.asarray(entry(x, index))[None] if _uniform(x) else entry(x, index)[None]
        for i, x in zip(self.where, rows, strict=True):
            out[i] = x
        return jax.tree.unflatten(self.tree, out)


def _uniform(table: np.ndarray) -> bool:
    return bool((table == table[:1]).all())
