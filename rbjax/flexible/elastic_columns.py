"""The regressor of the elastic and viscous forces of beams.

    K q + D q' = Y [C; C_v],    Y = [B_1 q, B_2 q, ..., B_1 q', B_2 q', ...]

The stiffness matrix K is linear in the entries C of the stiffness of the section, and the damping
matrix D in its viscosity C_v (`rbjax.flexible.strain.stiffness`). B_k is the stiffness matrix of a
unit entry. Length and natural curvature enter neither K nor the inertia linearly, so they have no
columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.dynamics.arguments import check_model
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.flexible.elasticity import BeamElasticity, beam_of
from rbjax.flexible.strain import STRAINS, StrainBeam, stiffness_matrix
from rbjax.lanes import Lane, inner, pack, unpack
from rbjax.model import Model

#: the leaves of `BeamElasticity` with columns
_LEAVES = ("stiffness", "viscosity")


@algorithm("q", "v")
def elastic_regressor(model: Model, q: ArrayLike, v: ArrayLike) -> jax.Array:
    """Compute the regressor Y (nv, p) of the elastic and viscous forces of the beams of a robot.

    K q + D v = Y `elastic_parameters(model)`. Use it with `section_regressor` to identify the
    stiffness (EI, GJ, EA, GA) and the damping of beams by linear least squares:
    motor torques = ID(q, v, a) + K q + D v. `rb.sysid.torque.regressor` has both.

    Args:
        model: the robot, with the `BeamElasticity` that `Model.with_beam` adds.
        q: (nq,) configuration, m and rad.
        v: (nv,) velocity, m/s and rad/s.

    Returns:
        (nv, p), forces per unit of the parameters, in the order of `elastic_names`.

    Raises:
        InputError: wrong shapes or dtypes.

    Source: Boyer, Lebastard, Candelier & Renda, IEEE T-RO 37(3), 2021.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 1}, mass=0.5)
        >>> model = rb.load("<mujoco/>").with_beam("rod", rod)
        >>> q = jnp.array([1.0, 3.0])
        >>> rb.flexible.elastic_regressor(model, q, jnp.zeros(2))[:, 0].tolist()
        [2.0, 2.0]
    """
    columns = []
    for joint, name, leaf, length in _elastic("elastic_regressor", model, q.dtype):
        at_q, at_v = model.q_slice(joint), model.v_slice(joint)
        x = list(unpack(q)[at_q] if name == "stiffness" else unpack(v)[at_v])
        for entry in leaf.entries:
            rows: list[Any] = [0.0] * model.nv
            rows[at_v] = [
                inner(b, x) for b in stiffness_matrix(leaf.kind, leaf.unit(entry), length)
            ]
            columns.append(pack(rows, v))
    return jnp.stack(columns, -1) if columns else jnp.zeros((model.nv, 0), v.dtype)


def elastic_parameters(model: Model) -> jax.Array:
    """Read the stiffness and the viscosity of the sections of all beams of a robot.

    Args:
        model: the robot.

    Returns:
        (p,) in the order of `elastic_names`: N m^2 of curvatures and N of e_x, g_y and g_z, and of
        viscosities the same times s.

    Raises:
        InputError: not a model.

    Example:
        >>> import rbjax as rb
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 1}, mass=0.5, damping=0.25)
        >>> rb.flexible.elastic_parameters(rb.load("<mujoco/>").with_beam("rod", rod)).tolist()
        [6.0, 1.5]
    """
    check_model("elastic_parameters", model)
    dtype = model.gravity.dtype
    leaves = (leaf for _, _, leaf, _ in _elastic("elastic_parameters", model, dtype))
    values = [leaf.value[entry] for leaf in leaves for entry in leaf.entries]
    return jnp.stack([jnp.asarray(x, dtype) for x in values]) if values else jnp.zeros(0, dtype)


def elastic_names(model: Model) -> tuple[str, ...]:
    """Return the names of `elastic_parameters`, such as "rod.stiffness[k_y]" for EI_y.

    A section with couplings has an entry for each pair of strains, "rod.stiffness[k_y, e_x]", and a
    tapered beam one at each Gauss point, "rod.stiffness[2, k_y]". Strains that are not coordinates
    have no entry.

    Args:
        model: the robot.

    Returns:
        (p,) names.

    Raises:
        InputError: not a model.

    Example:
        >>> import rbjax as rb
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 1}, mass=0.5)
        >>> rb.flexible.elastic_names(rb.load("<mujoco/>").with_beam("rod", rod))
        ('rod.stiffness[k_z]', 'rod.viscosity[k_z]')
    """
    check_model("elastic_names", model)
    return tuple(
        f"{joint}.{name}[{leaf.place(entry)}]"
        for joint, name, leaf, _ in _elastic("elastic_names", model, model.gravity.dtype)
        for entry in leaf.entries
    )


def _elastic(where: str, model: Model, dtype: Any) -> Iterator[tuple[str, str, _Leaf, Lane]]:
    """Yield the beam, the name and the layout of each leaf with columns, and the beam's length."""
    for element in model.forces:
        if isinstance(element, BeamElasticity):
            kind, length = beam_of(model, element.joint, dtype, where)
            for name in _LEAVES:
                yield element.joint, name, _Leaf.of(kind, getattr(element, name)), length


class _Leaf(NamedTuple):
    """The stiffness or the viscosity of a beam, and the entries of it that are parameters.

    Fields:
        kind: the kind of joint.
        value: (6,) or (6, 6), or one at each Gauss point.
        each: whether there is one at each Gauss point.
        diagonal: whether the last axis is a diagonal.
    """

    kind: StrainBeam
    value: jax.Array
    each: bool
    diagonal: bool

    @classmethod
    def of(cls, kind: StrainBeam, value: jax.Array) -> _Leaf:
        """Find the layout of a leaf, as `stiffness_matrix` does."""
        n, points, shape = len(STRAINS), kind.shape.points, np.shape(value)
        diagonals = shape == (points, n) and (kind.shape.tapered or points != n)
        return cls(kind, value, diagonals or len(shape) == 3, diagonals or len(shape) == 1)

    @property
    def entries(self) -> list[tuple[int, ...]]:
        """The indices of the parameters; of a symmetric pair the one above the diagonal."""
        active = sorted({c for shape in self.kind.shapes for c in shape})
        pairs = [(c, d) for c in active for d in active if c <= d]
        own = [(c,) for c in active] if self.diagonal else pairs
        points = [(g,) for g in range(len(self.value))] if self.each else [()]
        return [(*g, *x) for g in points for x in own]

    def unit(self, entry: tuple[int, ...]) -> Any:
        """Return the leaf with ones at an entry and at its mirror image, as nested lists."""
        out = np.zeros(np.shape(self.value))
        out[entry] = 1.0
        if not self.diagonal:
            out[(*entry[:-2], entry[-1], entry[-2])] = 1.0
        return out.tolist()

    def place(self, entry: tuple[int, ...]) -> str:
        """Return the name of an entry."""
        point = [str(entry[0])] if self.each else []
        strains = dict.fromkeys(STRAINS[c] for c in entry[len(point) :])
        return ", ".join([*point, *strains])
