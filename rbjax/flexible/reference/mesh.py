"""The protocol of a beam element, and the mesh of nodes and elements that all of them share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.flexible.cross_section import Section

#: position (3,) and rotation matrix (3, 3) of the unloaded beam at arclengths s
Curve = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["q", "connectivity", "data", "history"],
    meta_fields=["formulation"],
)
@dataclass(frozen=True)
class Mesh:
    """Nodes and elements of one beam; the beam's state is `q` and `history`.

    formulation: the `Formulation` of all elements.
    q: coordinates of the nodes, (nodes, c).
    connectivity: nodes of each element, (elements, k), int.
    data: constants of each element, a dict of arrays (elements, ...).
    history: quantities that an element integrates from step to step, a dict of (elements, ...).
    """

    formulation: Formulation
    q: jax.Array
    connectivity: jax.Array
    data: dict[str, jax.Array]
    history: dict[str, jax.Array]

    def replace(self, **changes: Any) -> Mesh:
        """Return a copy with some fields replaced."""
        return replace(self, **changes)


class Supports(NamedTuple):
    """Fixed degrees of freedom of a mesh.

    fixed: whether an increment of a node is prescribed, (nodes, d), bool.
    basis: axes in which the increments of node 0 are prescribed, the columns of a (d, d).
    """

    fixed: np.ndarray
    basis: jax.Array


class Formulation:
    """Base class of a beam formulation: the coordinates of a node and the forces of an element.

    A node has c coordinates and d degrees of freedom. `retract` applies an increment of d entries.
    Elements have k nodes. Element functions take one element: `data` and `history` without the
    leading axis, q (k, c). `data` has an entry "stiffness" (m,). A subclass defines all attributes
    and the functions that raise here.

    name: text for tables.
    c, d, k: sizes as above.
    planar: which of the d increments remain in the plane x-y, as a tuple of bool.
    clamped: which of the d increments a clamp prescribes, as a tuple of bool.
    """

    name: str
    c: int
    d: int
    k: int
    planar: tuple[bool, ...]
    clamped: tuple[bool, ...]

    def build(self, curve: Curve, length: float, section: Section, elements: int) -> Mesh:
        """Mesh an unloaded beam in elements of the same length.

        curve: the unloaded beam, from `line` or `arc`.
        length: m.
        section: from `rbjax.flexible.section` or a shape, without couplings.
        elements: their number.
        """
        raise NotImplementedError

    def retract(self, q: jax.Array, delta: jax.Array) -> jax.Array:
        """Apply increments (..., d) to the coordinates (..., c) of nodes."""
        raise NotImplementedError

    def midway(self, q: jax.Array, delta: jax.Array) -> jax.Array:
        """Return the coordinates halfway from q to retract(q, delta)."""
        return self.retract(q, delta / 2)

    def strains(self, data: Any, history: Any, before: jax.Array, q: jax.Array) -> jax.Array:
        """Compute all strains of an element at all its points, (m,), zero if unloaded.

        before: q (k, c) at the beginning of the step, to which `history` belongs.
        """
        raise NotImplementedError

    def resist(
        self, data: Any, history: Any, before: jax.Array, q: jax.Array, stress: jax.Array
    ) -> jax.Array:
        """Compute the forces on the nodes (k, d) that balance stresses (m,) at a configuration q.

        A stress is data["stiffness"], with the weight of its point, times a strain. By default the
        forces are the gradient of stress * strains, in the increments of `retract`.
        """

        def work(delta: jax.Array) -> jax.Array:
            return stress @ self.strains(data, history, before, self.retract(q, delta))

        return self.to_world(q, jax.grad(work)(jnp.zeros((self.k, self.d))))

    def to_world(self, q: jax.Array, f: jax.Array) -> jax.Array:
        """Convert forces conjugate to increments of nodes into forces in world axes, (k, d)."""
        return f

    def kinetic_energy(self, data: Any, q: jax.Array, v: jax.Array) -> jax.Array:
        """Compute the kinetic energy T of an element with nodal velocities v (k, d), J."""
        raise NotImplementedError

    def momentum(self, data: Any, q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Compute the momenta dT/dv (k, d), and dT/dq (k, d), of nodal velocities v (k, d)."""
        raise NotImplementedError

    def advance(self, data: Any, history: Any, before: jax.Array, q: jax.Array) -> Any:
        """Return the history at the end of a step from `before` to q."""
        return history

    def load(self, q: jax.Array, wrench: jax.Array) -> jax.Array:
        """Return the generalised force (d,) of a force and moment (6,) in world axes on a node."""
        raise NotImplementedError

    def pose(self, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return position (..., 3) and tangent or section normal (..., 3) of nodes, world axes."""
        raise NotImplementedError

    def clamp_basis(self, angle: jax.Array | float) -> jax.Array:
        """Return the axes (d, d) of the increments of a clamp in the plane at an angle to x."""
        return jnp.eye(self.d)

    def clamp_increment(self, q: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
        """Return the increment (d,) of a clamped node whose clamp turns about z, in its new basis.

        before, after: angle of the clamp before and after the step, rad.
        """
        raise NotImplementedError

    # the same for every formulation

    def force(self, data: Any, history: Any, before: jax.Array, q: jax.Array) -> jax.Array:
        """Compute the elastic forces on an element, (k, d), that hold q in equilibrium."""
        stress = data["stiffness"] * self.strains(data, history, before, q)
        return self.resist(data, history, before, q, stress)

    def strain_energy(self, data: Any, history: Any, before: jax.Array, q: jax.Array) -> jax.Array:
        """Compute the strain energy of an element, J."""
        return 0.5 * data["stiffness"] @ self.strains(data, history, before, q) ** 2

    def supports(self, mesh: Mesh, *, clamp: bool = True, planar: bool = False) -> Supports:
        """Return the `Supports` of a beam clamped at node 0, or free, in the plane or in space."""
        fixed = np.zeros((len(mesh.q), self.d), bool)
        if planar:
            fixed |= ~np.array(self.planar)
        elif not self.spatial:
            raise InputError(f"{self.name} is a formulation for the plane. Give planar=True.")
        if clamp:
            fixed[0] |= np.array(self.clamped)
        tangent = self.pose(mesh.q[0])[1]
        angle = jnp.arctan2(tangent[1], tangent[0])
        return Supports(fixed, self.clamp_basis(angle) if clamp else jnp.eye(self.d))

    @property
    def spatial(self) -> bool:
        """Whether the formulation has degrees of freedom out of the plane."""
        return not all(self.planar)

    def coordinates(self, mesh: Mesh, supports: Supports) -> int:
        """Count the free degrees of freedom of a mesh."""
        return int((~supports.fixed).sum())


def principal(section: Section) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the properties of a section whose axes are principal and whose mass is centred.

    Returns (EA, GAy, GAz, GJ, EIy, EIz), N and N m^2, the mass per length, kg/m, and the rotary
    inertias (3,), kg m.
    Raises InputError for a section with couplings, which the references do not have.
    """
    C = np.asarray(section.stiffness)
    if np.any(np.diag(np.diag(C)) != C) or section.eccentric:
        raise InputError(
            "The section has couplings or an eccentric mass. The reference formulations need a "
            "diagonal stiffness and a centred mass. Use rbjax.flexible.Beam for others."
        )
    diagonal = np.diag(C)[[3, 4, 5, 0, 1, 2]]
    return diagonal, float(section.mass), np.asarray(section.inertia)


@partial(jax.jit, static_argnums=0)
def initial_strains(of: Formulation, data: Any, history: Any, q: jax.Array) -> jax.Array:
    """Compute strains (elements, m) at the beginning of a step, q (elements, k, c)."""
    return jax.vmap(of.strains)(data, history, q, q)


def check_elements(elements: int, length: float) -> None:
    """Raise InputError for a number of elements or a length that is not positive."""
    if elements < 1:
        raise InputError(f"elements is {elements}. A mesh has at least 1 element.")
    if not length > 0:
        raise InputError(f"length is {length}. It must be positive, in m.")


def chain(elements: int, k: int) -> jax.Array:
    """Return the connectivity (elements, k) of a chain: neighbours share their end node."""
    return jnp.asarray((k - 1) * np.arange(elements)[:, None] + np.arange(k))


def line(start: Any = (0.0, 0.0), angle: float = 0.0) -> Curve:
    """Return the `Curve` of a straight beam in the plane x-y.

    start: x, y of its beginning, m.
    angle: from x to the beam, rad.

    >>> from rbjax.flexible.reference import line
    >>> line()(np.array([2.0]))[0]
    array([[2., 0., 0.]])
    """
    x0, direction = np.array([*start, 0.0]), np.array([np.cos(angle), np.sin(angle), 0.0])

    def curve(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return x0 + s[:, None] * direction, _about_z(np.full(len(s), angle))

    return curve


def arc(radius: float) -> Curve:
    """Return the `Curve` of a circular arc from the origin, tangent to x, curved towards +y.

    radius: m.

    >>> from rbjax.flexible.reference import arc
    >>> arc(2.0)(np.array([np.pi]))[0].round(12)
    array([[2., 2., 0.]])
    """
    if not radius > 0:
        raise InputError(f"radius is {radius}. It must be positive, in m. Use line() otherwise.")

    def curve(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = s / radius
        x = np.stack([np.sin(angle), 1 - np.cos(angle), 0 * s], -1)
        return radius * x, _about_z(angle)

    return curve


def _about_z(angle: np.ndarray) -> np.ndarray:
    """Return rotation matrices (..., 3, 3) about z."""
    c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.stack([c, -s, o, s, c, o, o, o, o + 1], -1).reshape(*angle.shape, 3, 3)
