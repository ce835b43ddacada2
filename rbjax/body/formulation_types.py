"""The motion of one rigid body by the equations of Newton-Euler, Kirchhoff and Featherstone.

All formulations have one interface:

    y0 = f.initial(body, T, V)         the state from pose and body twist
    f.rate(t, y, (body, forces))       the vector field: `diffrax.ODETerm(f.rate)` is `f.term()`
    f.pose(body, y), f.twist(body, y)  pose and body twist from the state

A state is (q, v) with q = [position (3), attitude]. v is velocities or momenta.
(Olguin Diaz, 5.4, 5.7, 6.4; Lamb, *Hydrodynamics*, 124; Featherstone, 2.14-15.)
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from rbjax import spatial
from rbjax.body.body import Body, Situation, inertia_matrix, kinetic_energy, total_wrench
from rbjax.display import displayed
from rbjax.lanes import matvec
from rbjax.rotations import quaternion, se3, so3
from rbjax.rotations.representation import Representation, find


@displayed
class BodyState(NamedTuple):
    """A state: coordinates q (3 + size of the attitude), velocities or momenta v (6,)."""

    q: jax.Array
    v: jax.Array


class Formulation(abc.ABC):
    """Equations of motion of one rigid body, in coordinates and velocities of a formulation."""

    def __init__(self, attitude: str):
        self.attitude: Representation = find(attitude)

    @abc.abstractmethod
    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> BodyState:
        """Return the state of a body with pose T (4, 4) and body twist V (6,)."""

    @abc.abstractmethod
    def rate(self, t: Any, y: BodyState, args: Situation) -> BodyState:
        """Compute the rate of the state under the forces."""

    @abc.abstractmethod
    def pose(self, body: Body, y: BodyState) -> jax.Array:
        """Return the pose T (4, 4) of the body's frame."""

    @abc.abstractmethod
    def twist(self, body: Body, y: BodyState) -> jax.Array:
        """Return the body twist V = (omega, v) (6,) of the body's frame."""

    def term(self) -> diffrax.ODETerm:
        """Return the term for diffrax, with (body, forces) as args."""
        return diffrax.ODETerm(self.rate)

    def singularity_distance(self, y: BodyState) -> jax.Array:
        """Return the angle to the nearest singularity of the equations, or inf if none exists."""
        return self.attitude.singularity_distance(y.q[3:])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.attitude.name!r})"


class _QuaternionState(Formulation):
    """A formulation with the attitude as a quaternion, whose length has no effect."""

    def __init__(self) -> None:
        super().__init__("unit_quaternion")

    def pose(self, body: Body, y: BodyState) -> jax.Array:
        return _pose(y.q)

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"


def _attitude(q: jax.Array) -> jax.Array:
    """Return the rotation R of the quaternion in q."""
    return quaternion.to_matrix(q[3:])


def _pose(q: jax.Array) -> jax.Array:
    """Return the pose T from q = [position, quaternion]."""
    return se3.pose(_attitude(q), q[:3])


def _coordinates(T: jax.Array) -> jax.Array:
    """Return q = [position, quaternion] of a pose T."""
    return jnp.concatenate([T[:3, 3], quaternion.from_matrix(T[:3, :3])])


def _coordinate_rate(q: jax.Array, v: jax.Array, omega: jax.Array) -> jax.Array:
    """Return q' = [v, q (0, omega) / 2], with v in world axes and omega in body axes."""
    rate = quaternion.multiply(q[3:], jnp.concatenate([jnp.zeros(1, q.dtype), omega])) / 2
    return jnp.concatenate([v, rate])


