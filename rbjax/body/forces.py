"""Forces on a body: gravity, buoyancy, drag, springs.

Each is a pytree of its numbers, and a function (t, body, T, V) -> wrench (6,) at the origin of the
body's frame, in body axes (`rigid_body`). A force with a `potential` is minus its gradient.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax import spatial
from rbjax.body.body import Body
from rbjax.lanes import matvec
from rbjax.rotations.arguments import checked
from rbjax.rotations.coefficients import length


def _as_array(value: Any) -> Any:
    """The converter of a field. A value that is not an array stays, and `Force` rejects it."""
    try:
        return jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        return value


def field(kind: str, **options: Any) -> Any:
    """A field of a `Force`: an array of a kind of `rbjax.rotations.arguments.SHAPES`."""
    return eqx.field(converter=_as_array, metadata={"kind": kind}, **options)


class Force(eqx.Module):
    """A force with fields made by `field`, which are checked."""

    def __check_init__(self) -> None:
        for name, of in self.__dataclass_fields__.items():
            checked(type(self).__name__, name, getattr(self, name), of.metadata["kind"])


def _at(T: jax.Array, point: jax.Array) -> jax.Array:
    """The world position of a point of the body."""
    return T[:3, 3] + matvec(T[:3, :3], point)


def _world_force(T: jax.Array, f: jax.Array, point: jax.Array) -> jax.Array:
    """The wrench of a force (3,) in world axes at a point of the body."""
    return spatial.force_at(matvec(T[:3, :3].T, f), point)


class UniformGravity(Force):
    """The same acceleration (3,) everywhere, in m/s^2."""

    acceleration: jax.Array = field("vector", default_factory=lambda: jnp.array([0.0, 0.0, -9.81]))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        return _world_force(T, body.mass * self.acceleration, body.com)

    def potential(self, body: Body, T: jax.Array) -> jax.Array:
        return -body.mass * (self.acceleration * _at(T, body.com)).sum()


class CentralGravity(Force):
    """Attraction by a point mass at `centre` (3,), mu = G M in m^3/s^2, to second order in size.

    MacCullagh: V = -mu m / r - mu (tr I_c - 3 n . I_c n) / (2 r^3), with n from the centre to com.
    The torque is 3 mu n x I_c n / r^3.
    """

    mu: jax.Array = field("scalar")
    centre: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        R = T[:3, :3]
        d = matvec(R.T, _at(T, body.com) - self.centre)
        r = jnp.sqrt((d * d).sum())
        Id, trace = matvec(body.inertia, d), jnp.trace(body.inertia)
        k = self.mu / r**5
        f = -self.mu * body.mass / r**3 * d
        f = f - k * (1.5 * trace * d + 3 * Id - 7.5 * (d * Id).sum() / r**2 * d)
        couple = jnp.concatenate([3 * k * jnp.cross(d, Id), jnp.zeros_like(d)])
        return spatial.force_at(f, body.com) + couple

    def potential(self, body: Body, T: jax.Array) -> jax.Array:
        d = matvec(T[:3, :3].T, _at(T, body.com) - self.centre)
        r = jnp.sqrt((d * d).sum())
        second = jnp.trace(body.inertia) - 3 * (d * matvec(body.inertia, d)).sum() / r**2
        return -self.mu * body.mass / r - self.mu * second / (2 * r**3)


class Buoyancy(Force):
    """Archimedes: minus the weight of the fluid of `density` in a fully immersed `volume`, at the
    centre (3,) of the volume in the body.
    """

    density: jax.Array = field("scalar")
    volume: jax.Array = field("scalar")
    centre: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))
    gravity: jax.Array = field("vector", default_factory=lambda: jnp.array([0.0, 0.0, -9.81]))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        return _world_force(T, -self.density * self.volume * self.gravity, self.centre)

    def potential(self, body: Body, T: jax.Array) -> jax.Array:
        return self.density * self.volume * (self.gravity * _at(T, self.centre)).sum()


class LinearDrag(Force):
    """Linear drag -D (V - V_fluid), D (6, 6) in body axes at the frame's origin; `stream` (3,) in
    the world."""

    coefficients: jax.Array = field("matrix6")
    stream: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        return -matvec(self.coefficients, _through(T, V, self.stream))


class QuadraticDrag(Force):
    """Quadratic drag -d_i |V_i| V_i for each of the six, d (6,); d = rho C_D A / 2 of a face."""

    coefficients: jax.Array = field("twist")
    stream: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        past = _through(T, V, self.stream)
        return -self.coefficients * jnp.abs(past) * past


class Spring(Force):
    """A spring from a world point (`anchor`) to a body point: k (l - l_0) along the line."""

    stiffness: jax.Array = field("scalar")
    anchor: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))
    point: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))
    rest_length: jax.Array = field("scalar", default=0.0)

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        d = _at(T, self.point) - self.anchor
        l = length((d * d).sum())
        # a line of length zero has no direction: its spring gives no force, not a nan
        pull = 1 - self.rest_length / jnp.where(l > 0, l, jnp.inf)
        return _world_force(T, -self.stiffness * pull * d, self.point)

    def potential(self, body: Body, T: jax.Array) -> jax.Array:
        d = _at(T, self.point) - self.anchor
        return self.stiffness * (length((d * d).sum()) - self.rest_length) ** 2 / 2


class Damper(Force):
    """A damper between two such points: -c times the rate of their distance, along the line."""

    damping: jax.Array = field("scalar")
    anchor: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))
    point: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        d = _at(T, self.point) - self.anchor
        square = (d * d).sum()
        v = matvec(T[:3, :3], spatial.twist_at(V, self.point)[3:])
        f = -self.damping * (d * v).sum() / jnp.where(square > 0, square, 1.0) * d
        return _world_force(T, f, self.point)


def _through(T: jax.Array, V: jax.Array, stream: jax.Array) -> jax.Array:
    """The twist relative to a fluid that streams without rotation."""
    return V - jnp.concatenate([jnp.zeros_like(stream), matvec(T[:3, :3].T, stream)])
