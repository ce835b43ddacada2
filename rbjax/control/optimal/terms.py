"""Terms of costs and constraints: functions of a robot's state and controls.

A term is a function (model, t, state, ctrl) -> a number, or a vector of residuals r. As a cost, a
number is the cost itself, and a vector costs sum w r^2 / 2 (`Cost`). Any function (t, state, ctrl)
or (model, t, state, ctrl) is a term. Standard terms are in this module and in `clearances`. A
reference is a value, or a function t -> value of the time in s.

A cost of residuals is expanded by Gauss-Newton: gradient J^T w r, Hessian J^T w J. A number is
expanded by its gradient and its Hessian.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, integer
from rbjax.control.optimal.system import as_system
from rbjax.dynamics.algorithms.aba import forward_dynamics
from rbjax.dynamics.algorithms.energy import center_of_mass
from rbjax.dynamics.algorithms.frames import frame_pose, frame_velocity
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError
from rbjax.forces.acting import applied_forces
from rbjax.kinematics.arguments import (
    check_bound,
    check_frame,
    check_rotation,
    check_several,
    known_array,
)
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.motion.linearise import box_minus, box_plus
from rbjax.rotations import se3


class Term(Record):
    """A function of a robot's state and controls. Subclasses are final."""

    @property
    def label(self) -> str:
        """The name in messages."""
        return type(self).__name__

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        raise NotImplementedError(f"{type(self).__name__} has no method __call__")


class Given(Term):
    """A term from a function (t, state, ctrl) or (model, t, state, ctrl) of the caller."""

    function: Callable[..., Any]
    takes_model: bool = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @property
    def label(self) -> str:
        return self.name

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        args = (model,) if self.takes_model else ()
        return self.function(*args, t, state, ctrl)


class Cost(Record):
    """A term with its weight.

    term: a `Term`, or a function.
    weight: () or (m,) for m residuals, () for a number; not negative.
    knots: indices of the knots of a running cost; all if None. In a collocation, the stages after a
        knot belong to that knot.
    """

    term: Term
    weight: jax.Array
    knots: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(self, term: Any, weight: Any = 1.0, knots: Any = None) -> None:
        self.term = term_of("Cost", term)
        self.knots = knot_indices_of(f"Cost({self.term.label})", knots)
        self.weight = check_bound(f"Cost({self.term.label})", "weight", weight)
        known = known_array(self.weight)
        if known is not None and ((known < 0).any() or not np.isfinite(known).all()):
            raise InputError(
                f"Cost({self.term.label}): the weight is {known.tolist()}, expected finite "
                "numbers that are not negative"
            )


class Constraint(Record):
    """A constraint low <= term <= high; an equation if both are equal.

    term: a `Term`, or a function.
    low, high: bounds, () or in the shape of the term; infinite for no bound.
    where: "path" (the knots with controls), "end" or "all".
    name: used in messages.
    knots: indices of the knots of the path with the constraint; all if None.
    """

    term: Term
    low: jax.Array
    high: jax.Array
    where: str = eqx.field(static=True)
    name: str = eqx.field(static=True)
    knots: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(
        self, term: Any, low: Any = 0.0, high: Any = 0.0, where: str = "path",
        name: str | None = None, knots: Any = None,
    ) -> None:  # fmt: skip
        self.term = term_of("Constraint", term)
        self.name = self.term.label if name is None else name
        if not isinstance(self.name, str):
            raise InputError(f"Constraint: name is {name!r}, expected a string")
        here = f"Constraint({self.name})"
        self.knots = knot_indices_of(here, knots)
        self.low, self.high = check_bound(here, "low", low), check_bound(here, "high", high)
        self.where = choice(f"where of {here}", where, ("path", "end", "all"))
        lowest, highest = known_array(self.low), known_array(self.high)
        if lowest is not None and highest is not None and (lowest > highest).any():
            raise InputError(
                f"Constraint({self.name}): low {lowest.tolist()} is above high "
                f"{highest.tolist()}; give low <= high"
            )


