"""The virtual power of inertial forces, whose gradient is the derivative of inverse dynamics.

For virtual joint rates l, with the virtual twists V* = J l of the links,

    P = l.ID(q, v, a) = sum of V*.(I a + [w x J w; w x (w x h)] - f_ext) + l.(armature a) over links

which one outward sweep computes. The vector-Jacobian product of inverse dynamics is its gradient,
(dID/dx)^T l = dP/dx. A flexible link then needs its motion along l, v and a, but not the axes of
each of its frames for each of its coordinates (Jourdain's principle of virtual power).

In a chain of slender beams the linear motion of a link is a small difference of large terms w' x r.
A sweep from the joint accelerations of ABA has other rounding errors in it than ABA. The gradient
therefore uses the motions of the links from ABA, if they are given. In float32 it is then as
accurate as the joint accelerations.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiler.jax.primitive import run
from rbjax.compiler.jax.programs import Program, traced
from rbjax.dynamics.algorithms.kinematics import LinkForces, per_link, velocity_bias
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.custom_rules import jax_arrays, split_tracers
from rbjax.joints.flexible import CoordinateDof
from rbjax.joints.joint import Block
from rbjax.lanes import Lane, Vec3, add, inner, is_literal, mul
from rbjax.model import Model, Topology
from rbjax.spatial import Motion


class VirtualStep(NamedTuple):
    """The motion of a link: angular velocity, acceleration, virtual twist, and the accelerations
    and virtual rates of the coordinates of the flexible link to which it belongs."""

    w: Vec3
    a: Motion
    V: Motion
    accelerations: Block
    rates: Block


def virtual_power(
    d: Driver,
    joints: Any,
    accelerations: Any,
    rates: Any,
    gravity: Vec3,
    f_ext: LinkForces | None = None,
    known: Any = None,
) -> Lane:
    """Compute the virtual power of the forces of `rnea`.

    joints: `d.joints(q, v, a, l)`.
    accelerations, rates: joint accelerations a and virtual rates l, per link.
    known: `motions_of` of the accelerations and of the virtual twists of the links. They replace
        the values of the sweep, but not its derivatives.
    """

    def outward(x: Any, parent: VirtualStep) -> tuple[VirtualStep, Lane]:
        link, joint, qdd, rate, f_ext, *known = x
        X = joint.transform(link)
        w, bias = velocity_bias(joint, X, parent.w)
        relative, block = joint.accelerate(qdd, parent.accelerations)
        turn, rates = joint.virtual(rate, parent.rates)
        a, V = X(parent.a) + bias + relative, X(parent.V) + turn
        if known:
            a, V = with_derivatives_of(a, known[0]), with_derivatives_of(V, known[1])
        inertia = joint.inertia(link)
        f = inertia(a) + inertia.bias_force(w) - f_ext
        power = add(V.dot(f), mul(link.armature, mul(qdd, rate)))
        power = add(power, joint.virtual_power(parent.w, parent.a, parent.V))
        own = joint.link_inertia(w)
        if own is not None:
            wrench, forces = own.inertial_forces(w, a, block)
            power = add(power, add(V.dot(wrench), inner(rates, forces)))
        return VirtualStep(w, a, V, block, rates), power

    zero = Motion.zero()
    root = VirtualStep(Vec3.zero(), Motion(Vec3.zero(), -gravity), zero, (), ())
    more = () if known is None else known
    xs = d.zip(d.constants, joints, accelerations, rates, per_link(d, f_ext), *more)
    return d.total(d.outward(outward, root, xs))


def links_in_motion(top: Topology) -> list[int]:
    """Return the links with a motion of their own: the dofs, without the coordinates of flexible
    links after the first."""
    kinds = [dof.kind for dof in top.dofs]
    return [i for i, x in enumerate(kinds) if not (isinstance(x, CoordinateDof) and x.k)]


def motions_of(d: Driver, rows: jax.Array) -> Any:
    """Return rows (6, links) of `links_in_motion` as six lanes per link. Other links get zeros."""
    links = links_in_motion(d.topology)
    return d.zip(*(d.lanes(x, links) for x in rows))


def rows_of_motions(d: Driver, motions: Any, like: jax.Array) -> jax.Array:
    """Return the motion of each link as rows (6, links) of `links_in_motion`."""
    links = links_in_motion(d.topology)
    lanes = jax.tree.map(tuple, motions, is_leaf=lambda x: isinstance(x, Motion))
    return jnp.stack([d.pack(x, like, links) for x in d.unzip(lanes, 6)])


def with_derivatives_of(own: Motion, known: Any) -> Motion:
    """Return the values of `known` with the derivatives of `own`.

    A lane that is a literal in either keeps the value of `own`.
    """

    def lane(x: Lane, y: Lane) -> Lane:
        return x if is_literal(x) or is_literal(y) else _with_derivative_of(x, y)

    return Motion.from_lanes([lane(x, y) for x, y in zip(own, known, strict=True)])


@jax.custom_jvp
def _with_derivative_of(own: jax.Array, value: jax.Array) -> jax.Array:
    return value


@_with_derivative_of.defjvp
def _rule(at: tuple, along: tuple) -> tuple[jax.Array, jax.Array]:
    return _with_derivative_of(*at), along[0]


def with_gradient_of_power(
    rnea: Callable,
    model: Model,
    q: jax.Array,
    v: jax.Array,
    a: jax.Array,
    f_ext: LinkForces | None,
    links: jax.Array | None = None,
) -> list[jax.Array]:
    """Compute the generalized forces (nv,) of `rnea`, with the gradient of the virtual power as
    reverse derivative.

    links: accelerations (6, links) of `links_in_motion` from ABA. The second result is then zero,
        of the same shape. Its cotangents are the virtual twists of these links.
    """
    given, rebuilt = split_tracers((model, f_ext))
    known = () if links is None else (links,)
    args = jax_arrays(*given, q, v, a, *known)
    first = len(given)

    def forces(*args: jax.Array) -> list[jax.Array]:
        model, f_ext = rebuilt(list(args[:first]))
        q, v, a, *known = args[first:]
        d = driver(model, q.dtype)
        tau = d.pack(rnea(d, d.joints(q, v), d.lanes(a), d.prepared.gravity, f_ext), v)
        return [tau, *map(jnp.zeros_like, known)]

    def vjp(moving: tuple[bool, ...], args: Any, _: Any, bars: Any) -> list[jax.Array]:
        rates, *twists = bars

        def power(*moved: jax.Array) -> Lane:
            rest = iter(moved)
            every = [next(rest) if m else x for m, x in zip(moving, args, strict=True)]
            model, f_ext = rebuilt(every[:first])
            q, v, a, *known = every[first:]
            d = driver(model, q.dtype)
            joints, lanes = d.joints(q, v, a, rates), (d.lanes(a), d.lanes(rates))
            motions = None
            if known and twists[0] is not None:
                motions = [motions_of(d, x) for x in (*known, *twists)]
            return virtual_power(d, joints, *lanes, d.prepared.gravity, f_ext, motions)

        value, back = jax.vjp(power, *itertools.compress(args, moving))
        return list(back(jnp.ones_like(value)))

    avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args]
    return run(Program(traced(forces, *avals).closed, vjp=vjp), args)
