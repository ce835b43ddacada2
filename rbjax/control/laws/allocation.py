"""Allocation of generalized forces to the controls of a model's actuators.

    tau_a(u) = b(q, v) + B(q, v) u            u = B^+ (tau - b)

Actuators without a state have forces that are affine in their controls, up to their limits. B
contains moment arms times gains. b contains the biases of servos and the gravity compensation of a
model file.
Source: MuJoCo, *Computation*, actuation model; Siciliano et al., *Robotics*, 8.1.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, choice
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_array, check_arrays, check_model
from rbjax.errors import InputError
from rbjax.forces import applied_forces
from rbjax.forces.acting import element_contexts
from rbjax.forces.actuators.actuator import Actuator, GainBias
from rbjax.forces.context import Context
from rbjax.forces.element import Loads
from rbjax.lanes import Lane, add, inner, is_zero, ldlt, sub
from rbjax.model import Model, State
from rbjax.rank_tolerances import rank_tolerance

#: options for forces that the actuators cannot produce
UNDRIVEN = ("refuse", "least_squares")


@displayed
class Allocation(NamedTuple):
    """Result of `allocate`.

    ctrl: controls within the control ranges, (nu,).
    residual: requested forces minus actuator forces, (nv,), N m or N.
    """

    ctrl: jax.Array
    residual: jax.Array


def allocate(model: Model, state: State, tau: ArrayLike) -> Allocation:
    """Compute controls whose actuator forces are the generalized forces tau, or the nearest ones.

        u = B^+ (tau - b), clipped to the control ranges.

    Args:
        model: the robot, with actuators without states.
        state: `State(q (nq,), v (nv,))`.
        tau: (nv,) N m or N, desired total force of the actuators.

    Returns:
        `Allocation(ctrl (nu,), residual (nv,))`.

    Raises:
        InputError: an actuator with a state or with a force that is not affine in its control;
            wrong shapes.

    Source: MuJoCo documentation, *Computation*, actuation model.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> found = rb.control.allocate(model, model.default_state(), jnp.array([2.0, 1.0]))
        >>> found.residual.tolist()
        [0.0, 1.0]
    """
    check_model("allocate", model)
    check_actuators("allocate", model)
    tau = check_array("allocate", "tau", tau, (model.nv,))
    state = check_arrays("allocate", model, {"state": state})["state"]
    ctrl = controls(model, state, tau)
    limits = model.actuators.ctrlrange.astype(ctrl.dtype)
    for element in model.forces:
        if isinstance(element, Actuator):
            rows = np.array(element.controls)
            limits = limits.at[rows].set(element.ctrlrange.astype(ctrl.dtype))
    ctrl = jnp.clip(ctrl, limits[:, 0], limits[:, 1])
    given = applied_forces(model, state, ctrl) - applied_forces(model, state, None)
    return Allocation(ctrl, tau - given)


def controls(model: Model, state: State, tau: jax.Array) -> jax.Array:
    """Return the controls u (nu,) of `allocate` before clipping to the control ranges."""
    dtype = jnp.result_type(state.q, tau)
    if not model.nu:
        return jnp.zeros(0, dtype)
    b, B = effect(model, state)
    rest = [sub(tau[n], b[n]) for n in range(model.nv)]
    own = [[n for n in range(model.nv) if not is_zero(column[n])] for column in B]
    if all(len(n) == 1 for n in own) and len({n[0] for n in own}) == len(own):
        out = [rest[n] / column[n] for (n,), column in zip(own, B, strict=True)]
        return jnp.stack([jnp.asarray(x, dtype) for x in out])
    return _least_squares(B, rest, dtype)


def _least_squares(B: list[list[Lane]], r: list[Lane], dtype: Any) -> jax.Array:
    """Return the minimum-norm u among the minimizers of |B u - r|, for the columns of B.

    A minimizer u of the normal equations is projected to the row space of B. The result is B^T y
    with B B^T y = B u.
    """
    least = rank_tolerance("actuators", dtype)
    columns = B

    def square(rows: list[list[Lane]]) -> list[list[Lane]]:
        return [[inner(a, b) for b in rows[: i + 1]] for i, a in enumerate(rows)]

    u = ldlt(square(columns), least=least).solve([inner(c, r) for c in columns])
    rows = [list(row) for row in zip(*columns, strict=True)]
    given = [inner(row, u) for row in rows]
    y = ldlt(square(rows), least=least).solve(given)
    return _stack([inner(c, y) for c in columns], dtype)


def effect(model: Model, state: State) -> tuple[list[Lane], list[list[Lane]]]:
    """Return the bias b and the matrix B of the actuator forces tau = b + B u.

    b is nv lanes, B nv lanes for each control. Structural zeros of B are the literal 0.0.
    """
    free = _unlimited(model)
    context = Context.of(free, 0.0, state, None)
    zero, one = (jnp.asarray(x, state.q.dtype) for x in (0.0, 1.0))

    def at(u: list) -> list[Lane]:
        given = Loads()
        driven = dataclasses.replace(context, ctrl=u, found={})
        for element, seen in element_contexts(free, driven):
            if element.actuates:
                given = given + element.loads(seen)
        tau = [given.tau.get(n, 0.0) for n in range(model.nv)]
        if given.wrenches:
            summed = context.generalized_of(given.wrenches)
            tau = [add(x, summed[n]) for n, x in enumerate(tau)]
        return tau

    b = at([zero] * model.nu)
    reached = _structure(free)
    B = []
    for i in range(model.nu):
        shifted = at([one if k == i else zero for k in range(model.nu)])
        B.append([sub(x, y) if n in reached[i] else 0.0
                  for n, (x, y) in enumerate(zip(shifted, b, strict=True))])  # fmt: skip
    return b, B


def _structure(model: Model) -> list[set[int]]:
    """Return, for each control, the set of dofs on which it may have an effect."""
    top = model.topology
    elements = {i for e in model.forces if e.actuates for i in getattr(e, "controls", ())}
    out = []
    for i, j in enumerate(model.actuators.joints):
        start, stop = 0, model.nv
        if j >= 0 and i not in elements:
            start, stop = top.joint_v[j], top.joint_v[j] + top.joints[j].nv
        out.append(set(range(start, stop)))
    return out


def _unlimited(model: Model) -> Model:
    """Return the model with unlimited actuators, whose forces are affine in the controls."""
    endless = np.array([-np.inf, np.inf])

    def wide(record: Any, *names: str) -> Any:
        changes = {n: np.broadcast_to(endless, getattr(record, n).shape) for n in names}
        return record.replace(**changes)

    elements = tuple(
        wide(e, "ctrlrange", "forcerange") if isinstance(e, Actuator) else e for e in model.forces
    )
    actuators = wide(model.actuators, "ctrlrange", "forcerange")
    return model.replace(actuators=actuators, forces=elements)


def check_actuators(where: str, model: Model) -> None:
    """Raise InputError if an actuator has a state or a force that is not affine in its control."""
    for element in model.forces:
        if not element.actuates:
            continue
        law = getattr(element, "law", None)
        controls = getattr(element, "controls", ())
        plain = isinstance(element, Actuator) and isinstance(law, GainBias) and not law.circular
        if (controls and not plain) or element.size:
            names = ", ".join(repr(model.actuator_names[i]) for i in controls) or "a force"
            kind = type(law).__name__ if law is not None else type(element).__name__
            raise InputError(
                f"{where}: {names} ({kind}) has a state or is not affine in its control, so no "
                "control gives a force at once; apply the forces themselves, as "
                "rollout(..., tau=law.tau)"
            )


def check_driven(where: str, model: Model, undriven: str) -> None:
    """Raise InputError if no actuator drives some dof, unless `undriven` is "least_squares". Models
    with traced parameters are not checked."""
    choice(f"undriven of {where}", undriven, UNDRIVEN)
    check_actuators(where, model)
    known = not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(model))
    if undriven == "least_squares" or not known:
        return
    B = _generic(model)
    rank = int(np.linalg.matrix_rank(B)) if B.size else 0
    if rank == model.nv:
        return
    top = model.topology
    still = [
        name
        for name, start, joint in zip(top.joint_names, top.joint_v, top.joints, strict=True)
        if not B[start : start + joint.nv].any()
    ]
    which = "nothing drives " + ", ".join(map(repr, still)) if still else (
        f"{model.nu} actuators drive only {rank} of {model.nv} coordinates"
    )  # fmt: skip
    raise InputError(
        f"{where}: {which}; give the model actuators (load(motors=True) for a URDF), or pass "
        "undriven='least_squares' for the nearest forces, whose rest `law.allocated` returns; or "
        "apply the forces themselves, as rollout(..., tau=law.tau)"
    )


def _generic(model: Model) -> np.ndarray:
    """Return a matrix (nv, nu) with the sparsity and the rank of B, to find dofs without an
    actuator. It is B at a random state, or gears times gains if all actuators are at joints with
    one dof."""
    top, a = model.topology, model.actuators
    if not any(e.actuates for e in model.forces) and all(
        j >= 0 and top.joints[j].nv == 1 for j in a.joints
    ):
        B = np.zeros((model.nv, model.nu))
        strong = np.asarray(a.gear)[:, 0] * np.asarray(a.gain).any(1)
        B[[top.joint_v[j] for j in a.joints], range(model.nu)] = strong
        return B
    with jax.ensure_compile_time_eval():
        state = model.random_state(jax.random.key(0))
        columns = [[float(x) for x in column] for column in effect(model, state)[1]]
    return np.array(columns).reshape(model.nu, model.nv).T


def _stack(x: list[Lane], dtype: Any) -> jax.Array:
    return jnp.stack([jnp.asarray(a, dtype) for a in x])