class NewtonEuler(_QuaternionState):
    """Newton-Euler equations about a point P of the body, by default the center of mass.

    `point` (3,) is P in the body's frame. With c the vector from P to the center of mass and a the
    acceleration of P, all in body axes:

        m (a + omega' x c + omega x (omega x c)) = f
        I_P omega' + omega x I_P omega + m c x a = n_P

    The state has omega in body axes and the velocity v of P in world axes.
    """

    def __init__(self, point: Any = None):
        super().__init__()
        self.point = None if point is None else np.asarray(point, float)

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> BodyState:
        r = self._point(body)
        q = _coordinates(T)
        at = spatial.twist_at(V, r)
        R = _attitude(q)
        q = q.at[:3].add(matvec(R, r))
        return BodyState(q, jnp.concatenate([at[:3], matvec(R, at[3:])]))

    def rate(self, t: Any, y: BodyState, args: Situation) -> BodyState:
        body = args[0]
        omega, v, R = y.v[:3], y.v[3:], _attitude(y.q)
        F = spatial.wrench_at(
            total_wrench(args, t, self.pose(body, y), self.twist(body, y)), self._point(body)
        )
        n, f = F[:3], F[3:]
        c = body.com - self._point(body)
        if self.point is None and body.added_mass is None:
            alpha = jnp.linalg.solve(
                body.inertia, n - jnp.cross(omega, matvec(body.inertia, omega))
            )
            a = f / body.mass
        else:
            I_P = spatial.parallel_axes(body.inertia, body.mass, c)
            n = n - jnp.cross(omega, matvec(I_P, omega))
            f = f - body.mass * jnp.cross(omega, jnp.cross(omega, c))
            mc = body.mass * so3.hat(c)
            M = jnp.block([[I_P, mc], [-mc, body.mass * jnp.eye(3, dtype=mc.dtype)]])
            if body.added_mass is not None:
                A, drag = self._fluid(body, jnp.concatenate([omega, matvec(R.T, v)]))
                M, n, f = M + A, n - drag[:3], f - drag[3:]
            x = jnp.linalg.solve(M, jnp.concatenate([n, f]))
            alpha, a = x[:3], x[3:]
        rate = _coordinate_rate(y.q, v, omega)
        return BodyState(rate, jnp.concatenate([alpha, matvec(R, a)]))

    def pose(self, body: Body, y: BodyState) -> jax.Array:
        T = _pose(y.q)
        return T.at[:3, 3].add(-matvec(T[:3, :3], self._point(body)))

    def twist(self, body: Body, y: BodyState) -> jax.Array:
        at = jnp.concatenate([y.v[:3], matvec(_attitude(y.q).T, y.v[3:])])
        return spatial.twist_at(at, -self._point(body))

    def _point(self, body: Body) -> jax.Array:
        return body.com if self.point is None else jnp.asarray(self.point, body.com.dtype)

    def _fluid(self, body: Body, V: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the added mass A at P, and the wrench A (V' - (alpha, a)) + V x* A V.

        The wrench is a correction: a = v' + omega x v, but the fluid's momentum changes with v'.
        """
        shift = se3.pose(jnp.eye(3, dtype=V.dtype), -self._point(body))
        assert body.added_mass is not None
        A = spatial.transform_inertia(shift, body.added_mass)
        convective = jnp.concatenate([jnp.zeros(3, V.dtype), jnp.cross(V[:3], V[3:])])
        return A, spatial.force_cross(V, matvec(A, V)) - matvec(A, convective)


class Kirchhoff(_QuaternionState):
    """Kirchhoff's equations, from the kinetic energy T(omega, v) in body axes.

        d/dt dT/d omega + omega x dT/d omega + v x dT/d v = n
        d/dt dT/d v     + omega x dT/d v                  = f

    The derivatives of T are computed with JAX. v of the state is the body twist.
    """

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> BodyState:
        return BodyState(_coordinates(T), V)

    def rate(self, t: Any, y: BodyState, args: Situation) -> BodyState:
        body, V = args[0], y.v
        F = total_wrench(args, t, self.pose(body, y), V)

        def energy(V):
            return kinetic_energy(body, V)

        h = jax.grad(energy)(V)
        omega, v = V[:3], V[3:]
        n = F[:3] - jnp.cross(omega, h[:3]) - jnp.cross(v, h[3:])
        f = F[3:] - jnp.cross(omega, h[3:])
        acceleration = jnp.linalg.solve(jax.hessian(energy)(V), jnp.concatenate([n, f]))
        return BodyState(_coordinate_rate(y.q, matvec(_attitude(y.q), v), omega), acceleration)

    def twist(self, body: Body, y: BodyState) -> jax.Array:
        return y.v


class _Spatial(_QuaternionState):
    """The spatial equation F = I A + V x* I V, in the body's frame or in a fixed frame.

    The fixed frame has world axes and its origin at `about` (3,). None is the body's frame.
    """

    def __init__(self, about: Any = None):
        super().__init__()
        self.about = None if about is None else np.asarray(about, float)

    def _frame(self, q: jax.Array) -> jax.Array:
        """Return the pose of the body in the frame of the equation."""
        if self.about is None:
            return se3.identity(q.dtype)
        return _pose(q).at[:3, 3].add(-jnp.asarray(self.about, q.dtype))

    def _inertia(self, body: Body, q: jax.Array) -> jax.Array:
        matrix = inertia_matrix(body)
        return matrix if self.about is None else spatial.transform_inertia(self._frame(q), matrix)

    def _wrench(self, t: Any, y: BodyState, args: Situation) -> jax.Array:
        F = total_wrench(args, t, self.pose(args[0], y), self.twist(args[0], y))
        return F if self.about is None else spatial.transform_force(self._frame(y.q), F)

    def _q_rate(self, body: Body, y: BodyState) -> jax.Array:
        V = self.twist(body, y)
        return _coordinate_rate(y.q, matvec(_attitude(y.q), V[3:]), V[:3])


class Spatial(_Spatial):
    """The spatial equation of motion I A = F - V x* I V, with v the twist V."""

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> BodyState:
        q = _coordinates(T)
        return BodyState(
            q, V if self.about is None else spatial.transform_motion(self._frame(q), V)
        )

    def rate(self, t: Any, y: BodyState, args: Situation) -> BodyState:
        M, F = self._inertia(args[0], y.q), self._wrench(t, y, args)
        A = jnp.linalg.solve(M, F - spatial.force_cross(y.v, matvec(M, y.v)))
        return BodyState(self._q_rate(args[0], y), A)

    def twist(self, body: Body, y: BodyState) -> jax.Array:
        if self.about is None:
            return y.v
        return spatial.transform_motion(se3.inverse(self._frame(y.q)), y.v)


class Momentum(_Spatial):
    """The spatial equation h' = F (fixed frame) or h' = F - V x* h (body), with v = h = I V."""

    def initial(self, body: Body, T: jax.Array, V: jax.Array) -> BodyState:
        q = _coordinates(T)
        h = matvec(inertia_matrix(body), V)
        return BodyState(q, h if self.about is None else spatial.transform_force(self._frame(q), h))

    def rate(self, t: Any, y: BodyState, args: Situation) -> BodyState:
        F = self._wrench(t, y, args)
        if self.about is None:
            F = F - spatial.force_cross(self.twist(args[0], y), y.v)
        return BodyState(self._q_rate(args[0], y), F)

    def twist(self, body: Body, y: BodyState) -> jax.Array:
        h = y.v
        if self.about is not None:
            h = spatial.transform_force(se3.inverse(self._frame(y.q)), h)
        return jnp.linalg.solve(inertia_matrix(body), h)