def term_of(where: str, f: Any) -> Term:
    """Return a term, or convert a function to one."""
    if isinstance(f, Term):
        return f
    if not callable(f):
        raise InputError(
            f"{where}: got {type(f).__name__}, expected a term such as rb.control.StateError(...), "
            "or a function (t, state, ctrl) -> a number or a vector of residuals"
        )
    try:
        kinds = inspect.signature(f).parameters.values()
    except (TypeError, ValueError):
        kinds = None
    count = 3
    if kinds is not None:
        needed = [p for p in kinds if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
                  and p.default is p.empty]  # fmt: skip
        count = len(needed)
    if count not in (3, 4):
        raise InputError(
            f"{where}: {_name(f)} takes {count} arguments, expected (t, state, ctrl) or "
            "(model, t, state, ctrl)"
        )
    return Given(f, count == 4, _name(f))


def knot_indices_of(where: str, knots: Any) -> tuple[int, ...] | None:
    """Return indices of knots as integers; None for all."""
    if knots is None:
        return None
    given = check_several(where, "knots", knots, "indices of knots")
    return tuple(integer(where, "an entry of knots", k, least=0) for k in given)


def cost_of(where: str, given: Any) -> Cost:
    """Return a cost, or convert a term or a function to one with weight 1."""
    return given if isinstance(given, Cost) else Cost(term_of(where, given))


def _name(f: Any) -> str:
    return getattr(f, "__name__", type(f).__name__)


class StateError(Term):
    """State error x (-) reference, (n,): dq on the tangent space, dv, and states of force elements.

    For a wheeled robot it is dq, dv and states of tyres, for `Equations` x - reference.

    reference: a state, or a function t -> state.
    """

    reference: Any

    def __check_init__(self) -> None:
        if isinstance(self.reference, str):
            raise InputError(
                f"StateError: reference is {self.reference!r}, expected a state or a function of "
                "t; a keyframe is model.keyframe(name)"
            )
        check_target("StateError", "reference", self.reference, None)

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        reference = at_time("StateError", self.reference, t)
        due, got = (jax.tree.map(jnp.shape, x) for x in (state, reference))
        if not isinstance(state, State) and got != due:
            raise InputError(f"StateError: the reference has shape {got}, expected {due}")
        if isinstance(reference, State) and reference.x is None and state.x is not None:
            reference = State(reference.q, reference.v, state.x)
        if isinstance(model, Model):
            return box_minus(model, reference, state)
        system = as_system(model)
        if system is None:
            raise InputError(f"StateError: {type(model).__name__} is not a System")
        return system.minus(state, reference)


class Velocity(Term):
    """Velocity v (nv,), m/s or rad/s."""

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return state.v


class Configuration(Term):
    """Configuration q (nq,), for the limits of hinges and slides."""

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return state.q


class Control(Term):
    """Control error u - reference, (nu,).

    reference: (nu,) or (), or a function t -> (nu,).
    """

    reference: jax.Array | Callable[[Any], Any] | float = 0.0

    def __check_init__(self) -> None:
        check_target("Control", "reference", self.reference, None)

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return ctrl - at_time("Control", self.reference, t)


class Effort(Term):
    """Total generalized forces (nv,) of actuators, springs, dampers and elements, N m or N."""

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return applied_forces(model, state, ctrl, t)


class Acceleration(Term):
    """Acceleration v' (nv,) of the dynamics without constraints."""

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return forward_dynamics(model, state.q, state.v, applied_forces(model, state, ctrl, t))


class Jerk(Term):
    """Jerk v'' (nv,) of the dynamics without constraints, for constant controls.

    It is a_q v + a_v a, with the derivatives a_q, a_v of the acceleration a.
    """

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        acceleration = Acceleration()

        def along(h: jax.Array) -> jax.Array:
            a = acceleration(model, t, state, ctrl)
            dx = jnp.concatenate([h * state.v, h * a])
            if state.x is not None:
                dx = jnp.concatenate([dx, jnp.zeros_like(state.x)])
            return acceleration(model, t, box_plus(model, state, dx), ctrl)

        h = jnp.zeros((), state.q.dtype)
        return jax.jvp(along, (h,), (jnp.ones_like(h),))[1]


