"""Tendons along a beam, guided by its sections.

    l = int |e| ds,   e = Gamma + k x r + r',
    dl/dq_j = int e . (dGamma/dq_j + dk/dq_j x r) / |e| ds

r(s) = (0, y, z) is the place of the tendon in the section, and e its tangent in the axes of the
section. The tendon slides without friction, so that its tension is constant, and it pulls the beam
by the transpose of this map. Gauss quadrature between the ends of the tendon computes the integrals
(Rucker & Webster, *Statics and dynamics of continuum robots with general tendon routing and
external loading*, IEEE T-RO 27(6), 2011).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import Polynomial, legendre

from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.flexible.elasticity import beam_of, beam_params
from rbjax.flexible.strain import basis
from rbjax.forces.actuators.transmissions import Transmission
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads
from rbjax.forces.reach import Reach
from rbjax.forces.slopes import Slope
from rbjax.lanes import Lane, Vec3, add, is_zero, mul, neg, sub
from rbjax.lanes import total as total_of
from rbjax.model import Model, State
from rbjax.model.leaves import numbers, scalar


class BeamPath(Transmission):
    """The path of a tendon along a beam. Create it with `of`.

    It is a `Transmission`. For a tension that a controller sets, apply the generalized force
    -T `jacobian`.

    Fields:
        offset: (points, 2) y and z in the section at the Gauss points of the path, m.
        slope: (points, 2) their derivative by s / L, m.
        joint: the name of the beam; static.
        start, end: s / L of the two ends; static.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 0}, mass=0.5)
        >>> model = rb.load("<mujoco/>").with_beam("rod", rod)
        >>> path = rb.flexible.BeamPath.of(model, "rod", [0.1, 0.0])
        >>> round(float(path.length(model, jnp.array([0.5]))), 12)  # 2 (1 - 0.5 * 0.1)
        1.9
    """

    offset: jax.Array
    slope: jax.Array
    joint: str = eqx.field(static=True)
    start: float = eqx.field(static=True, default=0.0)
    end: float = eqx.field(static=True, default=1.0)

    @classmethod
    def of(
        cls, model: Model, joint: str, path: Any, *, start: float = 0.0, end: float = 1.0,
        points: int | None = None,
    ) -> BeamPath:  # fmt: skip
        """Create a path on a beam of a model.

        Args:
            model: the model.
            joint: name of the beam.
            path: (2,) y and z in the section, m, for a tendon parallel to the beam; (k, 2) Legendre
                coefficients of y and z on the beam, m; or a function of s / L that returns (2,).
            start, end: s / L of the ends, with 0 <= start < end <= 1.
            points: the number of Gauss points of the path; by default those of the beam.

        Raises:
            UnknownName: no such joint. InputError: the joint is not a beam, a wrong shape or place.
        """
        beam, _ = beam_of(model, joint, model.gravity.dtype, "BeamPath")
        if not 0 <= start < end <= 1:
            raise InputError(
                f"BeamPath: start is {start!r} and end {end!r}, expected 0 <= start < end <= 1, "
                "places s / L on the beam"
            )
        n = beam.shape.points if points is None else points
        if not isinstance(n, int) or n < 1:
            raise InputError(f"BeamPath: points is {points!r}, expected an integer of at least 1")
        x = start + (end - start) * jnp.asarray(basis.gauss_points(n)[0])
        at, rate = jax.vmap(lambda x: jax.jvp(_place(path), (x,), (jnp.ones_like(x),)))(x)
        dtype = model.gravity.dtype
        return cls(at.astype(dtype), rate.astype(dtype), joint, float(start), float(end))

    def reach(self, context: Context) -> Reach:
        model, dtype = context.model, context.q.dtype
        start, j = model.topology.joint_v[model.joint(self.joint)], model.joint(self.joint)
        first = model.topology.joint_q[j]
        beam, given = beam_params(model, self.joint, dtype, "BeamPath")
        (length,) = given["length"]
        q = [context.q[first + k] for k in range(beam.coordinates)]
        degree = max(len(given.get(f"natural_{k}", ())) for k in ("k_x", "k_y", "k_z"))
        degree = max(degree, *(j for _, j in beam.coefficients))
        nodes, weights = basis.gauss_points(self.offset.shape[0])
        total: Lane = 0.0
        arms: list[Lane] = [0.0] * beam.coordinates
        for g, (x, weight) in enumerate(zip(nodes, weights, strict=True)):
            P = basis.legendre(degree, self.start + (self.end - self.start) * x).tolist()
            curvature, gamma = beam.strain(q, given, P)
            r, slope = (Vec3(0.0, *numbers(y[g], dtype)) for y in (self.offset, self.slope))
            share = mul((self.end - self.start) * weight, length)
            tangent = gamma + curvature.cross(r) + slope * (1.0 / length)
            size = tangent.norm()
            direction = tangent * (share / size)
            total = add(total, mul(share, size))
            moment = r.cross(direction)  # u . (k x r) = k . (r x u)
            by_strain = [*moment, *direction]
            arms = [
                total_of([arm, *(mul(y, by_strain[k]) for k, y in shape.items())])
                for arm, shape in zip(arms, beam.shapes_at(P), strict=True)
            ]
        return Reach(total, {start + k: arm for k, arm in enumerate(arms) if not is_zero(arm)})

    def length(self, model: Model, q: Any) -> jax.Array:
        """Compute the length of the tendon, m, at the configuration q (nq,) of the model."""
        return jnp.asarray(self._at(model, q).length)

    def jacobian(self, model: Model, q: Any) -> jax.Array:
        """Compute dl/dq (nv,), m. A tension T is the generalized force -T dl/dq, for example as the
        input `tau` of `rollout`."""
        arms = self._at(model, q).arms
        return jnp.stack([jnp.asarray(arms.get(n, 0.0)) for n in range(model.nv)])

    def _at(self, model: Model, q: Any) -> Reach:
        q = check_array("BeamPath", "q", q, (model.nq,)).astype(model.gravity.dtype)
        state = State(q, jnp.zeros(model.nv, q.dtype))
        return self.reach(Context.of(model, 0.0, state, None))


class BeamTendon(Element):
    """A tendon along a beam with a constant tension, a spring and a damper. It only pulls.

    f = tension + max(k (l - l_0) + d l', 0) if l > l_0, otherwise f = tension

    For a tension that a controller sets, see `BeamPath.jacobian`.

    Fields:
        path: the path of the tendon.
        tension: N.
        stiffness: k, N/m.
        rest_length: l_0, m.
        damping: d, N s/m.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> rod = rb.flexible.beam(2.0, [0, 0, 6.0, 0, 0, 0], {"k_z": 1}, mass=0.5)
        >>> model = rb.load("<mujoco/>").with_beam("rod", rod)
        >>> tendon = rb.flexible.BeamTendon.of(model, "rod", [0.1, 0.0], tension=30.0)
        >>> tau = rb.applied_forces(model.with_forces(tendon), model.default_state())
        >>> (tau.round(12) + 0.0).tolist()  # T d L on the mean curvature: k = T d / EI = 0.5
        [6.0, 0.0]
    """

    path: BeamPath
    tension: jax.Array
    stiffness: jax.Array
    rest_length: jax.Array
    damping: jax.Array

    @classmethod
    def of(
        cls, model: Model, joint: str, path: Any | Callable, *, tension: Any = 0.0,
        stiffness: Any = 0.0, rest_length: Any = None, damping: Any = 0.0, start: float = 0.0,
        end: float = 1.0, points: int | None = None,
    ) -> BeamTendon:  # fmt: skip
        """Create a tendon on a beam of a model.

        Args:
            model: the model.
            joint, path, start, end, points: see `BeamPath.of`.
            tension: constant tension, N, not below zero.
            stiffness: N/m. damping: N s/m.
            rest_length: m; by default the length in the model's default state.

        Raises:
            UnknownName: no such joint. InputError: as `BeamPath.of`, or a negative value.
        """
        route = BeamPath.of(model, joint, path, start=start, end=end, points=points)
        if rest_length is None:
            rest_length = route.length(model, model.default_state().q)
        dtype = model.gravity.dtype
        given = {"tension": tension, "stiffness": stiffness, "rest_length": rest_length,
                 "damping": damping}  # fmt: skip
        values = {name: jnp.asarray(x, dtype) for name, x in given.items()}
        for name, x in values.items():
            known = not isinstance(x, jax.core.Tracer)
            if x.shape or (known and not float(x) >= 0):
                raise InputError(
                    f"BeamTendon: {name} is {given[name]!r}, expected a number not below zero"
                )
        return cls(route, **values)

    def loads(self, context: Context) -> Loads:
        reach = self._reach(context)
        force = add(scalar(self.tension, context.q.dtype), self._spring(context, reach)[0])
        return Loads({n: neg(mul(arm, force)) for n, arm in reach.arms.items()})

    def slopes(self, context: Context) -> list[Slope]:
        """Compute the stiffness and damping of the spring while it pulls."""
        reach, dtype = self._reach(context), context.q.dtype
        force, pulls = self._spring(context, reach)
        if is_zero(force):
            return []
        k, d = (jnp.where(pulls, scalar(x, dtype), 0.0) for x in (self.stiffness, self.damping))
        return [Slope(reach.arms, k, d)]

    def energy(self, context: Context) -> Lane:
        """Compute T l + k (l - l_0)^2 / 2 while the spring is longer than l_0, J."""
        reach, dtype = self._reach(context), context.q.dtype
        x = jnp.maximum(sub(reach.length, scalar(self.rest_length, dtype)), 0.0)
        spring = mul(mul(0.5, scalar(self.stiffness, dtype)), x * x)
        return add(mul(scalar(self.tension, dtype), reach.length), spring)

    def _reach(self, context: Context) -> Reach:
        return context.once(self, lambda: self.path.reach(context))

    def _spring(self, context: Context, reach: Reach) -> tuple[Lane, Any]:
        """Compute the force of spring and damper, and whether they pull."""
        dtype = context.q.dtype
        k, d, rest = (scalar(x, dtype) for x in (self.stiffness, self.damping, self.rest_length))
        if is_zero(k) and is_zero(d):
            return 0.0, False
        x = jnp.asarray(sub(reach.length, rest), dtype)
        force = add(mul(k, x), mul(d, reach.speed(context)))
        pulls = (x > 0) & (force > 0)
        return jnp.where(pulls, force, 0.0), pulls


def _place(path: Any) -> Callable[[jax.Array], jax.Array]:
    """Return a path as a function of s / L."""
    if callable(path):
        middle = jnp.asarray(path(jnp.asarray(0.5)))
        if middle.shape != (2,):
            raise InputError(
                f"BeamPath: path(s / L) returns the shape {middle.shape}, expected (2,), y and z "
                "in the section, m"
            )
        return lambda x: jnp.asarray(path(x), float)
    rows = jnp.atleast_2d(jnp.asarray(path, float))
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise InputError(
            f"BeamPath: path has the shape {np.shape(path)}, expected (2,), y and z in the "
            "section, m; (k, 2) Legendre coefficients; or a function of s / L"
        )
    degree = rows.shape[0] - 1
    monomials = np.zeros((degree + 1, degree + 1))
    for j, unit in enumerate(np.eye(degree + 1)):
        shifted = Polynomial(legendre.leg2poly(unit))(Polynomial([-1.0, 2.0]))
        monomials[j, : j + 1] = shifted.coef

    def at(x: jax.Array) -> jax.Array:
        powers = jnp.stack([x**k for k in range(degree + 1)])
        return (jnp.asarray(monomials) @ powers) @ rows

    return at
