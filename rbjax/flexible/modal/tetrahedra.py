"""Elastic solids of linear (4 nodes) or quadratic (10 nodes) tetrahedra, isotropic, with mass.

    K = int B^T C B dV,   M = int rho N^T N dV
    sigma = lambda tr(eps) 1 + 2 mu eps,   K_g = int sigma_ab dN_i/dx_a dN_j/dx_b dV

(Zienkiewicz & Taylor, *The Finite Element Method*, vol. 1). Linear tetrahedra are far too stiff in
bending: use quadratic ones. Integration is by products of Gauss-Jacobi rules.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rbjax.arguments import flag, real_array, real_number, shown
from rbjax.errors import InputError
from rbjax.flexible.modal.finite_elements import (
    FiniteElements,
    block_diagonal,
    quadratic_form,
)

#: nodes at the ends of the edge of each middle node 4 to 9, as in VTK and Abaqus
EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


def tetrahedral_mesh(
    nodes: Any, tetrahedra: Any, *, E: float, poisson: float, density: float
) -> FiniteElements:
    """Create an elastic solid of tetrahedra.

    Args:
        nodes: (n, 3), m.
        tetrahedra: indices of the nodes of each element, (e, 4) or (e, 10). The first four are the
            corners, and the others the middles of the edges 01, 12, 02, 03, 13, 23.
        E: Young's modulus, Pa.
        poisson: Poisson's ratio, from 0 to less than 0.5.
        density: kg/m^3.

    Returns:
        `FiniteElements`.

    Raises:
        InputError: shapes do not fit, a constant is out of its range, a node belongs to no element,
            or an element has no positive volume.

    Source: Zienkiewicz & Taylor, vol. 1.

    Example:
        >>> from rbjax.flexible.modal import box_mesh, tetrahedral_mesh
        >>> box = box_mesh((1, 1, 1), (1, 1, 1))
        >>> block = tetrahedral_mesh(*box, E=1e9, poisson=0.3, density=2.0)
        >>> round(float(block.masses.sum()), 12)
        2.0
    """
    where = "tetrahedral_mesh"
    x, cells = _mesh(where, nodes, tetrahedra)
    real_number(where, "E", E, above=0.0)
    real_number(where, "density", density, above=0.0)
    if real_number(where, "poisson", poisson, least=0.0) >= 0.5:
        raise InputError(f"{where}: poisson is {poisson}, expected a Poisson ratio below 0.5")
    quadratic = cells.shape[1] == 10
    mu, lam = E / (2 + 2 * poisson), E * poisson / ((1 + poisson) * (1 - 2 * poisson))

    gradients, volume, _ = _sample(x, cells, 2 if quadratic else 1)
    B = np.zeros((*gradients.shape[:2], 6, cells.shape[1], 3))
    for a in range(3):
        B[:, :, a, :, a] = gradients[..., a]
    for row, (a, b) in enumerate(((0, 1), (1, 2), (0, 2)), 3):
        B[:, :, row, :, a], B[:, :, row, :, b] = gradients[..., b], gradients[..., a]
    strain = _assemble(B, cells, len(x))
    C = np.diag([2 * mu] * 3 + [mu] * 3)
    C[:3, :3] += lam
    from scipy import sparse

    w = volume.ravel()
    K = sparse.csr_array(strain.T @ sparse.kron(sparse.diags_array(w), C, "csr") @ strain)

    _, dm, N = _sample(x, cells, 3 if quadratic else 2)
    masses = density * dm.ravel()
    spread = np.zeros((*dm.shape, 3, cells.shape[1], 3))
    for a in range(3):
        spread[:, :, a, :, a] = N
    D = _assemble(spread, cells, len(x))
    slope = np.zeros((*volume.shape, 9, cells.shape[1], 3))
    for a in range(3):
        for b in range(3):
            slope[:, :, 3 * b + a, :, b] = gradients[..., a]
    G = _assemble(slope, cells, len(x))

    def prestress(u: np.ndarray) -> Any:
        s = (strain @ u).reshape(-1, 6) @ C * w[:, None]
        stress = s[:, [0, 3, 5, 3, 1, 4, 5, 4, 2]].reshape(-1, 3, 3)
        return sparse.csr_array(G.T @ block_diagonal(np.repeat(stress, 3, axis=0)) @ G)

    places = np.einsum("gn,ena->ega", N, x[cells]).reshape(-1, 3)
    return FiniteElements(
        x, quadratic_form(D, np.repeat(masses, 3)), K, masses, places, D, prestress=prestress
    )


def box_mesh(
    size: Any, divisions: Any, quadratic: bool = False, corner: Any = (0.0, 0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (n, 3) and tetrahedra (e, 4) or (e, 10) of a box, six for each cell.

    Args:
        size: lengths of the box (3,), m.
        divisions: cells along each axis (3,), at least 1.
        quadratic: add nodes at the middles of the edges.
        corner: corner of the box with the smallest coordinates (3,), m.

    Raises:
        InputError: a length or a number of cells is not positive.

    Example:
        >>> nodes, cells = box_mesh((1.0, 1.0, 2.0), (1, 1, 2))
        >>> nodes.shape, cells.shape
        ((12, 3), (12, 4))
    """
    from itertools import permutations

    flag("box_mesh", "quadratic", quadratic)
    size, count = (
        real_array("box_mesh", name, x) for name, x in (("size", size), ("divisions", divisions))
    )
    if (count % 1).any():
        raise InputError(f"box_mesh: divisions are {count.tolist()}, expected integers")
    count = count.astype(int)
    if size.shape != (3,) or count.shape != (3,) or not ((size > 0).all() and (count > 0).all()):
        raise InputError(
            f"box_mesh: got the size {size.tolist()} and divisions {count.tolist()}, expected "
            "three lengths and three integers above zero"
        )
    axes = [np.linspace(c, c + s, k + 1) for c, s, k in zip(corner, size, count, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    index = np.arange(len(nodes)).reshape(count + 1)
    cells = []
    for order in permutations(range(3)):
        at, path = np.zeros(3, int), []
        for step in (None, *order):
            if step is not None:
                at = at + np.eye(3, dtype=int)[step]
            part = tuple(slice(a, a + k) for a, k in zip(at, count, strict=True))
            path.append(index[part].ravel())
        if np.linalg.det(np.eye(3)[list(order)]) < 0:
            path[1], path[2] = path[2], path[1]
        cells.append(np.stack(path, 1))
    corners = np.concatenate(cells)
    return with_middle_nodes(nodes, corners) if quadratic else (nodes, corners)


def with_middle_nodes(nodes: Any, tetrahedra: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and 10-node tetrahedra, with nodes at the middles of the edges.

    Args:
        nodes: (n, 3), m.
        tetrahedra: (e, 4), indices of the corners.

    Returns:
        Nodes (n + k, 3), m, and tetrahedra (e, 10).

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import with_middle_nodes
        >>> nodes, cells = with_middle_nodes(np.eye(4)[:, :3], [[0, 1, 2, 3]])
        >>> nodes.shape, cells.shape
        ((10, 3), (1, 10))
    """
    x, cells = _mesh("with_middle_nodes", nodes, tetrahedra, (4,))
    pairs = np.sort(np.stack([cells[:, edge] for edge in EDGES], 1), -1).reshape(-1, 2)
    edges, where = np.unique(pairs, axis=0, return_inverse=True)
    middle = len(x) + where.reshape(len(cells), 6)
    return np.concatenate([x, x[edges].mean(1)]), np.concatenate([cells, middle], 1)


def _mesh(
    where: str, nodes: Any, tetrahedra: Any, sizes: tuple[int, ...] = (4, 10)
) -> tuple[np.ndarray, np.ndarray]:
    """Convert nodes (n, 3) and the nodes of tetrahedra (e, 4) or (e, 10) to arrays."""
    x, cells = (real_array(where, n, a) for n, a in (("nodes", nodes), ("tetrahedra", tetrahedra)))
    if x.ndim != 2 or x.shape[1] != 3:
        raise InputError(f"{where}: nodes have the shape {x.shape}, expected (n, 3)")
    if cells.ndim != 2 or cells.shape[1] not in sizes or (cells != cells.astype(int)).any():
        due = " or ".join(f"(e, {n})" for n in sizes)
        raise InputError(
            f"{where}: tetrahedra have the shape {cells.shape} and the type "
            f"{np.asarray(tetrahedra).dtype}, expected integers {due}"
        )
    cells = cells.astype(int)
    if cells.size == 0 or cells.min() < 0 or cells.max() >= len(x):
        raise InputError(
            f"{where}: tetrahedra have the indices {shown(cells)}, expected 0 to {len(x) - 1}"
        )
    unused = np.setdiff1d(np.arange(len(x)), cells)
    if unused.size:
        raise InputError(
            f"{where}: {unused.size} nodes belong to no element, such as node "
            f"{unused[0]}; remove them"
        )
    return x, cells


def _rule(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric points (g, 4) and weights of a rule of degree 2 k - 1 on a tetrahedron."""
    from scipy.special import roots_jacobi

    rules = [roots_jacobi(k, a, 0) for a in (2, 1, 0)]
    (a, wa), (b, wb), (c, wc) = [
        ((x + 1) / 2, w / 2 ** (p + 1)) for (x, w), p in zip(rules, (2, 1, 0), strict=True)
    ]
    A, B, C = np.meshgrid(a, b, c, indexing="ij")
    x, y, z = A, B * (1 - A), C * (1 - A) * (1 - B)
    w = np.einsum("i,j,k->ijk", wa, wb, wc)
    return np.stack([1 - x - y - z, x, y, z], -1).reshape(-1, 4), w.ravel()


def _sample(x: np.ndarray, cells: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gradients (e, g, n, 3), volumes (e, g) and shape functions (g, n) at the points."""
    L, weight = _rule(k)
    rate = np.array([[-1.0, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]])  # dL / d(x, y, z)
    if cells.shape[1] == 4:
        N, dN = L, np.broadcast_to(rate, (len(L), 4, 3))
    else:
        i, j = np.array(EDGES).T
        N = np.concatenate([L * (2 * L - 1), 4 * L[:, i] * L[:, j]], 1)
        corner = (4 * L - 1)[..., None] * rate
        edge = 4 * (L[:, i, None] * rate[j] + L[:, j, None] * rate[i])
        dN = np.concatenate([corner, edge], 1)
    jacobian = np.einsum("gnb,ena->egab", dN, x[cells])
    volume = np.linalg.det(jacobian)
    scale = np.ptp(x[cells], axis=1).max(1)[:, None] ** 3
    if not (volume > 1e-10 * scale).all():
        at = int(np.argmin((volume / scale).min(1)))
        raise InputError(
            f"tetrahedral_mesh: element {at} has the volume {volume[at].min() / 6:.3g}, expected "
            "more than zero; exchange two of its corners if it is negative"
        )
    gradients = np.einsum("gnb,egba->egna", dN, np.linalg.inv(jacobian))
    return gradients, volume * weight, N


def _assemble(rows: np.ndarray, cells: np.ndarray, n: int) -> Any:
    """Assemble rows (e, g, k, nodes, 3) to a sparse matrix (e g k, 3 n)."""
    from scipy import sparse

    e, g, k, nodes, _ = rows.shape
    own = (cells[:, :, None] * 3 + np.arange(3)).reshape(e, 1, 1, 3 * nodes)
    columns = np.broadcast_to(own, (e, g, k, 3 * nodes)).ravel()
    where = np.repeat(np.arange(e * g * k), 3 * nodes)
    out = sparse.csr_array((rows.ravel(), (where, columns)), (e * g * k, 3 * n))
    out.eliminate_zeros()
    return out
