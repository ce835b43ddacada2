"""Fixed-step integrators on the configuration manifold, for `rollout`.

    semi-implicit Euler   v+ = v + h a(q, v),   q+ = q (+) h v+
    implicit velocity     with the damping matrix, see `implicit_velocity`
    discrete              springs and contacts act at the end of a step, see `step_map`
    variational midpoint  on momenta, see `variational`
    Runge-Kutta           q = q0 (+) u,   u' = J_r(u)^-1 v,   v' = a(q0 (+) u, v)

A Runge-Kutta method integrates the increments (u, v - v0), which are a vector space. So it has the
order of its tableau on attitudes too (Munthe-Kaas 1998; Hairer, Lubich & Wanner, *Geometric
Numerical Integration*, IV.8). Controls are constant over a step.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol

import chex
import diffrax
import jax
import jax.numpy as jnp

from rbjax.constraints.formulation import differential_algebraic_method
from rbjax.contact.soft import SoftContact
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs
from rbjax.forces.joints.polynomials import JointPolynomials
from rbjax.model import Model, State
from rbjax.motion.field import Field, VelocityDynamics, free_motion, gives_velocities
from rbjax.motion.implicit import ByStages, tableau_of
from rbjax.motion.implicit_velocity import ImplicitVelocity
from rbjax.motion.solver_report import reports
from rbjax.motion.step_map import step_map
from rbjax.motion.variational import variational_midpoint
from rbjax.solvers.steps import combine, explicit_stages, scale
from rbjax.solvers.tableau import DOP853, KUTTA4, Tableau, of_diffrax

#: stages times dofs up to which the stages of a step are unrolled
WRITTEN_UP_TO = 13

TABLEAUS = {
    "rk4": KUTTA4,
    "tsit5": of_diffrax(diffrax.Tsit5, 5).essential,
    "dopri8": of_diffrax(diffrax.Dopri8, 8).essential,
    "dop853": DOP853,
}


class Integrator(Protocol):
    """A function that advances a state by a step dt with constant inputs."""

    def __call__(self, field: Field, t: Any, state: State, u: Inputs, dt: Any) -> State: ...


def semi_implicit_euler(field: Field, t: Any, state: State, u: Inputs, dt: Any) -> State:
    """Advance a state by v+ = v + dt a(q, v), q+ = q (+) dt v+, x+ = x + dt x'. The order is 1.
    The step is symplectic if the mass matrix is constant and no force depends on v."""
    v, x, kept, moving = field.advance_velocity(t, state, u, dt)
    return State(field.retract(state.q, dt * moving), v, x, *kept)


def runge_kutta(
    table: Tableau, field: Field, t: Any, state: State, u: Inputs, dt: Any,
    *, written: bool | None = None,
) -> State:  # fmt: skip
    """Advance a state by a step of an explicit tableau.
    written: whether to unroll the stages; None: unroll them if there are few."""
    q0, v0, x0, report = state.q, state.v, state.x, state.report
    t0, parts = t, 2 if x0 is None else 3

    def stage_state(t, dq, dv, x):
        at = State(field.retract(q0, dq), v0 + dv, x, state.memory, report)
        return field.stage_state(t, at, t0, state)

    def rate(t, k):
        at = stage_state(t, k[0], k[1], None if x0 is None else x0 + k[2])
        a, x, error = field.rates_and_error(t, at, u)
        return _given(field.increment_rate(k[0], at.v), a, x, error)

    if written is None:
        written = table.stages * field.model.nv <= WRITTEN_UP_TO
    stages = explicit_stages(rate, table, t, dt, written=written)
    like_error = report[0] if report is not None and reports(field.dynamics) else None
    start = jax.tree.map(jnp.zeros_like, _given(v0, v0, x0, like_error))
    ks = stages(start)
    dq, dv, *dx = scale(dt, combine(table.b, [k[:parts] for k in ks]))
    error = None if like_error is None else functools.reduce(jnp.maximum, [k[-1] for k in ks])
    after = stage_state(t + dt, dq, dv, None if x0 is None else x0 + dx[0])
    return State(after.q, after.v, after.x, *field.kept(state, error))


def _given(*parts: Any) -> tuple:
    return tuple(x for x in parts if x is not None)


INTEGRATORS: dict[str, Integrator] = {
    "semi_implicit_euler": semi_implicit_euler,
    "variational_midpoint": variational_midpoint,
    "euler_implicit_damping": ImplicitVelocity("euler_implicit_damping", JointPolynomials),
    "implicitfast": ImplicitVelocity("implicitfast"),
    "implicit": ImplicitVelocity("implicit"),
    "discrete": step_map,
}
INTEGRATORS |= {name: functools.partial(runge_kutta, t) for name, t in TABLEAUS.items()}


def loop_stages(name: str) -> Integrator:
    """Return the integrator of a name with its stages in a loop, for a short program."""
    if name not in TABLEAUS:
        return INTEGRATORS[name]
    return functools.partial(runge_kutta, TABLEAUS[name], written=False)


def integrator_of(
    where: str, integrator: str | Integrator | None, dynamics: Any = free_motion,
    model: Model | None = None,
) -> Integrator:  # fmt: skip
    """Return an integrator from its name, a given function, or the default.

    The default is semi-implicit Euler, or the integrator of the model's file for MuJoCo's contacts.
    """
    formulation = differential_algebraic_method(dynamics)
    if formulation is not None:
        return ByStages(formulation, tableau_of(where, formulation, integrator))
    if integrator is None:
        integrator = default_integrator(dynamics, model)
    if (
        gives_velocities(dynamics)
        and isinstance(integrator, str)
        and integrator != "semi_implicit_euler"
    ):
        raise InputError(
            f"{where}: integrator {integrator!r} evaluates accelerations, and "
            f"{type(dynamics).__name__} gives the velocity after a step; expected "
            "'semi_implicit_euler'"
        )
    if not isinstance(integrator, str):
        if not callable(integrator):
            raise InputError(
                f"{where}: integrator is {type(integrator).__name__}, expected one of "
                f"{list(INTEGRATORS)} or a function (field, t, state, inputs, dt) -> state; "
                "solvers of diffrax are for simulate"
            )
        check_takes(where, "integrator", integrator, "field", "t", "state", "inputs", "dt")
        return integrator
    if integrator not in INTEGRATORS:
        raise InputError(f"{where}: integrator {integrator!r}, expected one of {list(INTEGRATORS)}")
    return INTEGRATORS[integrator]


def default_integrator(
    dynamics: Any, model: Model | None, smooth: str = "semi_implicit_euler"
) -> str:
    """Return the name of the default integrator of a dynamics.

    It is the integrator of the model's file for MuJoCo's contacts, semi-implicit Euler for a law
    that gives the velocity after a step, and `smooth` for other motions.
    """
    if isinstance(dynamics, SoftContact) and model is not None and model.solver is not None:
        return model.solver.integrator
    if gives_velocities(dynamics):
        return "semi_implicit_euler"
    return smooth


def advance_state(
    integrator: Integrator, field: Field, t: Any, state: State, u: Inputs, dt: Any
) -> State:
    """Advance a state by a step of any integrator, clip the states of force elements to their
    ranges, and project the state onto the constraints of a formulation.

    If the integrator returns no report of the contact solver, the error at the start of the step
    counts.
    """
    after: Any = integrator(field, t, state, u, dt)
    if state.report is not None and isinstance(after, State) and after.report is None:
        error = None
        if not isinstance(field.dynamics, VelocityDynamics):
            *_, error = field.rates_and_error(t, state, u)
        after = State(after.q, after.v, after.x, after.memory, field.report(state, error))
    try:
        chex.assert_trees_all_equal_shapes_and_dtypes(state, after)
    except (AssertionError, AttributeError) as error:  # a leaf that is not an array has no shape
        got = [getattr(x, "shape", type(x).__name__) for x in jax.tree.leaves(after)]
        raise InputError(
            f"an integrator returned {type(after).__name__} of {got}, expected a State of "
            f"{[x.shape for x in jax.tree.leaves(state)]} in {state.q.dtype}, as the state that it "
            "was given"
        ) from error
    return field.project(t + dt, after.replace(x=field.within(after.x)))
