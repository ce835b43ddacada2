"""`solve`: acceleration, forces and the report of the solver of a contact law at a state."""

from __future__ import annotations

from typing import Any

from rbjax.arguments import ArrayLike
from rbjax.contact.registry import law_of
from rbjax.contact.solver.solution import ContactSolution
from rbjax.dynamics.arguments import check_model, check_moves
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.forces.acting import applied
from rbjax.forces.inputs import Inputs, Source, inputs_at
from rbjax.model import Model, State
from rbjax.model.record import Record


def solve(
    model: Model,
    state: State,
    ctrl: ArrayLike | Source | None = None,
    *,
    tau: ArrayLike | Source | None = None,
    wrenches: ArrayLike | Source | None = None,
    t: Any = 0.0,
    contact: Any = "mujoco",
    dt: Any = None,
) -> ContactSolution:
    """Solve the contact problem of a law at a state: acceleration, forces, and solver's report.

    Use it to read contact forces, and to check that the solver converges. For "mujoco",
    `rb.acceleration` returns the same acceleration. The problem is

        min over a of  (a - a_s)^T M (a - a_s) / 2 + sum of s_i(J_i a - a_ref,i),
        M a_s = tau(q, v, x, ctrl) + tau_given + J^T w - b

    with the costs s_i of contacts, limits, friction loss and equalities. "coulomb" has the same
    problem with latched friction. The laws "coulomb" and "impulse" advance a velocity: the
    acceleration is (v+ - v) / h, and the forces of "impulse" are impulses over the step, divided by
    h.

    Args:
        model: the robot, with `model.geoms` and `model.solver`, as `rb.load` makes it.
        state: `State(q (nq,), v (nv,))`, with x (nx,) if force elements have states, and with the
            memory of the law, from which its solver begins; None for its first step.
        ctrl: controls (nu,); None for no actuation.
        tau: generalized forces (nv,) in addition to those of the model.
        wrenches: (nb, 6) [moment N m; force N] on bodies, in world axes at their origins. Each of
            ctrl, tau and wrenches may be a function (t, state).
        t: time in s, for force elements that depend on it.
        contact: a name of `rb.contact.laws()`, or a law with its arguments.
        dt: step h in s; None for the step of the law, or the model's timestep.

    Returns:
        `ContactSolution`. Batches by `jax.vmap`: over the states of a trajectory, saved at each
        step, it gives iterations and error of each step. It has derivatives in forward and
        reverse mode; those of the acceleration are implicit.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, an unknown law, a model
            without joints or without contact parameters.

    Source: Todorov, *Convex and analytically-invertible dynamics with contacts and constraints*,
    2014; MuJoCo, *Computation*, constraint model.

    Example:
        >>> import rbjax as rb
        >>> ball = '''<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.0999">
        ...     <freejoint/><geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>'''
        >>> model = rb.load(ball, contacts=True)
        >>> found = rb.contact.solve(model, model.default_state())
        >>> bool(found.success), int(found.contacts.exists.sum())
        (True, 1)
    """
    given = inputs_at("contact.solve", model, Inputs(ctrl, tau, wrenches), t, state)
    check_model("contact.solve", model)
    check_moves("contact.solve", model)
    law = law_of("contact.solve", model, contact)
    if isinstance(law, Record):  # its numbers may be traced
        return _solve(model, state, *given, t=t, dt=dt, law=law)
    return _solve(model, state, *given, t=t, dt=dt, contact=law)


@algorithm("state", "ctrl", "tau", "wrenches", "t", "dt", where="contact.solve", long=True)
def _solve(
    model: Model, state: State, ctrl: Any = None, tau: Any = None, wrenches: Any = None,
    *, t: Any = 0.0, dt: Any = None, contact: Any = None, law: Any = None,
) -> ContactSolution:  # fmt: skip
    law = contact if law is None else law
    own, f_ext, _ = applied(model, t, state, Inputs(ctrl, tau, wrenches))
    return law.solve(model, t, state, own, f_ext, dt)
