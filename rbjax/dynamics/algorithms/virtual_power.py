"""The virtual power of inertial forces, whose gradient is the derivative of inverse dynamics.

For virtual joint rates l, with the virtual twists V* = J l of the links,

    P = l.ID(q, v, a) = sum of V*.(I a + [w x J w; w x (w x h)] - f_ext) + l.(armature a) over links

which one outward sweep computes. The vector-Jacobian product of inverse dynamics is its gradient,
(dID/dx)^T l = dP/dx. A flexible link then needs its motion along l, v and a, but not the axes of
each of its frames for each of its coordinates (Jourdain's principle of virtual power).
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
from rbjax.joints.joint import Block
from rbjax.lanes import Lane, Vec3, add, inner, mul
from rbjax.model import Model
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
) -> Lane:
    """Compute the virtual power of the forces of `rnea`.
    joints: `d.joints(q, v, a, l)`. accelerations, rates: of joints, and virtual, per link."""

    def outward(x: Any, parent: VirtualStep) -> tuple[VirtualStep, Lane]:
        link, joint, qdd, rate, f_ext = x
        X = joint.transform(link)
        w, bias = velocity_bias(joint, X, parent.w)
        relative, block = joint.accelerate(qdd, parent.accelerations)
        turn, rates = joint.virtual(rate, parent.rates)
        a, V = X(parent.a) + bias + relative, X(parent.V) + turn
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
    xs = d.zip(d.constants, joints, accelerations, rates, per_link(d, f_ext))
    return d.total(d.outward(outward, root, xs))


def with_gradient_of_power(
    rnea: Callable, model: Model, q: jax.Array, v: jax.Array, a: jax.Array, f_ext: LinkForces | None
) -> jax.Array:
    """Compute the generalized forces (nv,) of `rnea`, with the gradient of the virtual power as
    reverse derivative."""
    given, rebuilt = split_tracers((model, f_ext))
    args = jax_arrays(*given, q, v, a)

    def forces(*args: jax.Array) -> list[jax.Array]:
        *changed, q, v, a = args
        model, f_ext = rebuilt(changed)
        d = driver(model, q.dtype)
        return [d.pack(rnea(d, d.joints(q, v), d.lanes(a), d.prepared.gravity, f_ext), v)]

    def vjp(moving: tuple[bool, ...], args: Any, _: Any, bars: Any) -> list[jax.Array]:
        (rates,) = bars

        def power(*moved: jax.Array) -> Lane:
            rest = iter(moved)
            *changed, q, v, a = (next(rest) if m else x for m, x in zip(moving, args, strict=True))
            model, f_ext = rebuilt(changed)
            d = driver(model, q.dtype)
            joints, lanes = d.joints(q, v, a, rates), (d.lanes(a), d.lanes(rates))
            return virtual_power(d, joints, *lanes, d.prepared.gravity, f_ext)

        value, back = jax.vjp(power, *itertools.compress(args, moving))
        return list(back(jnp.ones_like(value)))

    avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in args]
    return run(Program(traced(forces, *avals).closed, vjp=vjp), args)[0]
