"""Moreau's time stepping: contacts as impulses over a step, with restitution and Coulomb friction.

    v+ = v + h a_free + W J^T p,    p by `impulse_equations` with u = J (v + h a_free)
    q+ = q (+) h w,   w = v + h a_free / 2 + W J^T r,   r the impulses that move the bodies
A contact or limit is active if it would close within the step. Its normal velocity after the step
is at least the velocity by Newton's restitution at the time of impact, or zero. A second problem,
of the mean velocity w, places the contact at its distance after the rebound, or at zero, and
removes the share c of a penetration. Friction of a lasting contact is constant over the step. So
free fall and slides with constant forces have no error, and the derivatives of an impact follow
from its saltation matrix (`time_of_impact`). Accumulation points and many contacts at once need no
events; the order is 1.

Source: Moreau, *Unilateral contact and dry friction in finite freedom dynamics*, 1988; Jean, *The
non-smooth contact dynamics method*, 1999; Stewart & Trinkle 1996.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer, real_number
from rbjax.constraints.equations.constrained_motion import constrained_motion
from rbjax.constraints.formulation import formulation_of
from rbjax.constraints.methods.soft import compliant_motion
from rbjax.constraints.rows.soft import is_soft
from rbjax.contact.geometry.detection import Contacts, contacts_at
from rbjax.contact.impacts.impulse_equations import (
    ImpulseProblem,
    natural_map,
    sweep_impulses,
)
from rbjax.contact.impacts.impulses import check_coefficients, check_pairs, impact_problem
from rbjax.contact.impacts.joint_rows import count_joint_rows, joint_rows, joint_sources
from rbjax.contact.impacts.time_of_impact import Touchdown, end_of_slip, touchdown
from rbjax.contact.rows.scalar_row import EQUALITY, FRICTION, LIMIT
from rbjax.contact.solver.contact_forces import ContactForces
from rbjax.contact.solver.solution import ContactSolution
from rbjax.dynamics.algorithms import aba
from rbjax.dynamics.algorithms.rnea import LinkForces, forces_at
from rbjax.dynamics.arguments import check_model
from rbjax.lanes.arrays import matvec
from rbjax.model import Model, State
from rbjax.model.record import Record

#: the residual in m/s up to which a step has converged
CONVERGED = 1e-4


class MoreauContact(Record):
    """Dynamics of contacts by Moreau's time stepping, for `step` and `rollout`.

    Make it with `MoreauContact.of`, and pass it as `dynamics=`. Use it for impacts with Newton's
    restitution, stacks and true sticking with steps of a millisecond, and for derivatives through
    impacts and slides: they are those of the rigid motion, as the step contains the time of impact.

    Limits and friction loss that `rb.load` takes as rows of the contact problem are in the same
    equations: a limit stops without rebound and without a margin, and friction loss holds or
    brakes with |p| <= h floss. Other forces are those at the start of the step: a joint with
    damping d and inertia m needs h d < 2 m.

    The memory (3 n + 1,) contains the impulses of the last step in N s, which start the next one,
    and at its end the residual in m/s: the largest violation of the laws. A step with a residual
    above 1e-4 m/s has not converged (`Trajectory.unconverged`): use more sweeps. The n rows are
    those of the contacts, then of the limits (normal), then of the friction loss (first tangent),
    and these two have zeros in their other entries.

    Fields:
        restitution, friction: e and mu (n,) of each candidate contact.
        correction: c (), share of a penetration that a step removes.
        rest_speed: () m/s, closing speed below which there is no restitution.
        pairs: pairs of geoms by index; static.
        sweeps: number of Gauss-Seidel sweeps of a step; static.

    Source: Moreau 1988; Jean 1999.

    Example: a ball that falls onto the floor and stays there
        >>> import rbjax as rb
        >>> ball = '''<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.2">
        ...     <joint type="slide" axis="0 0 1"/><geom size="0.1"/></body></worldbody></mujoco>'''
        >>> model = rb.load(ball)
        >>> law = rb.contact.MoreauContact.of(model)
        >>> path = rb.rollout(model, model.default_state(), None, 0.01, steps=30, dynamics=law)
        >>> round(float(path.q[-1, 0]), 5)
        -0.1
    """

    restitution: jax.Array
    friction: jax.Array
    correction: jax.Array
    rest_speed: jax.Array
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    sweeps: int = eqx.field(static=True, default=50)

    @classmethod
    def of(
        cls,
        model: Model,
        *,
        restitution: Any = 0.0,
        friction: Any = None,
        correction: Any = 0.1,
        rest_speed: Any = 1e-3,
        pairs: Any = None,
        sweeps: int = 50,
    ) -> MoreauContact:
        """Make the dynamics for a model.

        Args:
            model: the robot, with `model.geoms`.
            restitution: e, one number or one a pair (pairs,), from 0 to 1.
            friction: mu, one number or one a pair; the friction of the geoms if None.
            correction: share of a penetration that a step removes, 0 to 1.
            rest_speed: m/s, closing speed below which there is no restitution.
            pairs: names or indices of the geoms, two each; the pairs of the file if None.
            sweeps: number of Gauss-Seidel sweeps of a step.

        Raises:
            InputError: the model has no geoms; it has no pair, limit and friction loss; numbers
                out of range.
        """
        at = "MoreauContact.of"
        check_model(at, model)
        unpaired = pairs is None and model.geoms is not None and not model.geoms.pairs
        rows_only = unpaired and count_joint_rows(model)
        chosen = () if rows_only else check_pairs(at, model, pairs)
        integer(at, "sweeps", sweeps, least=1)
        dtype = model.gravity.dtype
        e, mu = check_coefficients(at, model, chosen, restitution, friction, dtype)
        c = real_number(at, "correction", correction, least=0.0, most=1.0, traced=True)
        rest = real_number(at, "rest_speed", rest_speed, least=0.0, traced=True)
        return cls(e, mu, jnp.asarray(c, dtype), jnp.asarray(rest, dtype), chosen, int(sweeps))

    def initial_memory(self, model: Model) -> jax.Array:
        """Return zero impulses and a zero residual."""
        n = len(self.restitution) + count_joint_rows(model)
        return jnp.zeros(3 * n + 1, model.gravity.dtype)

    def solver_tolerance(self, dtype: Any) -> float:
        """Return the residual in m/s up to which a step has converged."""
        return CONVERGED

    def solver_error(self, memory: jax.Array) -> jax.Array:
        """Return the residual in m/s of the step that returned a memory (m,)."""
        return memory[..., -1]

    def advance_velocity(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces, dt: Any
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Compute the velocity (nv,) and the memory (3 n + 1,) after a step dt, and the mean
        velocity (nv,) over the step."""
        assert state.memory is not None
        step = self._impulses(model, t, state, tau, f_ext, dt, state.memory)
        v, problem, events, p = state.v, step.problem, step.events, step.p
        active, J = problem.active, problem.J.reshape(-1, len(v))
        slip = matvec(J, v).reshape(-1, 3)[:, 1:]
        moving = jnp.where(active[:, None], p * events.part[:, None], 0)
        moving = moving.at[:, 1:].add(
            jnp.where(events.leaves[:, None], 0, end_of_slip(problem, p, slip))
        )
        mean = v + 0.5 * dt * step.free + problem.change(moving.at[:, 0].set(0))
        u = matvec(J, mean).reshape(-1, 3)
        places = problem._replace(u=u, b=events.mean, mu=jnp.zeros_like(problem.mu), dry=0.0)
        r = sweep_impulses(places, moving.at[:, 1:].set(0), self.sweeps)
        memory = jnp.concatenate([p.reshape(-1), step.residual[None]])
        after = v + dt * step.free + problem.change(p)
        return after, memory, mean + problem.change(r)

    def solve(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces, dt: Any = None
    ) -> ContactSolution:
        """Compute the mean acceleration of a step, the impulses over the step as forces p / h, and
        the report of the solver.

        dt: step in s; None for the model's timestep. A contact exists if it may have an impulse.
        """
        dt = model.timestep if dt is None else dt
        memory = self.initial_memory(model) if state.memory is None else state.memory
        step = self._impulses(model, t, state, tau, f_ext, dt, memory)
        n, sources, contacts = len(self.restitution), joint_sources(model), step.contacts
        f = step.p / dt
        along = (step.problem.J * f[..., None]).sum(1)  # J^T f of each row
        kinds = np.array([*["contact"] * n, *(kind for kind, *_ in sources)])
        contact, limit, friction = (
            along[np.flatnonzero(kinds == kind)].sum(0) for kind in ("contact", LIMIT, FRICTION)
        )
        a = step.free + step.problem.change(step.p) / dt
        rubs = np.array(kinds[n:] == FRICTION, bool)
        equality, rows = jnp.zeros_like(a), jnp.where(rubs, f[n:, 1], f[n:, 0])
        if model.constraints:
            pushes = tau + contact + limit + friction
            equality = forces_at(model, state.q, state.v, a, f_ext) - pushes
            # the forces of soft constraints do not depend on impulses within the step
            solved, given = (
                (compliant_motion, tau) if is_soft(model) else (constrained_motion, pushes)
            )
            rows = jnp.concatenate([rows, solved(model, t, state, given, f_ext)[1]])
            for k, constraint in enumerate(model.constraints):
                sources += ((EQUALITY, "constraint", k),) * constraint.size
        exists = step.problem.active[:n]
        force = jnp.concatenate([f[:n], jnp.zeros_like(f[:n])], -1)
        position, frame, force = (
            jnp.where(exists.reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0)
            for x in (contacts.position, contacts.frame, force)
        )
        distance = jnp.where(exists, contacts.distance, jnp.inf)
        return ContactSolution(
            acceleration=a,
            contacts=ContactForces(exists, distance, position, frame, force, contacts.geoms),
            contact=contact,
            limit=limit,
            friction=friction,
            equality=equality,
            rows=rows,
            iterations=jnp.int32(self.sweeps),
            error=step.residual,
            success=step.residual <= self.solver_tolerance(a.dtype),
            sources=sources,
        )

    def _impulses(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces, dt: Any,
        memory: jax.Array,
    ) -> _Step:  # fmt: skip
        """Solve the impulse equations of a step dt."""
        q, v, dtype = state.q, state.v, state.q.dtype
        e, mu, c, rest = (
            jnp.asarray(x, dtype)
            for x in (self.restitution, self.friction, self.correction, self.rest_speed)
        )
        formulation = formulation_of("MoreauContact", model, None)
        if formulation is None:
            a = aba.acceleration(model, q, v, tau, f_ext)
        else:
            a = formulation(model, t, state, tau, f_ext)
        contacts, joints = contacts_at(model, q, jnp.inf, self.pairs), joint_rows(model, q)
        problem = impact_problem(model, q, v + dt * a, contacts, mu, t, joints.J)
        normal = problem.J[:, 0]
        gap = jnp.concatenate([contacts.distance, joints.gap])
        dry = jnp.concatenate([jnp.zeros_like(e), dt * joints.floss])
        e = jnp.concatenate([e, jnp.zeros_like(joints.gap)])
        events = touchdown(gap, matvec(normal, v), matvec(normal, a), e, rest, c, dt)
        active = problem.active & events.active
        problem = problem._replace(b=events.velocity, active=active, dry=dry)
        start = jnp.where(active[:, None], memory[:-1].reshape(-1, 3).astype(dtype), 0)
        p = sweep_impulses(problem, start, self.sweeps)
        residual = jnp.abs(natural_map(problem, p)).max(initial=0.0)
        return _Step(contacts, problem, events, a, p, residual)


class _Step(NamedTuple):
    """The impulse equations of a step and their solution.

    Fields:
        contacts: the candidate contacts.
        problem: the impulse equations.
        events: of the rows within the step.
        free: (nv,) acceleration without impulses.
        p: (n, 3) impulses.
        residual: m/s.
    """

    contacts: Contacts
    problem: ImpulseProblem
    events: Touchdown
    free: jax.Array
    p: jax.Array
    residual: jax.Array
