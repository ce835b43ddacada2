"""`sense`: the readings of the sensors of a model."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike, flag
from rbjax.constraints.formulation import Formulation
from rbjax.dynamics.arguments import check_array
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.inputs import Inputs, Source, inputs_at
from rbjax.model import Model, State
from rbjax.motion.field import (
    Dynamics,
    VelocityDynamics,
    dynamics_of,
    free_motion,
    with_contact,
)
from rbjax.motion.trajectory import Trajectory
from rbjax.sensors.solution import with_solution


def sense(
    model: Model,
    state: State | Trajectory,
    ctrl: ArrayLike | Source | None = None,
    *,
    named: bool = False,
    tau: ArrayLike | Source | None = None,
    wrenches: ArrayLike | Source | None = None,
    t: Any = 0.0,
    dynamics: Dynamics | VelocityDynamics = free_motion,
    constraints: str | Formulation | None = None,
    contact: Any = None,
    dt: Any = None,
) -> Any:
    """Return the readings of all sensors of a model, as MuJoCo's sensordata.

    Use it for observations of a policy, for a logged motion, and to compare with measurements. The
    readings are those of `model.sensors`, in their order, with their cutoff and without noise.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))`, with x (nx,) if force elements have states; or a
            `Trajectory`, whose times are used as t.
        ctrl: controls (nu,); None for no actuation. For a trajectory of T states one row a state,
            (T, nu), or one row less, as in `rollout`: the last row is repeated.
        named: return a dict, name of the sensor -> its values.
        tau: generalized forces (nv,) in addition to those of the model.
        wrenches: (nb, 6) [moment N m; force N] on bodies, in world axes at their origins. Each of
            ctrl, tau and wrenches may be a function (t, state).
        t: time in s.
        dynamics: map from forces to accelerations, or to the velocity after a step
            (`rbjax.motion.field.Dynamics`, `VelocityDynamics`), for sensors of accelerations and
            forces.
        constraints: how to enforce the constraints of the model, as in `rollout`.
        contact: law of contact, a name of `rbjax.contact.laws`; None for the law of the model. The
            laws "coulomb" and "impulse" give the mean acceleration and the mean forces of the step
            that begins at the state, with its memory (`State.memory`).
        dt: step in s of force elements and contact laws; None for the model's timestep.

    Returns:
        (n,), or (T, n) and (B, T, n) for a trajectory; with `named`, a dict of such arrays.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite.

    Source: MuJoCo documentation, *XML reference*, sensor.

    Example:
        >>> import rbjax as rb
        >>> arm = rb.load("arm7")
        >>> arm = arm.replace(sensors=(rb.sensors.NamedSensor("spin", rb.sensors.Gyro("tool")),))
        >>> rb.sense(arm, arm.default_state(), named=True)["spin"].shape
        (3,)
    """
    flag("sense", "named", named)
    how: dict[str, Any] = {"dynamics": dynamics, "constraints": constraints, "contact": contact}
    how["dt"] = dt
    if isinstance(state, Trajectory):
        values = _along(model, state, Inputs(ctrl, tau, wrenches), how)
    else:
        given = inputs_at("sense", model, Inputs(ctrl, tau, wrenches), t, state)
        values = _sense(model, state, *given, t=t, **how)
    return _by_name(model, values) if named else values


@algorithm("state", "ctrl", "tau", "wrenches", "t", "dt", where="sense", long=True)
def _sense(
    model: Model, state: State, ctrl: Any = None, tau: Any = None, wrenches: Any = None,
    *, t: Any = 0.0, dynamics: Any = free_motion, constraints: Any = None, contact: Any = None,
    dt: Any = None,
) -> jax.Array:  # fmt: skip
    if not model.sensors:
        return jnp.zeros(0, state.q.dtype)
    dynamics = with_contact("sense", model, dynamics, contact)
    dynamics = dynamics_of("sense", model, dynamics, constraints, steps=True)
    context, inputs = Context.of(model, t, state, ctrl, dt), Inputs(ctrl, tau, wrenches)
    context = with_solution(context, inputs, dynamics, state.memory)
    return jnp.concatenate([sensor(context) for sensor in model.sensors])


def _along(model: Model, path: Trajectory, inputs: Inputs, how: dict[str, Any]) -> jax.Array:
    """Return the readings (T, n) or (B, T, n) along a trajectory."""
    states, count = State(path.q, path.v, path.x, path.memory), path.ts.shape[0]
    ctrl = inputs.ctrl
    if ctrl is not None and not callable(ctrl):
        batch = path.q.shape[:-2]
        few, many = (*batch, count - 1, model.nu), (*batch, count, model.nu)
        ctrl = check_array("sense", "ctrl", ctrl, many, few, (model.nu,))
        if ctrl.shape == few != many:
            ctrl = jnp.concatenate([ctrl, ctrl[..., -1:, :]], -2)
        ctrl = jnp.broadcast_to(ctrl, many)
    for name, x in (("tau", inputs.tau), ("wrenches", inputs.wrenches)):
        if x is not None and not callable(x) and jnp.ndim(x) != (1 if name == "tau" else 2):
            raise InputError(
                f"sense: {name} along a trajectory has shape {jnp.shape(x)}, expected a constant "
                "or a function (t, state)"
            )

    def one(t: Any, state: State, u: Any) -> jax.Array:
        source = ctrl if callable(ctrl) else u
        return sense(model, state, source, tau=inputs.tau, wrenches=inputs.wrenches, t=t, **how)

    rows = None if callable(ctrl) else ctrl
    each = jax.vmap(one)
    if path.q.ndim == 3:
        each = jax.vmap(each, in_axes=(None, 0, 0))
    return each(path.ts, states, rows)


def _by_name(model: Model, values: jax.Array) -> dict[str, jax.Array]:
    """Split readings (..., n) by sensor."""
    sizes = [sensor.columns(model).size for sensor in model.sensors]
    pairs = zip(model.sensors, sizes, itertools.accumulate(sizes), strict=True)
    return {sensor.name: values[..., end - size : end] for sensor, size, end in pairs}
