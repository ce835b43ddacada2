"""MuJoCo's `discrete` integrator: springs, dampers and constraint rows act at the end of a step.

    (M + h D + h^2 K) a = tau - b - h K v + J^T f,      v+ = v + h a,      q+ = q (+) h v+

D and K are the damping and stiffness of the forces, without terms that would make the matrix
indefinite: joints, tendons, actuators, and the drag of fluids. The constraint forces f minimise the
cost of soft contact with this matrix in place of M, so they act together with the implicit forces.
A body that floats freely and that no row touches has -d(tau - b)/dv too, as in `implicitfast`. The
step is stable for springs, servos and dampers of any stiffness. The order is 1.

Source: MuJoCo, *Computation*, numerical integration.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.contact.soft import SoftContact
from rbjax.dynamics.algorithms.derivatives import bias_derivative
from rbjax.dynamics.algorithms.energy import Entries, product, velocity_of
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs
from rbjax.forces.slopes import Slope, matrix
from rbjax.lanes import Lane, add, inner, is_zero, mul, pack
from rbjax.model import State
from rbjax.motion.field import Field, free_motion
from rbjax.motion.implicit_velocity import coupled, floating


def step_map(field: Field, t: Any, state: State, u: Inputs, dt: Any) -> State:
    """Advance a state by a step of MuJoCo's `discrete` integrator."""
    soft = isinstance(field.dynamics, SoftContact)
    if not soft and field.dynamics is not free_motion:
        raise InputError(
            "integrator 'discrete' solves contacts and implicit forces together; expected a model "
            f"without a dynamics of its own or contact='mujoco', got {field.dynamics!r}"
        )
    model, q, v = field.precomputed, state.q, state.v
    damped, others = field.stable_slopes(t, state, u, dt)
    added: Entries = matrix([*damped, *others], lambda s: _weight(s, dt))
    tau, f_ext, x = field.step_forces(t, state, u, dt)
    tau = tau - dt * pack(_stiff_forces([*damped, *others], v), v)
    if soft:
        a, error, rows = field.dynamics.step_map(model, t, state, tau, f_ext, dt, added)
    else:
        force = tau - field.bias(state, f_ext)
        a, error, rows = velocity_of(model, q, force, added), None, jnp.zeros_like(v)
    gyroscopic = _gyroscopic(field, state, _coupling(others, rows, dt), dt)
    if gyroscopic:
        places = sorted({*gyroscopic, *added})
        whole = {at: add(gyroscopic.get(at, 0.0), added.get(at, 0.0)) for at in places}
        a = a - velocity_of(model, q, product(gyroscopic, a), whole)
    v = v + dt * a
    return State(field.retract(q, dt * v), v, x, *field.kept(state, error))


def _weight(slope: Slope, dt: Any) -> Lane:
    """Compute h d + h^2 k, the term of the step's matrix from one stiffness and damping."""
    return add(mul(dt, slope.damping), mul(mul(dt, dt), slope.stiffness))


def _stiff_forces(slopes: list[Slope], v: jax.Array) -> list[Lane]:
    """Compute K v (nv lanes), with the stiffness matrix K of the slopes."""
    out: list[Lane] = [0.0] * len(v)
    for slope in slopes:
        if not is_zero(slope.stiffness):
            along = slope.arms if slope.along is None else slope.along
            rate = mul(slope.stiffness, inner(along.values(), [v[i] for i in along]))
            for i, arm in slope.arms.items():
                out[i] = add(out[i], mul(arm, rate))
    return out


def _coupling(slopes: list[Slope], rows: jax.Array, dt: Any) -> list[Lane]:
    """Add 1 to the counts `rows` (nv,) for each implicit force of a tendon or an actuator
    on a dof."""
    out = [rows[i] for i in range(len(rows))]
    for slope in slopes:
        acts = jnp.where(jnp.asarray(_weight(slope, dt)) > 0, 1.0, 0.0).astype(rows.dtype)
        for i in slope.arms:
            out[i] = out[i] + acts
    return out


def _gyroscopic(field: Field, state: State, rows: list[Lane], dt: Any) -> dict:
    """Compute h db/dv of bodies that float freely, by entry; zero if a row or an implicit force
    acts.
    rows: number of rows and forces on each dof."""
    top, out = field.precomputed.topology, dict[tuple[int, int], Lane]()
    turning = floating(top)
    if not turning:
        return out
    bias = bias_derivative(field.precomputed, state.q, state.v)
    for start in (at for at in top.joint_v if at in turning):
        own = range(start, start + 6)
        free = sum(rows[i] for i in own) == 0
        for i, j in coupled(top, own):
            out[i, j] = jnp.where(free, dt * bias[i, j], 0.0)
    return out
