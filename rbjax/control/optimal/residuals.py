"""Standard residuals: state, velocity, control, frames, centre of mass, effort, jerk.

Each is a `Term`: a vector r of a state and controls that a cost squares or a constraint bounds.
A reference is a value, or a function t -> value of the time in s: a moving reference.

    state          dx = x (-) x_ref on the tangent space
    pose           log(T_ref^-1 T): the rotation vector, then the translation part
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.control.optimal.system import as_system
from rbjax.control.optimal.terms import Term
from rbjax.dynamics.algorithms.energy import center_of_mass
from rbjax.dynamics.algorithms.forward import forward_dynamics
from rbjax.dynamics.algorithms.frames import frame_pose, frame_velocity
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError
from rbjax.forces.acting import applied_forces
from rbjax.kinematics.arguments import check_rotation, known_array
from rbjax.model import Model, State
from rbjax.motion.linearise import box_minus, box_plus
from rbjax.rotations import se3


class StateError(Term):
    """x (-) reference, (n,): dq on the tangent space, dv, and states of force elements. For a
    wheeled robot dq, dv and states of tyres. For `Equations` x - reference.

    Fields: reference, a state; or a function t -> state.
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
    """v (nv,), m/s or rad/s."""

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return state.v


class Configuration(Term):
    """q (nq,): what the limits of hinges and slides bound."""

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return state.q


class Control(Term):
    """u - reference, (nu,).

    Fields: reference, (nu,) or (); or a function t -> (nu,).
    """

    reference: jax.Array | Callable[[Any], Any] | float = 0.0

    def __check_init__(self) -> None:
        check_target("Control", "reference", self.reference, None)

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return ctrl - at_time("Control", self.reference, t)


class Effort(Term):
    """The generalized forces (nv,) of all that acts: actuators, springs, dampers, elements; N m."""

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return applied_forces(model, state, ctrl, t)


class Acceleration(Term):
    """v' (nv,) of free motion."""

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return forward_dynamics(model, state.q, state.v, applied_forces(model, state, ctrl, t))


class Jerk(Term):
    """v'' (nv,) of free motion, the controls held: d/dt a(q, v, u) = a_q v + a_v a."""

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
    """The centre of mass of the robot minus `position`, (3,) m in world axes.

    Fields: position (3,); or a function t -> (3,).
    """

    position: jax.Array | Callable[[Any], Any]

    def __check_init__(self) -> None:
        check_target("CenterOfMass", "position", self.position, (3,))

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return center_of_mass(model, state.q) - at_time("CenterOfMass", self.position, t)


class Pose(Term):
    """log(T_ref^-1 T) of a site or body, (6,): the rotation vector, then the translation part in m.

    Fields: rotation (3, 3) and position (3,) of the reference in the world, or functions of t that
    return these; site or body, a name.
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
    """The position of a site or body minus `position`, (3,) m in world axes.

    Fields: position (3,); or a function t -> (3,); site or body, a name.
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
    """The twist of a site or body, (6,): angular rad/s, then linear m/s, in world axes."""

    site: str | None = eqx.field(static=True, default=None)
    body: str | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_frame("FrameVelocity", self.site, self.body)

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        return frame_velocity(model, state.q, state.v, self.body, site=self.site)


def at_time(where: str, reference: Any, t: Any) -> Any:
    """The value of a reference at the time t."""
    if not callable(reference):
        return reference
    check_takes(where, "the reference", reference, "t")
    return reference(t)


def check_target(where: str, name: str, value: Any, shape: tuple[int, ...] | None) -> None:
    """Reject a reference that is neither a function of t nor arrays with these last axes."""
    if callable(value):
        check_takes(where, f"the {name}", value, "t")
        return
    for x in jax.tree.leaves(value) if shape is None else [value]:
        if not isinstance(x, jax.ShapeDtypeStruct):
            check_reference(where, name, x, shape)


def check_reference(where: str, name: str, value: Any, shape: tuple[int, ...] | None) -> None:
    """`InputError` unless value is an array, finite if known, whose last axes have a shape (None:
    any). Leading axes are those of a batch."""
    try:
        x = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{where}: {name} is {type(value).__name__}, expected numbers or a function of t"
        ) from error
    if shape is not None and x.shape[max(0, x.ndim - len(shape)) :] != shape:
        raise InputError(
            f"{where}: {name} has shape {x.shape}, expected {shape} or a function of t"
        )
    known = known_array(x)
    if known is not None and not np.isfinite(known).all():
        raise InputError(f"{where}: {name} has numbers that are not finite, expected finite ones")


def check_frame(where: str, site: Any, body: Any) -> None:
    """Raise unless exactly one of a site and a body is given."""
    if (site is None) == (body is None):
        raise InputError(f"{where}: got site={site!r} and body={body!r}, expected one of them")
    if not isinstance(body if site is None else site, str):
        raise InputError(f"{where}: got site={site!r} and body={body!r}, expected a name")
