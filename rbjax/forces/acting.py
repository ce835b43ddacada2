"""The sum of the forces of all elements on a robot.

    M(q) a + b(q, v) = sum of tau_k + sum of J_k^T w_k,      x' = the rates of the elements' states
The elements of a model are the springs and dampers of its joints and tendons, its actuators, and
`model.forces`. All motion functions use these sums; no other file depends on a type of element.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.dynamics.algorithms.rnea import LinkForces, add_forces, wrenches_to_links
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import InputError
from rbjax.forces.actuators.activation import clip
from rbjax.forces.actuators.actuator import Actuator, from_columns
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, check_shapes
from rbjax.forces.inputs import NO_INPUTS, Inputs
from rbjax.forces.joints.polynomials import JointPolynomials, linear_springs
from rbjax.forces.slopes import Slope
from rbjax.forces.tendons.springs import tendon_springs
from rbjax.lanes import Lane, add, is_literal, is_zero, total
from rbjax.lanes.arrays import pack
from rbjax.model import Model, State
from rbjax.model.leaves import table


def elements(model: Model) -> tuple[Element, ...]:
    """List all force elements of a model, in the order of their states in x."""
    springs = (linear_springs(model), *tendon_springs(model))
    return (*springs, *from_columns(model), *model.forces)


def element_contexts(model: Model, context: Context) -> list[tuple[Element, Context]]:
    """Pair each element with a context that contains its own part of x."""
    out, at = [], 0
    for element in elements(model):
        check_shapes(element, model)
        n = element.size
        out.append(
            (element, context.with_own(None if context.x is None else context.x[at : at + n]))
        )
        at += n
    return out


def loads(model: Model, context: Context) -> tuple[list[Lane], LinkForces]:
    """Sum the generalized forces, one lane per dof, and the forces on links."""
    passive, later = Loads(), []
    found = element_contexts(model, context)
    for element, seen in found:
        if element.after_actuators:
            later.append((element, seen))
        elif not element.actuates:
            passive = passive + _given(element, seen)
    driven = _limited(model, _driven(model, found), context)
    for element, seen in later:
        passive = passive + _given(element, replace(seen, driven=driven.tau))
    tau = [add(passive.tau.get(i, 0.0), driven.tau.get(i, 0.0)) for i in range(model.nv)]
    return tau, (passive + Loads({}, driven.wrenches)).wrenches


def _driven(model: Model, found: list[tuple[Element, Context]]) -> Loads:
    """Sum the forces of the actuators, before they are clipped to the force ranges of joints."""
    driven = Loads()
    for element, seen in _actuators(model, found):
        driven = driven + _given(element, seen)
    return driven


def _actuators(model: Model, found: list[tuple[Element, Context]]) -> list[tuple[Element, Context]]:
    """List the actuators with their contexts, which contain the factors of `tendon_scales`."""
    if not found or found[0][1].ctrl is None:
        return []
    scales = tendon_scales(model, found)
    acting = [(e, seen) for e, seen in found if e.actuates and not e.after_actuators]
    return [(e, replace(seen, scales=scales) if scales else seen) for e, seen in acting]


def _given(element: Element, seen: Context) -> Loads:
    found = element.loads(seen)
    if not isinstance(found, Loads):
        raise InputError(
            f"{type(element).__name__}.loads returned {type(found).__name__}, expected Loads: "
            "what FrameState.push and JointState.push return, and sums of these"
        )
    return found


def tendon_scales(model: Model, found: list[tuple[Element, Context]]) -> dict[int, Lane]:
    """Compute, by tendon, the factor that brings the sum of its actuator forces into its range."""
    out: dict[int, Lane] = {}
    if model.tendons is None:
        return out
    sums: dict[int, list[Lane]] = {}
    limits = table(model.tendons.forcerange, found[0][1].q.dtype)
    known = isinstance(limits, np.ndarray)
    for element, seen in found:
        if not isinstance(element, Actuator):
            continue
        i = element.tendon
        if i >= 0 and not (known and bool(np.isinf(limits[i]).all())):
            sums.setdefault(i, []).append(element.force(seen))
    for i, forces in sums.items():
        force = total(forces)
        some = force != 0
        out[i] = jnp.where(some, clip(force, limits, i) / jnp.where(some, force, 1.0), 1.0)
    return out


def _limited(model: Model, driven: Loads, context: Context) -> Loads:
    """Clip the sum of the actuator forces to the force ranges of the joints."""
    top, limits = model.topology, table(model.joints.forcerange, context.v.dtype)
    endless = isinstance(limits, np.ndarray) and bool(np.isinf(limits).all())
    if endless:
        return driven
    tau = _summed(driven, context)
    for j, (joint, at) in enumerate(zip(top.joints, top.joint_v, strict=True)):
        if joint.nv == 1 and not is_zero(tau.get(at, 0.0)):
            tau[at] = clip(tau[at], limits, j)
    return Loads(tau)


def _summed(driven: Loads, context: Context) -> dict[int, Lane]:
    """Sum the generalized forces of actuators by dof, including actuators at sites."""
    if driven.wrenches:
        summed = context.generalized_of(driven.wrenches)
        driven = Loads(driven.tau) + Loads(dict(enumerate(summed)))
    return dict(driven.tau)


def states(model: Model, context: Context, dt: Any = None) -> jax.Array | None:
    """Compute x' (nx,), or x after a step dt if dt is given. Return None if nx is 0."""
    if not model.nx:
        return None
    found: list[Lane] = []
    for element, seen in element_contexts(model, context):
        if element.size:
            own = element.rate(seen) if dt is None else element.advance(seen, dt)
            if len(own) != element.size:
                name = f"{type(element).__name__}.{'rate' if dt is None else 'advance'}"
                raise InputError(f"{name} returned {len(own)} values, expected {element.size}")
            found += list(own)
    return pack(found, context.x)


