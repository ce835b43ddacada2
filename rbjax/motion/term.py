"""The equations of motion as a diffrax term, and diffrax solvers that project states.

    q' = the rate of the configuration at velocity v (for attitudes q quaternion (0, w / 2)),
    v' = dynamics(q, v, forces),   x' = the rates of force elements
Only the direction of a quaternion has an effect, and its rate is linear in the quaternion. So an
error of its length has no effect until it overflows, and `success` is False then. Returned
quaternions have unit length.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.constraints.formulation import Formulation, differential_algebraic_method
from rbjax.dynamics.algorithms.manifold import difference_lanes, integrate_lanes
from rbjax.dynamics.algorithms.rnea import momentum
from rbjax.errors import InputError
from rbjax.forces.inputs import NO_INPUTS, Inputs, evaluated
from rbjax.lanes import fusion_barrier
from rbjax.model import Model, State, Topology, joint_slices
from rbjax.motion.field import Dynamics, Field, free_motion, moves_stages
from rbjax.motion.implicit import BDFSolver, StagesSolver, tableau_of
from rbjax.motion.solver_report import reports
from rbjax.rotations import quaternion
from rbjax.solvers import BDF, AbstractGroup, AbstractGroupSolver, OnGroup
from rbjax.solvers.compensated import WrappedSolver


def configuration_rate(top: Topology, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the rate q' (nq,) at velocity v (nv,); for a quaternion the product q (0, w) / 2."""
    out = [jnp.zeros(0, q.dtype)]
    for span in joint_slices(top):
        out.append(v[span.v])
        if span.attitude:
            turn, by = span.attitude
            w = jnp.concatenate([jnp.zeros(1, q.dtype), v[by]])
            out.append(quaternion.multiply(q[turn], w) / 2)
    return jnp.concatenate(out)


def unit_quaternions(top: Topology, q: jax.Array) -> jax.Array:
    """Normalize the quaternions of a configuration."""
    for start in top.quaternion_starts:
        rows = slice(start, start + 4)
        q = q.at[rows].set(quaternion.normalize(q[rows]))
    return q


class VectorField(eqx.Module):
    """The equations of motion as a vector field of diffrax.

    model: function of diffrax' args, which contain the traced leaves of the model.
    start: time in s at diffrax' time zero.
    tangent: whether the rate of the configuration is v, for solvers on the manifold.
    begun: time and state at the start of the step, for `stage_state`; None for the current ones.
    reports: whether a rate has [1 if the solver did not converge, its error] as its report.
    """

    inputs: Inputs
    model: Callable[[Any], Model]
    dynamics: Dynamics = free_motion
    start: Any = None
    tangent: bool = eqx.field(static=True, default=False)
    begun: tuple[Any, State] | None = None
    reports: bool = eqx.field(static=True, default=False)

    @eqx.filter_jit  # diffrax calls it in many places; trace it once
    def __call__(self, t: Any, y: State, args: Any) -> State:
        model = self.model(args)
        t = t if self.start is None else self.start + t
        at = State(unit_quaternions(model.topology, y.q), y.v, y.x)
        field = Field(model, self.dynamics)
        at = field.stage_state(t, at, *((t, at) if self.begun is None else self.begun))
        inputs = evaluated("simulate", model, self.inputs, t, at)
        rate = at.v if self.tangent else configuration_rate(model.topology, y.q, at.v)
        if not self.reports:
            return State(rate, *field.rates(t, at, inputs))
        at = State(at.q, at.v, at.x, None, jnp.zeros(2, at.q.dtype))
        a, x, error = field.rates_and_error(t, at, inputs)
        return State(rate, a, x, None, field.report(at, error))


class Manifold(AbstractGroup):
    """The states of a robot as a Lie group: rotations for attitudes, addition for the rest."""

    topology: Topology = eqx.field(static=True)

    def retract(self, y: State, u: State) -> State:
        q = fusion_barrier(integrate_lanes(self.topology, list(y.q), list(u.q)))
        return State(jnp.stack(q), y.v + u.v, jax.tree.map(jnp.add, y.x, u.x))

    def difference(self, y: State, z: State) -> State:
        dq = fusion_barrier(difference_lanes(self.topology, list(y.q), list(z.q)))
        return State(jnp.stack(dq), z.v - y.v, jax.tree.map(jnp.subtract, z.x, y.x))

    def bracket(self, u: State, w: State) -> State:
        out = jnp.zeros_like(w.q)
        for start in self.topology.turn_starts:
            rows = slice(start, start + 3)
            out = out.at[rows].set(jnp.cross(u.q[rows], w.q[rows]))
        return State(out, *jax.tree.map(jnp.zeros_like, (w.v, w.x)))


class MomentumFunction(eqx.Module):
    """The generalized momentum M v (nv,), with the arguments of a diffrax vector field."""

    model: Callable[[Any], Model]

    @eqx.filter_jit
    def __call__(self, t: Any, y: State, args: Any) -> jax.Array:
        model = self.model(args)
        return momentum(model, unit_quaternions(model.topology, y.q), y.v)


def identity(x: Any) -> Any:
    return x


