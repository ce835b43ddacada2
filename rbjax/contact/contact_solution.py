"""`solve`: acceleration, forces and the solver's report of soft contact at a state."""

from __future__ import annotations

from typing import Any

import jax

from rbjax.contact.registry import law_of
from rbjax.contact.soft import SoftContact
from rbjax.contact.solution import ContactSolution
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import InputError
from rbjax.forces.acting import applied
from rbjax.forces.inputs import Inputs, Source, inputs_at
from rbjax.model import Model, State


def solve(
    model: Model,
    state: State,
    ctrl: jax.Array | Source | None = None,
    *,
    tau: jax.Array | Source | None = None,
    wrenches: jax.Array | Source | None = None,
    t: Any = 0.0,
    contact: Any = "mujoco",
) -> ContactSolution:
    """Solve MuJoCo's contact problem at a state: acceleration, forces, and the solver's report.

    Use it to read contact forces, and to check that the solver converges. `rb.acceleration` returns
    the same acceleration. The problem is

        min over a of  (a - a_s)^T M (a - a_s) / 2 + sum of s_i(J_i a - a_ref,i),
        M a_s = tau(q, v, x, ctrl) + tau_given + J^T w - b

    with the costs s_i of contacts, limits, friction loss and equalities.

    Args:
        model: the robot, with `model.geoms` and `model.solver`, as `rb.load` makes it.
        state: `State(q (nq,), v (nv,))`, with x (nx,) if force elements have states.
        ctrl: controls (nu,); None for no actuation.
        tau: generalized forces (nv,) in addition to those of the model.
        wrenches: (nb, 6) [moment N m; force N] on bodies, in world axes at their origins. Each of
            ctrl, tau and wrenches may be a function (t, state).
        t: time in s, for force elements that depend on it.
        contact: "mujoco", or `rbjax.contact.SoftContact` with its arguments.

    Returns:
        `ContactSolution`. Batches by `jax.vmap`: over the states of a trajectory, saved at each
        step, it gives iterations and error of each step. It has derivatives in forward and
        reverse mode; those of the acceleration are implicit.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, a law that is not soft, a
            model without contact parameters.

    Source: Todorov, *Convex and analytically-invertible dynamics with contacts and constraints*,
    2014; MuJoCo, *Computation*, constraint model.

    Example:
        >>> import rbjax as rb
        >>> ball = '''<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.0999">
        ...     <freejoint/><geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>'''
        >>> model = rb.load(ball, contacts=True)
        >>> found = rb.contact.solve(model, model.default_state())
        >>> bool(found.converged), int(found.contacts.exists.sum())
        (True, 1)
    """
    given = inputs_at("contact.solve", model, Inputs(ctrl, tau, wrenches), t, state)
    return _solve(model, state, *given, t=t, contact=contact)


@algorithm("state", "ctrl", "tau", "wrenches", "t", where="contact.solve")
def _solve(
    model: Model, state: State, ctrl: Any = None, tau: Any = None, wrenches: Any = None,
    *, t: Any = 0.0, contact: Any = "mujoco",
) -> ContactSolution:  # fmt: skip
    law = law_of("contact.solve", model, contact)
    if not isinstance(law, SoftContact):
        raise InputError(
            f"contact.solve: contact is {contact!r}, expected 'mujoco' or an "
            "rb.contact.SoftContact(...): other laws have no convex problem"
        )
    own, f_ext, _ = applied(model, t, state, Inputs(ctrl, tau, wrenches))
    return law.solve(model, t, state, own, f_ext)