def slopes(
    model: Model, t: Any, state: State, ctrl: Any, dt: Any = None, *, of: type[Element] = Element
) -> list[Slope]:
    """List the stiffness and damping of all forces, or of the elements of a class.
    An actuator on a joint whose actuator forces are at a limit has none, as in MuJoCo."""
    context = Context.of(model, t, state, ctrl, dt)
    found = element_contexts(model, context)
    out = [x for e, seen in found if isinstance(e, of) and not e.actuates for x in e.slopes(seen)]
    return out + _slopes_of_actuators(model, found, context) if issubclass(Actuator, of) else out


def stable_slopes(
    model: Model, t: Any, state: State, ctrl: Any, dt: Any = None
) -> tuple[list[Slope], list[Slope]]:
    """List the stiffness and damping of all forces, none below zero, for the `discrete` integrator:
    of joint springs, dampers and fluids, then of all others.

    Springs and dampers of a joint are added before a negative sum is replaced by zero. The damping
    of fluids has only their drag.
    """
    context = Context.of(model, t, state, ctrl, dt)
    found = element_contexts(model, context)
    of_dof: dict[int, Slope] = {}
    fluids, others = list[Slope](), list[Slope]()
    for element, seen in found:
        if element.actuates:
            continue
        given = element.dissipative_slopes(seen)
        if not isinstance(element, JointPolynomials):
            for x in given:
                (fluids if x.along is not None else others).append(x)
            continue
        for x in given:
            (i,) = x.arms
            old = of_dof.get(i, Slope({i: 1.0}, 0.0, 0.0))
            k, d = add(old.stiffness, x.stiffness), add(old.damping, x.damping)
            of_dof[i] = Slope({i: 1.0}, k, d)
    others += _slopes_of_actuators(model, found, context)
    positive = ([x.scaled(_not_negative) for x in xs] for xs in (of_dof.values(), others))
    own, rest = positive
    return own + fluids, rest


def _not_negative(x: Lane) -> Lane:
    return max(x, 0.0) if is_literal(x) else jnp.maximum(x, 0.0)


def _slopes_of_actuators(
    model: Model, found: list[tuple[Element, Context]], context: Context
) -> list[Slope]:
    out: list[Slope] = []
    free = _unsaturated(model, found, context)
    for element, seen in _actuators(model, found):
        own = element.slopes(seen)
        at = element.joint if isinstance(element, Actuator) else -1
        if at in free:

            def kept(y: Lane, inside: Lane = free[at]) -> Lane:
                return jnp.where(inside, y, 0.0)

            own = [x.scaled(kept) for x in own]
        out += own
    return out


