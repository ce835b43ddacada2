"""Modes of rigid contacts between events: open, sliding or sticking, and the changes of mode.

    M a + b = tau + J^T f,   J a + J' v = 0 in the rows that are kept,   |f_t| = mu f_n if sliding
A kept contact has its normal row, and its tangential rows if it sticks. Four guards per contact
become zero at an event: the distance of an open contact, the normal force of a kept one, its slip
if it slides, and mu f_n - |f_t| if it sticks.

Source: Pfeiffer & Glocker, *Multibody Dynamics with Unilateral Contacts*, 1996, ch. 5-8.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.compiler.jax.function import one_program
from rbjax.contact.geometry.detection import Contacts, contacts_at
from rbjax.contact.impacts.impulse_equations import ImpulseProblem
from rbjax.contact.impacts.impulses import impact, impact_problem
from rbjax.contact.impacts.point_velocity import relative_velocity
from rbjax.dynamics.algorithms.manifold import retract
from rbjax.forces.inputs import Inputs, evaluated
from rbjax.lanes.arrays import matvec
from rbjax.model import Model, State
from rbjax.motion.field import Field
from rbjax.motion.term import configuration_rate, unit_quaternions

#: a force that counts as zero, N
TINY = 1e-12
#: the largest number of contacts for which one program for all loops compiles faster
FEW = 4


class Mode(NamedTuple):
    """The mode of n contacts: whether each is kept, whether it slides, and its direction of slip
    (n, 2)."""

    kept: jax.Array
    slides: jax.Array
    direction: jax.Array


class ContactsOfState(NamedTuple):
    """The contacts at a state.

    Fields:
        contacts: the n candidates at any distance.
        J: (n, 3, nv) Jacobian of the relative velocities.
        problem: their impulse problem, with b = 0.
        Y: (nv, 3 n) change of the velocity by unit impulses.
        f: (n, 3) forces.
    """

    contacts: Contacts
    J: jax.Array
    problem: ImpulseProblem
    Y: jax.Array
    f: jax.Array


class ContactSystem(eqx.Module):
    """The equations of motion between two contact events, and the guards that detect the next
    event. The `args` of both functions are the `Mode`."""

    model: Model
    inputs: Inputs
    dynamics: Any
    friction: jax.Array
    start: jax.Array
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)

    def field(self, t: Any, y: State, mode: Mode) -> State:
        a, x, _ = self.motion(t, y, mode)
        return State(configuration_rate(self.model.topology, y.q, y.v), a, x)

    def unit(self, y: State) -> State:
        """Return the state with unit quaternions."""
        return State(unit_quaternions(self.model.topology, y.q), y.v, y.x)

    @functools.cached_property
    def motion(self) -> Callable[[Any, State, Mode], tuple[jax.Array, Any, ContactsOfState]]:
        """The function (t, y, mode) -> v', x' and the contacts. All loops of a motion share its
        trace, and for few contacts its program and derivatives, which compiles faster."""
        shared = one_program if len(self.friction) <= FEW else jax.jit
        return shared(lambda t, y, mode: self._motion(t, y, mode))

    def _motion(self, t: Any, y: State, mode: Mode) -> tuple[jax.Array, Any, ContactsOfState]:
        at, t = self.unit(y), self.start + t
        inputs = evaluated("simulate_impacts", self.model, self.inputs, t, at)
        a, x = Field(self.model, self.dynamics).rates(t, at, inputs)
        (_, contacts), (bias, _) = jax.jvp(
            lambda s: self.slip(retract(self.model, at.q, s * at.v), at.v),
            (jnp.zeros((), at.q.dtype),), (jnp.ones((), at.q.dtype),),
        )  # fmt: skip
        problem = impact_problem(self.model, at.q, at.v, contacts, self.friction, t)
        J, Y = problem.J, problem.Y
        free = matvec(J, a) + bias
        f = kept_forces(problem.D, free, problem.u, self.friction, mode)
        return a + matvec(Y, f.reshape(-1)), x, ContactsOfState(contacts, J, problem, Y, f)

    def slip(self, q: jax.Array, v: jax.Array) -> tuple[jax.Array, Contacts]:
        """Return the relative velocities u (n, 3), and the candidate contacts at any distance."""
        contacts = contacts_at(self.model, q, jnp.inf, self.pairs)
        return relative_velocity(self.model, q, v, contacts), contacts

    def guards(self, t: Any, y: State, mode: Mode) -> jax.Array:
        """Compute the guards (4, n) of the contact points: functions that cross zero at an event.

        They are the distance of an open contact and, for a kept one, its normal force, its speed
        along its direction of sliding, and the reserve mu f_n - |f_t| of friction. A guard without
        a meaning is infinite.
        """
        return self.guards_of(self.motion(t, y, mode)[2], mode)

    def guards_of(self, found: ContactsOfState, mode: Mode) -> jax.Array:
        """Compute the guards (4, n) of `guards`, from contact forces that are found already."""
        mu, far = self.friction, jnp.inf
        rubs = mode.kept & (mu > 0) & jnp.isfinite(mu)
        tangent = jnp.sqrt((found.f[:, 1:] ** 2).sum(-1) + TINY**2)
        reserve = jnp.where(jnp.isfinite(mu), mu, 0) * found.f[:, 0] - tangent
        return jnp.stack([
            jnp.where(~mode.kept & found.contacts.exists, found.contacts.distance, far),
            jnp.where(mode.kept, found.f[:, 0], far),
            jnp.where(rubs & mode.slides, (found.problem.u[:, 1:] * mode.direction).sum(-1), far),
            jnp.where(rubs & ~mode.slides, reserve, far),
        ])  # fmt: skip

    def guard(self, t: Any, y: State, mode: Mode) -> jax.Array:
        guards = self.guards(t, y, mode)
        return jnp.minimum(guards.reshape(-1)[jnp.argmin(guards)], 1e6)


def kept_forces(
    D: jax.Array, free: jax.Array, u: jax.Array, mu: jax.Array, mode: Mode
) -> jax.Array:
    """Return the contact forces (n, 3) that keep the relative acceleration of kept contacts at
    zero.

    D: Delassus matrix. free: relative accelerations (n, 3) without contact forces. u: relative
    velocities (n, 3). mu: friction coefficients (n,).

    Rows that are not kept have no force; the friction of a sliding contact is -mu f_n times the
    direction of slip. The matrix is regularised, with two refinements, for contacts that are
    redundant and for points that cannot move in some direction.
    """
    n = len(mu)
    sticks = mode.kept & ~mode.slides & (mu > 0)
    rows = jnp.stack([mode.kept, sticks, sticks], -1).reshape(-1)
    speed = jnp.sqrt((u[:, 1:] ** 2).sum(-1) + TINY**2)
    along = (u[:, 1:] * mode.direction).sum(-1) > 0.5 * speed
    direction = jnp.where(along[:, None], u[:, 1:] / speed[:, None], mode.direction)
    # forces f = B x of the unknowns x: the kept rows, and friction by normal forces
    rub = jnp.where(mode.kept & mode.slides & jnp.isfinite(mu), mu, 0)
    one, normal = jnp.eye(n, dtype=free.dtype), jnp.array([1, 0, 0], free.dtype)
    column = jnp.concatenate([jnp.zeros((n, 1), free.dtype), -rub[:, None] * direction], -1)
    B = column[:, :, None, None] * one[:, None, :, None] * normal
    B = B.reshape(3 * n, 3 * n)
    B = jnp.where(rows[None], B + jnp.eye(3 * n, dtype=free.dtype), 0)
    A = (D.reshape(3 * n, 3 * n)[:, :, None] * B[None]).sum(1)
    A = jnp.where(rows[:, None], A, jnp.eye(3 * n, dtype=free.dtype))
    right = jnp.where(rows, -free.reshape(-1), 0)
    small = jnp.finfo(free.dtype).eps ** (2 / 3) * jnp.abs(jax.lax.stop_gradient(A)).max()
    factors = jax.scipy.linalg.lu_factor(A + small * jnp.eye(3 * n, dtype=free.dtype))
    x = jax.scipy.linalg.lu_solve(factors, right)
    for _ in range(2):
        x = x + jax.scipy.linalg.lu_solve(factors, right - matvec(A, x))
    return matvec(B, x).reshape(n, 3)


def initial_mode(system: ContactSystem, state: State) -> tuple[Mode, jax.Array]:
    """Return the mode at the start, and whether a contact that touches is opening there."""
    at, mu = jax.lax.stop_gradient(system.unit(state)), system.friction
    u, contacts = jax.lax.stop_gradient(system.slip(at.q, at.v))
    near, least = _small(at.q.dtype)
    touches = contacts.exists & (jnp.abs(contacts.distance) <= near)
    still = least * (1 + jnp.abs(u).max(initial=0.0))
    kept = touches & (jnp.abs(u[:, 0]) <= still)
    moves, towards = _slip_direction(u, still)
    mode = Mode(kept, kept & moves & jnp.isfinite(mu), towards)
    return jax.lax.stop_gradient(mode), (touches & (u[:, 0] > still)).any()


def _small(dtype: Any) -> tuple[float, float]:
    """Return a distance in m and a relative speed that count as zero."""
    return (1e-9, 1e-9) if dtype == jnp.float64 else (1e-5, 1e-5)


def _slip_direction(u: jax.Array, still: Any) -> tuple[jax.Array, jax.Array]:
    """Return whether contacts slip faster than `still` (n,), and the unit slip direction (n, 2)."""
    length = jnp.sqrt((u[:, 1:] ** 2).sum(-1))
    moves = length > still
    return moves, u[:, 1:] / jnp.where(moves, length, 1)[:, None]


def transition(
    system: ContactSystem, t: Any, y: State, mode: Mode, e: jax.Array, rest: jax.Array, law: str
) -> tuple:
    """Return the state and the mode after an event, the contacts that closed, the residual of the
    impact and whether it succeeded.
    e: restitution. rest: normal speed up to which a contact does not rebound."""
    at, mu = system.unit(y), system.friction
    now = system.motion(t, y, mode)[2]
    found = jax.lax.stop_gradient(now)
    guards, contacts, u = system.guards_of(found, mode), found.contacts, found.problem.u
    near, still = _small(at.q.dtype)
    force = jnp.abs(found.f).max(initial=0.0) + jnp.finfo(at.q.dtype).tiny
    speed = jnp.abs(u).max(initial=0.0)
    first = jnp.arange(guards.size).reshape(guards.shape) == jnp.argmin(guards)

    touches = ~mode.kept & contacts.exists & ((contacts.distance <= near) | first[0])
    closed = touches & (u[:, 0] < 0)
    active = closed | mode.kept | (touches & closed.any())
    bounces = e * (u[:, 0] < -rest)
    problem = now.problem._replace(active=active)
    v, _, residual, fine = impact(problem, at.v, bounces, law)
    hit = closed.any()
    after = State(y.q, jnp.where(hit, v, y.v), y.x)
    u = matvec(found.J, jax.lax.stop_gradient(after.v))
    rests = jnp.abs(u[:, 0]) <= still * (1 + speed)
    kept = jnp.where(hit, active & (bounces == 0) & rests, mode.kept)

    opens = mode.kept & ~hit & ((guards[1] <= near * force) | first[1])
    stops = mode.kept & ~hit & ((guards[2] <= near * (1 + speed)) | first[2])
    slips = mode.kept & ~hit & ((guards[3] <= near * force) | first[3])
    moves, towards = _slip_direction(u, still * (1 + speed))
    tangent = found.f[:, 1:]
    size = jnp.sqrt((tangent**2).sum(-1))
    against = -tangent / jnp.where(size > 0, size, 1)[:, None]
    changed = hit | stops
    slides = jnp.where(changed, moves & jnp.isfinite(mu), mode.slides) | slips
    direction = jnp.where((changed & moves)[:, None], towards, mode.direction)
    direction = jnp.where(slips[:, None], against, direction)
    kept = kept & ~opens
    return after, Mode(kept, slides & kept, direction), closed, residual, fine | ~hit