def make_term(
    model: Model,
    state: State,
    solver: diffrax.AbstractSolver,
    inputs: Inputs = NO_INPUTS,
    of_args: Callable[[Any], Model] = identity,
    dynamics: Dynamics = free_motion,
    start: Any = None,
) -> tuple[diffrax.AbstractTerm, State]:
    """Return the diffrax term of the equations of motion for a solver, and the initial state.
    Solvers on Lie groups get a term on the manifold and normalized quaternions."""
    if not isinstance(solver, AbstractGroupSolver):
        return diffrax.ODETerm(VectorField(inputs, of_args, dynamics, start)), state
    top = model.topology
    check_for_robots(solver)
    field = VectorField(inputs, of_args, dynamics, start, tangent=True)
    term = OnGroup(field, Manifold(top), MomentumFunction(of_args))
    return term, State(unit_quaternions(top, state.q), state.v, state.x)


def check_for_robots(solver: diffrax.AbstractSolver) -> None:
    """Raise InputError if a group solver does not solve the equations of a robot."""
    if not isinstance(solver, AbstractGroupSolver):
        return
    name = type(solver).__name__
    if not issubclass(OnGroup, solver.term_structure):
        raise InputError(
            f"simulate: {name} solves only {solver.term_structure.__name__}, by "
            "diffrax.diffeqsolve, not robots; use a solver of rb.solvers.all()"
        )


class ProjectedSolver(WrappedSolver):
    """A solver with the projections of a formulation: `stage_state` at the stages and at the end of
    each step, `project` after the step.

    The error is estimated before the projection. A solver that reuses the slope at the end of a
    step uses the slope before the projection, which differs by less than the error.
    """

    formulation: Formulation = eqx.field(static=True)
    model: Callable[[Any], Model]
    start: Any

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        model, begun = self.model(args), (self.start + t0, y0)
        stages = moves_stages(self.formulation)
        y1, error, dense, solver_state, result = self.solver.step(
            _with(terms, begun=begun) if stages else terms,
            t0,
            t1,
            y0,
            args,
            solver_state,
            made_jump,
        )
        t = self.start + t1
        if stages:
            y1 = self.formulation.stage_state(model, t, y1, *begun)
        y1 = self.formulation.project(model, t, y1)
        return y1, error, dense | ({"y1": y1} if "y1" in dense else {}), solver_state, result


class ReportingSolver(WrappedSolver):
    """A solver that reports the errors of the solver of a contact law, as its own state.

    The errors are integrated over each step with the weights of the stages, and only accepted
    steps count. Steps and their error estimates stay the same.
    """

    def init(self, terms, t0, t1, y0, args):
        inner = self.solver.init(_with(terms, reports=True), t0, t1, _with_zeros(y0), args)
        return inner, jnp.zeros(2, y0.q.dtype)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        inner, report = solver_state
        y1, error, dense, inner, result = self.solver.step(
            _with(terms, reports=True), t0, t1, _with_zeros(y0), args, inner, made_jump
        )
        failed, size = jnp.abs(y1.report)
        worst = jnp.where(failed > 0, size / (t1 - t0), 0.0)
        added = jnp.stack([report[0] + (failed > 0), jnp.maximum(report[1], worst)])
        error = None if error is None else _without_report(error)
        return _without_report(y1), error, dense, (inner, jax.lax.stop_gradient(added)), result


def _with_zeros(y: State) -> State:
    return State(y.q, y.v, y.x, None, jnp.zeros(2, y.q.dtype))


def _without_report(y: State) -> State:
    return State(y.q, y.v, y.x)


def solver_of(given: diffrax.AbstractSolver | None, dynamics: Dynamics) -> diffrax.AbstractSolver:
    """Return the diffrax solver for a dynamics: the given one, the implicit solver for a
    formulation of index 2 or 3, or the default."""
    if given is not None:
        _check_solver("simulate", given)
    formulation = differential_algebraic_method(dynamics)
    if formulation is not None:
        if isinstance(given, BDF):
            return BDFSolver(formulation, given.formula_order)
        tableau = tableau_of("simulate", formulation, given, ", bdf1 to bdf6")
        return StagesSolver(formulation, tableau)
    return diffrax.Tsit5() if given is None else given


def _with(terms: Any, **changes: Any) -> Any:
    """Return `terms` with fields of its vector fields changed."""

    def of(x: Any) -> Any:
        return dataclasses.replace(x, **changes) if is_field(x) else x

    def is_field(x: Any) -> bool:
        return isinstance(x, VectorField)

    return jax.tree.map(of, terms, is_leaf=is_field)


def project_after_steps(
    solver: diffrax.AbstractSolver, dynamics: Dynamics, model: Callable[[Any], Model], start: Any
) -> diffrax.AbstractSolver:
    """Wrap a solver to project after each step, if the dynamics has a projection, or to report the
    errors of the solver of a contact law."""
    if reports(dynamics) and not isinstance(solver, AbstractGroupSolver):
        return ReportingSolver(solver)
    if not isinstance(dynamics, Formulation) or dynamics.projection is None:
        return solver
    return ProjectedSolver(solver, dynamics, model, start)


def _check_solver(function: str, solver: Any) -> None:
    """Raise InputError unless solver is an instance of a diffrax solver."""
    if isinstance(solver, diffrax.AbstractSolver):
        return
    got, fix = repr(solver), ""
    if isinstance(solver, str):
        fix = f": rb.solvers.all()[{solver!r}].make()"
    elif hasattr(solver, "make"):
        fix = ": the entry's make()"
    elif hasattr(solver, "__name__"):
        got = f"the {'class' if isinstance(solver, type) else 'function'} {solver.__name__}"
        fix = f": {solver.__name__}()"
    raise InputError(f"{function}: solver is {got}, expected a solver of diffrax{fix}")