def _unsaturated(
    model: Model, found: list[tuple[Element, Context]], context: Context
) -> dict[int, Lane]:
    """Return, by joint with a force range, whether the sum of its actuator forces is inside."""
    top, limits = model.topology, table(model.joints.forcerange, context.v.dtype)
    known, driven = isinstance(limits, np.ndarray), None
    out: dict[int, Lane] = {}
    for element, _ in _actuators(model, found):
        j = element.joint if isinstance(element, Actuator) else -1
        if j < 0 or top.joints[j].nv != 1 or (known and bool(np.isinf(limits[j]).all())):
            continue
        driven = driven or _summed(_driven(model, found), context)
        tau = jnp.asarray(driven.get(top.joint_v[j], 0.0), context.v.dtype)
        out[j] = clip(tau, limits, j) == tau
    return out


def within(model: Model, x: jax.Array | None) -> jax.Array | None:
    """Clip the states (nx,) of the elements to their ranges."""
    if x is None or all(type(e).within is Element.within for e in model.forces):
        return x
    found: list[Lane] = []
    at = 0
    for element in model.forces:
        found += list(element.within(x[at : at + element.size]))
        at += element.size
    return pack(found, x)


def applied(
    model: Model,
    t: Any,
    state: State,
    inputs: Inputs = NO_INPUTS,
    dt: Any = None,
    advance: bool = False,
) -> tuple[jax.Array, LinkForces, jax.Array | None]:
    """Compute the generalized forces (nv,), forces on links, and x' of checked arrays.

    dt: step in s that elements read, or None.
    advance: return x after the step instead of x'.
    """
    context = Context.of(model, t, state, inputs.ctrl, dt)
    tau, f_ext = loads(model, context)
    if inputs.tau is not None:
        tau = [add(x, inputs.tau[i]) for i, x in enumerate(tau)]
    if inputs.wrenches is not None:
        given = wrenches_to_links(context.links.driver, context.links.joints, inputs.wrenches)
        f_ext = add_forces(f_ext, given)
    return pack(tau, state.v), f_ext, states(model, context, dt if advance else None)


@algorithm("state", "ctrl", "t")
def applied_forces(
    model: Model, state: State, ctrl: ArrayLike | None = None, t: Any = 0.0
) -> jax.Array:
    """Compute the generalized forces (nv,) of all springs, dampers and actuators of a model and of
    the force elements of `model.forces`.

    tau = -K (q - q_rest) - D v + sum of moment^T f(u, l, l') + sum of tau_k + sum of J_k^T w_k.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))`, with x (nx,) if elements have states.
        ctrl: (nu,) controls, clipped to their ranges; None for no actuation.
        t: time in s, for elements that depend on it.

    Returns:
        (nv,) N m or N, the argument tau of `forward_dynamics`.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite.

    Source: MuJoCo documentation, *Computation*, passive and actuation forces.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> rb.applied_forces(model, model.default_state(), jnp.ones(1)).shape
        (2,)
    """
    if not model.nv:
        return jnp.zeros(0, state.q.dtype)
    context = Context.of(model, t, state, ctrl)
    tau, f_ext = loads(model, context)
    if f_ext:
        summed = context.generalized_of(f_ext)
        tau = [add(x, summed[i]) for i, x in enumerate(tau)]
    return pack(tau, state.v)


@algorithm("q")
def elastic_energy(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the potential energy of the force elements at rest, in J.

    It is the sum of k |q - q_rest|^2 / 2 over the joint springs, and of the energies of the other
    elements.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Returns:
        (), J.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> float(rb.forces.elastic_energy(model, model.default_state().q))
        0.0
    """
    state = State(q, jnp.zeros(model.nv, q.dtype), model.start(q.dtype))
    context = Context.of(model, 0.0, state, None)
    energy = total(element.energy(seen) for element, seen in element_contexts(model, context))
    return jnp.asarray(energy, q.dtype)
