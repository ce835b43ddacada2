"""All representations of attitude with one interface, and conversions between them.

`representations()` returns all representations that cover SO(3). `vectorial` has two more that
cover only a part of SO(3).
"""

from __future__ import annotations

import functools
from types import MappingProxyType
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike, choice
from rbjax.lanes import quaternion_matrix
from rbjax.rotations import quaternion, redundant
from rbjax.rotations.arguments import entries, stacked, takes
from rbjax.rotations.euler import SEQUENCES, EulerAngles
from rbjax.rotations.vectorial import VECTORIAL

__all__ = ["Representation", "representations", "find", "convert"]


class Formulas(Protocol):
    """A representation on lanes. Matrices are row by row. Quaternions have any nonzero length."""

    @property
    def size(self) -> int: ...
    @property
    def singular_set(self) -> str: ...
    def to_quaternion(self, x: list) -> list: ...
    def from_quaternion(self, q: list) -> Any: ...  # lanes, or an array
    def body_rate(self, x: list) -> list: ...
    def space_rate(self, x: list) -> list: ...
    def inverse_body_rate(self, x: list) -> list: ...
    def inverse_space_rate(self, x: list) -> list: ...
    def distance(self, x: list) -> Any: ...


class Representation:
    """A representation of the attitude R_AB of body axes B in space axes A by x (..., size).

    At a singularity (`singularity_distance` is 0) `from_matrix` returns one of several solutions,
    whose matrix is R, and the inverse rate matrices are very large but finite.
    """

    def __init__(self, name: str, formulas: Formulas):
        self.name, self.formulas = name, formulas
        self.size, self.singular_set = formulas.size, formulas.singular_set

    def __repr__(self) -> str:
        return f"Representation({self.name!r}, size={self.size})"

    @takes(["self"], x="parameters")
    def to_matrix(self, x: ArrayLike) -> jax.Array:
        """Compute the rotation matrix R (..., 3, 3)."""
        return stacked(quaternion_matrix(*self.formulas.to_quaternion(entries(x))), 3, 3)

    @takes(["self"], R="rotation")
    def from_matrix(self, R: ArrayLike) -> jax.Array:
        """Compute the parameters x (..., size) of a rotation matrix R (..., 3, 3)."""
        return stacked(self.formulas.from_quaternion(quaternion.from_matrix_lanes(entries(R, 2))))

    @takes(["self"], x="parameters")
    def to_quaternion(self, x: ArrayLike) -> jax.Array:
        """Compute a unit quaternion w, x, y, z (..., 4), of either sign."""
        q = self.formulas.to_quaternion(entries(x))
        shrink = 1 / jnp.sqrt(sum(a * a for a in q))
        return stacked([a * shrink for a in q])

    @takes(["self"], q="quaternion")
    def from_quaternion(self, q: ArrayLike) -> jax.Array:
        """Compute the parameters x (..., size) of a quaternion of any nonzero length."""
        return stacked(self.formulas.from_quaternion(entries(q)))

    @takes(["self"], x="parameters")
    def body_rate_matrix(self, x: ArrayLike) -> jax.Array:
        """Compute the rate matrix E (..., 3, size) of omega_body = E x'."""
        return stacked(self.formulas.body_rate(entries(x)), 3, self.size)

    @takes(["self"], x="parameters")
    def space_rate_matrix(self, x: ArrayLike) -> jax.Array:
        """Compute the rate matrix E (..., 3, size) of omega_space = E x'."""
        return stacked(self.formulas.space_rate(entries(x)), 3, self.size)

    @takes(["self"], x="parameters")
    def inverse_body_rate_matrix(self, x: ArrayLike) -> jax.Array:
        """Compute the matrix (..., size, 3) that maps omega_body to x'."""
        return stacked(self.formulas.inverse_body_rate(entries(x)), self.size, 3)

    @takes(["self"], x="parameters")
    def inverse_space_rate_matrix(self, x: ArrayLike) -> jax.Array:
        """Compute the matrix (..., size, 3) that maps omega_space to x'."""
        return stacked(self.formulas.inverse_space_rate(entries(x)), self.size, 3)

    @takes(["self"], x="parameters", xd="parameters", xdd="parameters")
    def body_acceleration(self, x: ArrayLike, xd: ArrayLike, xdd: ArrayLike) -> jax.Array:
        """Compute d omega_body/dt = E x'' + E' x' (..., 3)."""
        return _rate_of(self.formulas.body_rate, x, xd, xdd)

    @takes(["self"], x="parameters", xd="parameters", xdd="parameters")
    def space_acceleration(self, x: ArrayLike, xd: ArrayLike, xdd: ArrayLike) -> jax.Array:
        """Compute d omega_space/dt = E x'' + E' x' (..., 3)."""
        return _rate_of(self.formulas.space_rate, x, xd, xdd)

    @takes(["self"], x="parameters", omega="vector", alpha="vector")
    def second_rate_from_body(self, x: ArrayLike, omega: ArrayLike, alpha: ArrayLike) -> jax.Array:
        """Compute x'' (..., size) from omega_body and its derivative alpha."""
        return _second_rate(self.formulas.inverse_body_rate, x, omega, alpha)

    @takes(["self"], x="parameters", omega="vector", alpha="vector")
    def second_rate_from_space(self, x: ArrayLike, omega: ArrayLike, alpha: ArrayLike) -> jax.Array:
        """Compute x'' (..., size) from omega_space and its derivative alpha."""
        return _second_rate(self.formulas.inverse_space_rate, x, omega, alpha)

    @takes(["self"], x="parameters")
    def singularity_distance(self, x: ArrayLike) -> jax.Array:
        """Return the angle (...) of the smallest rotation to the `singular_set`, or inf."""
        return self.formulas.distance(entries(x))