class CenterOfMass(Term):
    """Center of mass of the robot minus `position`, (3,) m in world axes.

    position: (3,), or a function t -> (3,).
    """

    position: jax.Array | Callable[[Any], Any]

    def __check_init__(self) -> None:
        check_target("CenterOfMass", "position", self.position, (3,))

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return center_of_mass(model, state.q) - at_time("CenterOfMass", self.position, t)


class Pose(Term):
    """Pose error log(T_ref^-1 T) of a site or body, (6,): rotation vector, then translation, m.

    rotation, position: (3, 3) and (3,) m, the reference in the world, or functions of t.
    site, body: the name of the frame; give exactly one of the two.
    """

    rotation: jax.Array | Callable[[Any], Any]
    position: jax.Array | Callable[[Any], Any]
    site: str | None = eqx.field(static=True, default=None)
    body: str | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_frame("Pose", self.site, self.body)
        check_target("Pose", "rotation", self.rotation, (3, 3))
        check_target("Pose", "position", self.position, (3,))
        if not isinstance(self.rotation, jax.ShapeDtypeStruct) and not callable(self.rotation):
            check_rotation("Pose", self.rotation)

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        R, p = frame_pose(model, state.q, self.body, site=self.site)
        R_ref, p_ref = (
            jnp.asarray(at_time("Pose", x, t), p.dtype) for x in (self.rotation, self.position)
        )
        relative = (R_ref[:, :, None] * R[:, None, :]).sum(0)
        return se3.log(se3.pose(relative, (R_ref * (p - p_ref)[:, None]).sum(0)))


class Point(Term):
    """Position of a site or body minus `position`, (3,) m in world axes.

    position: (3,), or a function t -> (3,).
    site, body: the name of the frame; give exactly one of the two.
    """

    position: jax.Array | Callable[[Any], Any]
    site: str | None = eqx.field(static=True, default=None)
    body: str | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_frame("Point", self.site, self.body)
        check_target("Point", "position", self.position, (3,))

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        position = at_time("Point", self.position, t)
        return frame_pose(model, state.q, self.body, site=self.site)[1] - position


class FrameVelocity(Term):
    """Twist of a site or body, (6,): angular rad/s, then linear m/s, in world axes."""

    site: str | None = eqx.field(static=True, default=None)
    body: str | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_frame("FrameVelocity", self.site, self.body)

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return frame_velocity(model, state.q, state.v, self.body, site=self.site)


def at_time(where: str, reference: Any, t: Any) -> Any:
    """Return the value of a reference at the time t."""
    if not callable(reference):
        return reference
    check_takes(where, "the reference", reference, "t")
    return reference(t)


def check_target(where: str, name: str, value: Any, shape: tuple[int, ...] | None) -> None:
    """Raise InputError unless a reference is a function of t, or arrays of finite numbers. The last
    axes of an array must have the given shape (None: any). Leading axes are a batch."""
    if callable(value):
        check_takes(where, f"the {name}", value, "t")
        return
    for given in jax.tree.leaves(value) if shape is None else [value]:
        if isinstance(given, jax.ShapeDtypeStruct):
            continue
        try:
            x = jnp.asarray(given)
        except (TypeError, ValueError) as error:
            got = type(given).__name__
            raise InputError(
                f"{where}: {name} is {got}, expected numbers or a function of t"
            ) from error
        if shape is not None and x.shape[max(0, x.ndim - len(shape)) :] != shape:
            raise InputError(
                f"{where}: {name} has shape {x.shape}, expected {shape} or a function of t"
            )
        known = known_array(x)
        if known is not None and not np.isfinite(known).all():
            raise InputError(
                f"{where}: {name} has numbers that are not finite, expected finite ones"
            )
