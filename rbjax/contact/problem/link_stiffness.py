"""The stiffness of the contacts of each link, which adds to its inertia in the Hessian."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes import unpack
from rbjax.spatial import ArticulatedInertia

#: lanes of a symmetric 6 by 6 matrix
LANES = 21


class LinkStiffness(NamedTuple):
    """Sums of symmetric 6 by 6 matrices, one for each pair of links that can touch.

    Few pairs have a contact. The sums of the others are never written or read.

    Fields:
        counts: (n,) the terms of each sum.
        sums: (n, 21) J (6), H (9) and M (6) of `ArticulatedInertia`.
    """

    counts: jax.Array
    sums: jax.Array

    @classmethod
    def zero(cls, n: int, dtype: Any) -> LinkStiffness:
        """Return the sums of n pairs without terms."""
        return cls(jnp.zeros(n, jnp.int32), jax.lax.empty((n, LANES), dtype))

    def add(self, k: Any, K: ArticulatedInertia) -> LinkStiffness:
        """Add a term to sum k."""
        lanes = jnp.stack([*K.J, *K.H, *K.M])
        more = jnp.where(self.counts[k] > 0, self.sums[k] + lanes, lanes)
        return LinkStiffness(self.counts.at[k].add(1), self.sums.at[k].set(more))

    def at(self, k: Any) -> ArticulatedInertia:
        """Return sum k, or zero if k is negative."""
        zeros = tuple(jnp.zeros((), self.sums.dtype) for _ in range(LANES))

        def lanes() -> tuple[jax.Array, ...]:
            return tuple(unpack(self.sums[k]))

        some = self.counts[k] > 0 if isinstance(k, int) else (k >= 0) & (self.counts[k] > 0)
        return ArticulatedInertia.from_lanes(jax.lax.cond(some, lanes, lambda: zeros))
