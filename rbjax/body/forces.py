"""Forces on a body: gravity, buoyancy, drag, springs.

A force is a pytree of its parameters, and a function (t, body, T, V) -> wrench (6,) at the origin
of the body's frame, in body axes (`rigid_body`). A force with a `potential` is minus the gradient
of the potential.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax import spatial
from rbjax.body.body import Body
from rbjax.display import displayed
from rbjax.lanes import matvec, safe_sqrt
from rbjax.rotations.arguments import checked


def _as_array(value: Any) -> Any:
    """Convert a field to an array, or return a value that cannot be converted unchanged."""
    try:
        return jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        return value


def field(kind: str, **options: Any) -> Any:
    """Declare a field of a force: an array of a kind of `rbjax.rotations.arguments.SHAPES`."""
    return eqx.field(converter=_as_array, metadata={"kind": kind}, **options)


class BodyForce(eqx.Module):
    """The base class of forces. It checks the fields that `field` declares."""

    def __check_init__(self) -> None:
        for name, of in self.__dataclass_fields__.items():
            checked(type(self).__name__, name, getattr(self, name), of.metadata["kind"])


def _at(T: jax.Array, point: jax.Array) -> jax.Array:
    """Compute the world position of a point of the body."""
    return T[:3, 3] + matvec(T[:3, :3], point)


def _world_force(T: jax.Array, f: jax.Array, point: jax.Array) -> jax.Array:
    """Compute the wrench of a force (3,) in world axes at a point of the body."""
    return spatial.force_at(matvec(T[:3, :3].T, f), point)


@displayed
class UniformGravity(BodyForce):
    """Gravity with a uniform acceleration.

    Fields:
        acceleration: (3,), in world axes, m/s^2.
    """

    acceleration: jax.Array = field("vector", default_factory=lambda: jnp.array([0.0, 0.0, -9.81]))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        return _world_force(T, body.mass * self.acceleration, body.com)

    def potential(self, body: Body, T: jax.Array) -> jax.Array:
        return -body.mass * (self.acceleration * _at(T, body.com)).sum()


@displayed
class CentralGravity(BodyForce):
    """Gravity of a point mass at `centre` (3,) with mu = G M, m^3/s^2, to second order in size.

    V = -mu m / r - mu (tr I_c - 3 n . I_c n) / (2 r^3)  (MacCullagh), with n the direction from the
    center to the com. The torque about the com is 3 mu n x I_c n / r^3.

    Fields:
        mu: (), G M, m^3/s^2.
        centre: (3,), the point mass in the world, m.
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


@displayed
class Buoyancy(BodyForce):
    """Buoyancy of a fully immersed volume.

    Fields:
        density: (), of the fluid, kg/m^3.
        volume: (), m^3.
        centre: (3,), centre of the volume in the body, m.
        gravity: (3,), in the world, m/s^2.
    """

    density: jax.Array = field("scalar")
    volume: jax.Array = field("scalar")
    centre: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))
    gravity: jax.Array = field("vector", default_factory=lambda: jnp.array([0.0, 0.0, -9.81]))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        return _world_force(T, -self.density * self.volume * self.gravity, self.centre)

    def potential(self, body: Body, T: jax.Array) -> jax.Array:
        return self.density * self.volume * (self.gravity * _at(T, self.centre)).sum()


@displayed
class LinearDrag(BodyForce):
    """Linear drag -D (V - V_fluid) at the frame's origin in body axes.

    Fields:
        coefficients: D (6, 6), N m s, N s and N s/m.
        stream: (3,), velocity of the fluid in the world, m/s.
    """

    coefficients: jax.Array = field("matrix6")
    stream: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        return -matvec(self.coefficients, _through(T, V, self.stream))


@displayed
class QuadraticDrag(BodyForce):
    """Quadratic drag -d_i |V_i| V_i for each component of the twist relative to the fluid.

    Fields:
        coefficients: d (6,), rho C_D A / 2 for a face of area A; kg m^2, then kg/m.
        stream: (3,), velocity of the fluid in the world, m/s.
    """

    coefficients: jax.Array = field("twist")
    stream: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        past = _through(T, V, self.stream)
        return -self.coefficients * jnp.abs(past) * past


@displayed
class Spring(BodyForce):
    """A spring between a point of the world and a point of the body: force k (l - l_0).

    Fields:
        stiffness: k, (), N/m.
        anchor: (3,), in the world, m.
        point: (3,), in the body, m.
        rest_length: l_0, (), m.
    """

    stiffness: jax.Array = field("scalar")
    anchor: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))
    point: jax.Array = field("vector", default_factory=lambda: jnp.zeros(3))
    rest_length: jax.Array = field("scalar", default=0.0)

    def __call__(self, t: Any, body: Body, T: jax.Array, V: jax.Array) -> jax.Array:
        d = _at(T, self.point) - self.anchor
        l = safe_sqrt((d * d).sum())
        # a spring of length zero has no direction and exerts no force
        pull = 1 - self.rest_length / jnp.where(l > 0, l, jnp.inf)
        return _world_force(T, -self.stiffness * pull * d, self.point)

    def potential(self, body: Body, T: jax.Array) -> jax.Array:
        d = _at(T, self.point) - self.anchor
        return self.stiffness * (safe_sqrt((d * d).sum()) - self.rest_length) ** 2 / 2


@displayed
class Damper(BodyForce):
    """A damper between a point of the world and a point of the body: force -c dl/dt.

    Fields:
        damping: c, (), N s/m.
        anchor: (3,), in the world, m.
        point: (3,), in the body, m.
    """

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
    """Compute the twist relative to a fluid with the uniform velocity `stream` in the world."""
    return V - jnp.concatenate([jnp.zeros_like(stream), matvec(T[:3, :3].T, stream)])
