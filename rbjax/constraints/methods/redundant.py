"""Formulations that keep all coordinates and the multipliers: the redundant family, in arrays.

`Multipliers` and `Baumgarte` solve the same by the factors of ABA. (Masarati, ch. 8)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from rbjax.constraints.methods.dense import Dense, Solution, inverted
from rbjax.lanes.arrays import matvec


@dataclass(frozen=True)
class KKT(Dense):
    """Index 1, accelerations and multipliers at once:

        [M  -G^T] [a]   [f]
        [G    0 ] [l] = [c]
    as a symmetric system (of a and -l) by its eigenvalues. Where rows are redundant it is singular,
    and l is the solution of least norm.

    Source: Haug, *Computer-Aided Kinematics and Dynamics*, 11.3; Masarati, ch. 8.
    """

    name: ClassVar[str] = "kkt"
    family: ClassVar[str] = "redundant"
    index: ClassVar[int] = 1

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        n, m = len(f), len(c)
        K = jnp.block([[M, G.T], [G, jnp.zeros((m, m), M.dtype)]])
        w, V = jnp.linalg.eigh(K)
        x = matvec(V, inverted(w, 2) * matvec(V.T, jnp.concatenate([f, c])))
        return x[:n], -x[n:]