def _apply(matrix: list, v: list) -> list:
    n = len(v)
    rows = [matrix[i : i + n] for i in range(0, len(matrix), n)]
    return [sum(a * b for a, b in zip(row, v, strict=True)) for row in rows]


def _rate_of(E, x: jax.Array, xd: jax.Array, xdd: jax.Array) -> jax.Array:
    """Compute d/dt (E(x) x') by differentiation along the motion."""
    args, rates = (entries(x), entries(xd)), (entries(xd), entries(xdd))
    return stacked(jax.jvp(lambda x, xd: _apply(E(x), xd), args, rates)[1])


def _second_rate(inverse, x: jax.Array, omega: jax.Array, alpha: jax.Array) -> jax.Array:
    """Compute x'' = d/dt (E^-1(x) omega) by differentiation along the motion."""
    p, w = entries(x), entries(omega)
    xd = _apply(inverse(p), w)
    return stacked(jax.jvp(lambda p, w: _apply(inverse(p), w), (p, w), (xd, entries(alpha)))[1])


@functools.cache
def representations() -> MappingProxyType[str, Representation]:
    """Return all representations by name, in a stable order, with the 24 Euler sequences last.

    Returns:
        Name -> `Representation`.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations import representations
        >>> reps = representations()
        >>> len(reps) >= 30, list(reps)[:3]
        (True, ['rotation_matrix', 'unit_quaternion', 'unit_quaternion_xyzw'])
        >>> reps["roll_pitch_yaw"].to_matrix([0.0, 0.0, jnp.pi / 2]).round(6)[0].tolist()
        [0.0, -1.0, 0.0]
    """
    formulas: dict[str, Formulas] = {
        "rotation_matrix": redundant.RotationMatrix(),
        "unit_quaternion": redundant.UnitQuaternion(),
        "unit_quaternion_xyzw": redundant.UnitQuaternion(scalar_last=True),
        "axis_angle": redundant.AxisAngle(),
        "two_columns": redundant.TwoColumns(),
    }
    whole = ("euler_vector", "gibbs", "cayley", "mrp", "wiener_milenkovic")
    formulas |= {name: VECTORIAL[name] for name in whole}
    formulas |= {
        "roll_pitch_yaw": EulerAngles("xyz", intrinsic=False),
        "zyz": EulerAngles("zyz", intrinsic=True),
    }
    for kind in ("intrinsic", "extrinsic"):
        formulas |= {f"{kind}_{s}": EulerAngles(s, kind == "intrinsic") for s in SEQUENCES}
    return MappingProxyType({name: Representation(name, f) for name, f in formulas.items()})


def convert(x: ArrayLike, source: str, target: str) -> jax.Array:
    """Convert parameters x (..., n) from one representation to another, given by their names.

    Args:
        x: (..., n), parameters in the unit of their representation; angles in rad.
        source: name of the representation of x; one of `representations()`.
        target: name of the representation of the result.

    Returns:
        (..., m), parameters of the same attitude.

    Raises:
        UnknownName: no such representation.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations import convert
        >>> convert([0.0, 0.0, jnp.pi / 2], "euler_vector", "mrp").tolist()
        [0.0, 0.0, 0.41421356237309503]
    """
    return find(target).from_quaternion(find(source).to_quaternion(x))


def find(name: str) -> Representation:
    """Return a representation by its name."""
    known = representations()
    return known[choice("representation", name, known)]
