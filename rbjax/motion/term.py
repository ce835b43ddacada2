"""The term of a robot's motion: what a diffrax solver sees of it.

    q' = the motion of the configuration at velocity v (for attitudes q quaternion (0, w / 2)),
    v' = dynamics(q, v, forces),   x' = the rates of force elements
The attitude enters only as the direction of its quaternion, and its rate is linear in it, so the
length that a solver loses or gains to its error has no effect until it is no number any more
(Euler, 0.4 rad a step, 40,000 steps), which `ok` shows; what is returned has unit length.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.manifold import difference_lanes, integrate_lanes
from rbjax.dynamics.algorithms.rnea import momentum
from rbjax.errors import InputError
from rbjax.forces.inputs import NO_INPUTS, Inputs, evaluated
from rbjax.lanes import fusion_barrier
from rbjax.model import Model, State, Topology, spans
from rbjax.motion.field import Dynamics, Field, free_motion
from rbjax.rotations import quaternion
from rbjax.solvers import AbstractGroup, AbstractGroupSolver, OnGroup


def configuration_rate(top: Topology, q: jax.Array, v: jax.Array) -> jax.Array:
    """q' (nq,) of the velocity v (nv,): for attitudes q (0, w) / 2."""
    out = [jnp.zeros(0, q.dtype)]
    for span in spans(top):
        out.append(v[span.v])
        if span.attitude:
            turn, by = span.attitude
            w = jnp.concatenate([jnp.zeros(1, q.dtype), v[by]])
            out.append(quaternion.multiply(q[turn], w) / 2)
    return jnp.concatenate(out)


def unit(top: Topology, q: jax.Array) -> jax.Array:
    """q with quaternions of unit length."""
    for start in top.quaternion_starts:
        rows = slice(start, start + 4)
        q = q.at[rows].set(quaternion.normalize(q[rows]))
    return q


class VectorField(eqx.Module):
    """The vector field of a robot under its own forces and inputs, for diffrax.

    model: of diffrax' args, which hold what is traced of it; what is known stays known. start: the
    time at which diffrax' own begins. tangent: the configuration's rate is v itself, for solvers
    that move along the manifold. begun: time and state at which the step began, for laws that take
    the rates of a stage elsewhere; None: at the state itself.
    """

    inputs: Inputs
    model: Callable[[Any], Model]
    dynamics: Dynamics = free_motion
    start: Any = None
    tangent: bool = eqx.field(static=True, default=False)
    begun: tuple[Any, State] | None = None

    @eqx.filter_jit  # diffrax asks for it in many places: traced once
    def __call__(self, t: Any, y: State, args: Any) -> State:
        model = self.model(args)
        t = t if self.start is None else self.start + t
        at = State(unit(model.topology, y.q), y.v, y.x)
        field = Field(model, self.dynamics)
        at = field.stage_state(t, at, *((t, at) if self.begun is None else self.begun))
        inputs = evaluated("simulate", model, self.inputs, t, at)
        a, x = field.rates(t, at, inputs)
        rate = at.v if self.tangent else configuration_rate(model.topology, y.q, at.v)
        return State(rate, a, x)


class Manifold(AbstractGroup):
    """The states of a robot as a Lie group: attitudes turn, everything else adds."""

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


class Momentum(eqx.Module):
    """M v (nv,)."""

    model: Callable[[Any], Model]

    @eqx.filter_jit
    def __call__(self, t: Any, y: State, args: Any) -> jax.Array:
        model = self.model(args)
        return momentum(model, unit(model.topology, y.q), y.v)


def itself(x: Any) -> Any:
    return x


def motion(
    model: Model,
    state: State,
    solver: diffrax.AbstractSolver,
    inputs: Inputs = NO_INPUTS,
    of_args: Callable[[Any], Model] = itself,
    dynamics: Dynamics = free_motion,
    start: Any = None,
) -> tuple[diffrax.AbstractTerm, State]:
    """The term of a robot's motion that a solver takes, and where it starts: solvers on groups move
    along the manifold, from quaternions of unit length. The term's args hold the model."""
    if not isinstance(solver, AbstractGroupSolver):
        return diffrax.ODETerm(VectorField(inputs, of_args, dynamics, start)), state
    top = model.topology
    check_takes_robots(solver)
    field = VectorField(inputs, of_args, dynamics, start, tangent=True)
    term = OnGroup(field, Manifold(top), Momentum(of_args))
    return term, State(unit(top, state.q), state.v, state.x)


def check_takes_robots(solver: diffrax.AbstractSolver) -> None:
    """Refuse solvers of other equations."""
    if not isinstance(solver, AbstractGroupSolver):
        return
    name = type(solver).__name__
    if not issubclass(OnGroup, solver.term_structure):
        raise InputError(
            f"simulate: {name} solves {solver.term_structure.__name__} alone, "
            "with diffrax.diffeqsolve; robots take the other solvers"
        )
