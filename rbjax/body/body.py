"""One rigid body, and the forces on it.

A body has a frame with pose T (4, 4) in the world. Its twist V (6,) = (omega, v) is the angular
velocity of that frame and the velocity of its origin, in body axes. A force is a function

    force(t, body, T, V) -> (6,) wrench (n, f) at the frame's origin, in body axes

and may also have a `potential(body, T)`. Forces add up. Added mass is the inertia of the fluid that
a body moves (Lamb, ch. 6): in an unbounded ideal fluid its kinetic energy is V . A V / 2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax import spatial
from rbjax.arguments import ArrayLike, instance
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.rotations.arguments import SHAPES, checked, takes
from rbjax.spatial import MassProperties


def unbatched(where: str, name: str, value: Any, kind: str) -> jax.Array:
    """Return an argument as an array. Check that it has the shape `SHAPES[kind]`, with no batch."""
    x = checked(where, name, value, kind)
    if x.shape != SHAPES[kind]:
        expected = f"{SHAPES[kind]}; for a batch use jax.vmap"
        raise InputError(f"{where}: {name} has shape {x.shape}, expected {expected}")
    return x


def coordinate_vector(where: str, name: str, value: Any) -> jax.Array:
    """Check that an argument is a nonempty vector (n,), such as coordinates."""
    x = checked(where, name, value, "scalar")
    if x.ndim != 1 or not x.size:
        expected = "(n,), n at least 1; for a batch use jax.vmap"
        raise InputError(f"{where}: {name} has shape {x.shape}, expected {expected}")
    return x


Force = Callable[[Any, "Body", jax.Array, jax.Array], jax.Array]


@displayed
class Body(NamedTuple):
    """Mass, center of mass and inertia of a body, such as `Body(*shapes.box([1, 2, 3], mass=5.0))`.

    com: (3,) in the body's frame, m.
    inertia: (3, 3) about the com, kg m^2.
    added_mass: (6, 6) of the fluid at rest around the body, at the frame's origin, or None.
    """

    mass: jax.Array
    com: jax.Array
    inertia: jax.Array
    added_mass: jax.Array | None = None


@displayed
class Situation(NamedTuple):
    """A body and the forces on it, the `args` of every formulation in diffrax."""

    body: Body
    forces: tuple[Force, ...] = ()


def rigid_body(
    properties: MassProperties | Body,
    forces: Sequence[Force] = (),
    added_mass: ArrayLike | None = None,
) -> Situation:
    """Check mass properties, and return a body with these properties and the forces on it.

    Args:
        properties: `rbjax.spatial.MassProperties`, SI units, or a `Body`.
        forces: functions (t, body, T (4, 4), V (6,)) -> wrench (6,), N m, then N.
        added_mass: (6, 6), kg m^2, kg m and kg; None for none.

    Returns:
        `Situation`: the body and the forces.

    Raises:
        InputError: no body can have this inertia; a force that cannot be called.

    Example:
        >>> from rbjax.body import rigid_body
        >>> from rbjax import spatial
        >>> ball = rigid_body(spatial.shapes.sphere(1.0, mass=5.0))
        >>> ball.body.inertia.diagonal().tolist()
        [2.0, 2.0, 2.0]
    """
    if not (isinstance(properties, tuple) and len(properties) >= 3):
        raise InputError(
            f"rigid_body: properties is {type(properties).__name__}, expected MassProperties or "
            "Body"
        )
    known = isinstance(forces, Sequence) and not isinstance(forces, str)
    if not known or not all(callable(f) for f in forces):
        raise InputError(
            f"rigid_body: forces is {forces!r}, expected a sequence of functions "
            "(t, body, T, V) -> wrench (6,), such as rbjax.body.Spring(...)"
        )
    mass, com, inertia = spatial.check_mass_properties(*properties[:3])
    if added_mass is None and isinstance(properties, Body):
        added_mass = properties.added_mass
    added = None if added_mass is None else jnp.asarray(added_mass)
    return Situation(Body(mass, com, inertia, added), tuple(forces))


def inertia_matrix(body: Body) -> jax.Array:
    """Compute the inertia matrix M (6, 6) at the frame's origin, including added mass.

    Args:
        body: a `Body`.

    Returns:
        (6, 6), kg m^2, kg m and kg.

    Raises:
        InputError: not a `Body`.

    Example:
        >>> from rbjax.body import inertia_matrix, rigid_body
        >>> from rbjax import spatial
        >>> ball = rigid_body(spatial.shapes.sphere(1.0, mass=5.0))
        >>> inertia_matrix(ball.body).diagonal().tolist()
        [2.0, 2.0, 2.0, 5.0, 5.0, 5.0]
    """
    public = "Body; rigid_body(...).body makes one of mass properties"
    instance("inertia_matrix", "body", body, Body, public)
    matrix = spatial.spatial_inertia(body.mass, body.com, body.inertia)
    return matrix if body.added_mass is None else matrix + body.added_mass


def total_wrench(situation: Situation, t: Any, T: ArrayLike, V: ArrayLike) -> jax.Array:
    """Sum all forces to a wrench (6,) at the frame's origin in body axes.

    Args:
        situation: a body and its forces, as from `rigid_body`.
        t: time, s.
        T: (4, 4), pose of the body, with lengths in m.
        V: (6,), body twist, rad/s, then m/s.

    Returns:
        (6,), N m, then N.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.body import rigid_body, total_wrench
        >>> from rbjax import spatial
        >>> from rbjax.body import UniformGravity
        >>> ball = rigid_body(spatial.shapes.sphere(1.0, mass=5.0), [UniformGravity()])
        >>> total_wrench(ball, 0.0, jnp.eye(4), jnp.zeros(6)).round(3).tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0, -49.050000000000004]
    """
    body, forces = _parts("total_wrench", situation)
    T, V = unbatched("total_wrench", "T", T, "pose"), unbatched("total_wrench", "V", V, "twist")
    return sum((f(t, body, T, V).astype(V.dtype) for f in forces), start=jnp.zeros_like(V))


def _parts(where: str, situation: Any) -> tuple[Body, tuple[Force, ...]]:
    known = isinstance(situation, tuple) and len(situation) == 2
    if not known or not isinstance(situation[0], Body):
        raise InputError(
            f"{where}: situation is {type(situation).__name__}, expected Situation(body, forces), "
            "as rigid_body makes it"
        )
    return situation[0], situation[1]


def split(situation: Situation) -> tuple[tuple[Any, ...], Situation]:
    """Return the forces that have a potential, and a situation with all remaining forces."""
    body, forces = situation
    conservative = tuple(f for f in forces if hasattr(f, "potential"))
    rest = tuple(f for f in forces if not hasattr(f, "potential"))
    return conservative, Situation(body, rest)


def potential_energy(situation: Situation, T: ArrayLike) -> jax.Array:
    """Compute the potential energy of all forces that have a potential.

    Args:
        situation: a body and its forces, as from `rigid_body`.
        T: (4, 4), pose of the body, with lengths in m.

    Returns:
        (), J.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.body import potential_energy, rigid_body
        >>> from rbjax import spatial
        >>> from rbjax.body import UniformGravity
        >>> ball = rigid_body(spatial.shapes.sphere(1.0, mass=5.0), [UniformGravity()])
        >>> round(float(potential_energy(ball, jnp.eye(4).at[2, 3].set(2.0))), 3)
        98.1
    """
    body, forces = _parts("potential_energy", situation)
    T = unbatched("potential_energy", "T", T, "pose")
    conservative, _ = split(Situation(body, forces))
    energies = (f.potential(body, T).astype(T.dtype) for f in conservative)
    return sum(energies, start=jnp.zeros((), T.dtype))


def kinetic_energy(body: Body, V: ArrayLike) -> jax.Array:
    """Compute the kinetic energy V . M V / 2, including added mass.

    Args:
        body: a `Body`.
        V: (6,), body twist, rad/s, then m/s.

    Returns:
        (), J.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.body import kinetic_energy, rigid_body
        >>> from rbjax import spatial
        >>> ball = rigid_body(spatial.shapes.sphere(1.0, mass=5.0))
        >>> float(kinetic_energy(ball.body, jnp.array([0.0, 0.0, 2.0, 1.0, 0.0, 0.0])))
        6.5
    """
    return spatial.kinetic_energy(
        inertia_matrix(body), unbatched("kinetic_energy", "V", V, "twist")
    )


NODES, WEIGHTS = np.polynomial.legendre.leggauss(48)


@takes(positive=["semi_axes", "density"], semi_axes="vector", density="scalar")
def ellipsoid_added_mass(semi_axes: ArrayLike, density: ArrayLike) -> jax.Array:
    """Compute the added mass A (..., 6, 6) of an ellipsoid at its center (Lamb, 114-115, 121a).

        alpha_i = abc int_0^inf dl / ((a_i^2 + l) D),    D^2 = prod (a_j^2 + l)

    The translational added mass along axis i is m alpha_i / (2 - alpha_i), with m the mass of the
    displaced fluid: m / 2 for a ball. Digits are lost if the axes differ by a factor of tens.

    Args:
        semi_axes: (..., 3), m.
        density: (...), of the fluid, kg/m^3.

    Returns:
        (..., 6, 6), kg m^2, then kg.

    Raises:
        InputError: another shape, or a semi-axis or density that is not above zero.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.body import ellipsoid_added_mass
        >>> ellipsoid_added_mass([1.0, 1.0, 1.0], 3 / (2 * jnp.pi)).diagonal().round(5).tolist()
        [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
    """
    a2, product = semi_axes * semi_axes, jnp.prod(semi_axes, axis=-1)
    # substitute l = s^2 tan^2 u with the mean radius s: the integrand is smooth in u in (0, pi/2)
    u = jnp.asarray((NODES + 1) * np.pi / 4, a2.dtype)
    weights = jnp.asarray(WEIGHTS * np.pi / 4, a2.dtype)
    s2 = product[..., None] ** (2 / 3)
    l = s2 * jnp.tan(u) ** 2
    dl = 2 * s2 * jnp.tan(u) * (1 + jnp.tan(u) ** 2) * weights
    apart = a2[..., :, None] + l[..., None, :]
    D = jnp.sqrt(jnp.prod(apart, axis=-2))
    alpha = product[..., None] * (dl[..., None, :] / (apart * D[..., None, :])).sum(-1)
    m = (4 / 3 * jnp.pi * density * product)[..., None]
    j, k = np.array([1, 2, 0]), np.array([2, 0, 1])
    less, more = a2[..., j] - a2[..., k], a2[..., j] + a2[..., k]
    turn = alpha[..., k] - alpha[..., j]
    round_ = jnp.abs(less) <= 1e-6 * more  # rotation about such an axis leaves the fluid at rest
    below = jnp.where(round_, 1.0, 2 * less - more * turn)
    angular = jnp.where(round_, 0.0, m / 5 * less**2 * turn / below)
    both = jnp.concatenate([angular, m * alpha / (2 - alpha)], -1)
    return both[..., None] * jnp.eye(6, dtype=a2.dtype)
