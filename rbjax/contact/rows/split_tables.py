"""Tables of parameters that a loop reads row by row: constants, or operands if they are traced."""

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
    if (table == table[:1]).all():
        return table[0]
    return table[index] if isinstance(index, int) else jnp.asarray(table)[index]


class SplitTables(NamedTuple):
    """A pytree split into JAX arrays, which may be traced, and constant leaves.

    Fields:
        arrays: the JAX arrays.
        leaves: all leaves.
        where: the positions of the arrays among the leaves.
        treedef: the structure of the pytree.
    """

    arrays: list[jax.Array]
    leaves: list[Any]
    where: list[int]
    treedef: Any

    @classmethod
    def of(cls, tree: Any) -> SplitTables:
        leaves, treedef = jax.tree.flatten(tree)
        where = [i for i, x in enumerate(leaves) if isinstance(x, jax.Array)]
        return cls([leaves[i] for i in where], leaves, where, treedef)

    def filled(self, rows: Sequence[Any], index: Any) -> Any:
        """Return the pytree with the given rows in place of its arrays. If `index` is not None,
        constant tables are replaced by this row."""
        out = list(self.leaves)
        for i, x in enumerate(out):
            if index is not None and isinstance(x, np.ndarray):
                out[i] = entry(x, index)[None]
        for i, x in zip(self.where, rows, strict=True):
            out[i] = x
        return jax.tree.unflatten(self.treedef, out)
