"""Linear finite elements of a structure: mass and stiffness matrices, and points of its mass.

The displacements of n nodes, 3 or 6 coordinates each (x, y, z, and rotations about x, y, z), have
the energies u'.M u' / 2 and u.K u / 2. The mass is also known at points: with the displacement D u
and the rotation R u of points of mass m and inertia J,

    M = D^T diag(m) D + R^T diag(J) R

At the integration points of elements this is the consistent mass matrix, and sums over the points
are integrals over the elements. For matrices of another program the points are the nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.display import displayed
from rbjax.errors import InputError


@displayed
@dataclass(frozen=True, eq=False)
class FiniteElements:
    """A structure of linear finite elements.

    Use `beam_mesh` or `tetrahedral_mesh`, or `FiniteElements.from_matrices` for matrices of another
    program.

    Fields:
        positions: nodes (n, 3), m.
        M: mass matrix (N, N), sparse.
        K: stiffness matrix (N, N), sparse.
        masses: (p,) masses of the points, or their mass matrix (p, p) for one component.
        places: points (p, 3), m.
        displacement: D (3 p, N), sparse.
        rotation: R (3 p, N), sparse; None if the points have no inertia.
        inertias: J (p, 3, 3); None if the points have no inertia.
        prestress: function from displacements (N,) to the geometric stiffness matrix (N, N) of
            their stress; None if it is not known.
    """

    positions: np.ndarray
    M: Any
    K: Any
    masses: Any
    places: np.ndarray
    displacement: Any
    rotation: Any = None
    inertias: np.ndarray | None = None
    prestress: Callable[[np.ndarray], Any] | None = None

    @property
    def per_node(self) -> int:
        """Coordinates of a node: 3 or 6."""
        return self.M.shape[0] // len(self.positions)

    @classmethod
    def from_matrices(cls, M: Any, K: Any, positions: Any) -> FiniteElements:
        """Create a structure from matrices of another program.

        The order of the coordinates is x, y, z of node 1 (and its rotations), then node 2.
        Invariants of first order in the modes follow from M exactly. Those of second order follow
        from the mass matrix of one component if M has the same for x, y and z, else from masses
        lumped at the nodes.

        Args:
            M: mass matrix (N, N), dense or sparse, with N = 3 n or 6 n.
            K: stiffness matrix (N, N).
            positions: nodes (n, 3), m.

        Raises:
            InputError: shapes do not fit, a number is not finite, or a matrix is not symmetric.

        Example:
            >>> import numpy as np
            >>> from rbjax.flexible.modal import FiniteElements
            >>> bar = FiniteElements.from_matrices(np.eye(6), np.eye(6), [[0, 0, 0], [1, 0, 0]])
            >>> bar.per_node, float(bar.masses.sum())
            (3, 2.0)
        """
        from scipy import sparse

        x = np.asarray(positions, float)
        if x.ndim != 2 or x.shape[1] != 3 or not np.isfinite(x).all():
            raise InputError(f"positions: got the shape {x.shape}, expected finite numbers (n, 3)")
        n = len(x)
        matrices = []
        for name, given in (("M", M), ("K", K)):
            A = sparse.csr_array(given, dtype=float)
            if A.shape not in ((3 * n, 3 * n), (6 * n, 6 * n)):
                raise InputError(
                    f"{name}: got the shape {A.shape}, expected ({3 * n}, {3 * n}) or "
                    f"({6 * n}, {6 * n}) for {n} nodes"
                )
            if not np.isfinite(A.data).all():
                raise InputError(f"{name}: a number is not finite, expected finite numbers")
            if abs(A - A.T).max() > 1e-8 * abs(A).max():
                raise InputError(f"{name} is not symmetric; give (A + A^T) / 2 if that is rounding")
            matrices.append(sparse.csr_array((A + A.T) / 2))
        mass, stiffness = matrices
        if mass.shape != stiffness.shape:
            raise InputError(f"M has the shape {mass.shape} and K {stiffness.shape}, expected one")
        step = mass.shape[0] // n
        rows = (np.arange(n)[:, None] * step + np.arange(3)).ravel()
        D = sparse.csr_array((np.ones(3 * n), (np.arange(3 * n), rows)), (3 * n, step * n))
        return cls(x, mass, stiffness, _component(mass, step), x, D)

    def rigid_modes(self, about: np.ndarray) -> np.ndarray:
        """Return the displacements (N, 6) of unit rotations about a point and unit translations."""
        out = np.zeros((len(self.positions), self.per_node, 6))
        out[:, :3, 3:] = np.eye(3)
        out[:, :3, :3] = np.cross(np.eye(3), (self.positions - about)[:, None]).swapaxes(1, 2)
        if self.per_node == 6:
            out[:, 3:, :3] = np.eye(3)
        return out.reshape(-1, 6)

    def load(self, acceleration: np.ndarray) -> np.ndarray:
        """Compute the nodal forces (N,) -int a dm of accelerations (p, 3) of the points."""
        weight = self.masses
        force = weight[:, None] * acceleration if weight.ndim == 1 else weight @ acceleration
        return -(self.displacement.T @ force.ravel())


def _component(M: Any, step: int) -> Any:
    """Return the mass matrix of one component, or lumped masses if the components differ."""
    blocks = [[M[i::step, j::step] for j in range(3)] for i in range(3)]
    off = max(abs(blocks[i][j]).max() for i in range(3) for j in range(3) if i != j)
    apart = max(abs(blocks[0][0] - blocks[k][k]).max() for k in (1, 2))
    turned = abs(M[:, 3::step]).max() if step == 6 else 0.0
    if max(off, apart, turned) <= 1e-10 * abs(M).max():
        return blocks[0][0]
    return sum(np.asarray(blocks[k][k].sum(1)).ravel() for k in range(3)) / 3


def quadratic_form(A: Any, weights: np.ndarray) -> Any:
    """Compute A^T diag(weights) A of a sparse matrix A."""
    from scipy import sparse

    return sparse.csr_array(A.T @ sparse.diags_array(weights) @ A)


def block_diagonal(blocks: np.ndarray) -> Any:
    """Return a sparse block-diagonal matrix of blocks (b, 3, 3)."""
    from scipy import sparse

    b = len(blocks)
    return sparse.bsr_array((blocks, np.arange(b), np.arange(b + 1)), (3 * b, 3 * b)).tocsr()
