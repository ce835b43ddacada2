"""The variational midpoint method with a fixed number of evaluations, for `rollout`.

The discrete Euler-Lagrange equations of L_d = h L(m, w), with q1 = q0 (+) h w, m = q0 (+) h w / 2.
Let p = M(m) w, p' its rate at the midpoint with forces (discrete d'Alembert principle), and
F = p' + w x p on attitudes, F = p' elsewhere:

    0  = R(w) = M(m) w - S E p0 - h/2 J F        for w
    p1 = E (E p0 + h F)                          then v1 = M(q1)^-1 p1

On attitudes, with y = h w / 2 in body axes, E = exp(-[y]), J = J_r(y), S = 1 + c_3(|y|^2) [y]^2.
Elsewhere E, J and S are 1. They are the derivative of exp, so the step is symplectic in (q, p) on
attitudes too. The states of force elements follow the implicit midpoint rule.

R = 0 is solved by a simplified Newton (chord) iteration: w - (M + h D / 2 + h^2 K / 4)^-1 R(w). The
matrix is evaluated at q0 (+) h v0 / 2, with the dampers D, the springs K and the servo gains of
joints, and is factored once (articulated-body factors). An evaluation is O(n), and divides the
error by about h |dM/dq v| / |M|. The matrix has no geometric stiffness, by which a bent beam
couples bending and torsion: with flexible links the iteration is accelerated
(`rbjax.solvers.anderson`). A spring k on a mass m whose element has no implicit stiffness converges
for h < 2 sqrt(m / k), the stability limit of explicit methods. The matrix has no constraint terms:
near a singular position, with singular value sigma of the constraint Jacobian, an evaluation
multiplies a velocity across the constraints by about h v / sigma, and the step may not converge in
f64. In f32 the constraint equations damp sigma below 1e-2.

Source: Marsden & West, *Acta Numerica* 2001; on Lie groups Bou-Rabee & Marsden, *Foundations of
Computational Mathematics* 9, 2009.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.energy import (
    linearly_implicit_velocity,
    momentum_and_rate,
    velocity_of,
)
from rbjax.dynamics.algorithms.rnea import momentum
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs
from rbjax.forces.slopes import Slope
from rbjax.lanes import Lane, Vec3, add, fusion_barrier, is_zero, mul, total
from rbjax.model import State, Topology, joint_slices
from rbjax.motion.field import Field
from rbjax.rotations.coefficients import stumpff
from rbjax.solvers.anderson import History, accelerate

#: evaluations times dofs up to which the loop is unrolled
WRITTEN_UP_TO = 13
#: A step has not converged if its last correction exceeds all three of: half of the first one, this
#: part of the velocity, and sqrt(eps) of the configuration (at rest corrections are rounding).
LOST = 1e-3


@dataclass(frozen=True)
class VariationalMidpoint:
    """Integrator of `rollout`: symplectic in (q, p = M v), symmetric, of order 2, on the manifold.

    An evaluation costs a pass over the tree and a solve with existing factors, half as much as
    forward dynamics. A step has two further eliminations. The derivative is the derivative of the
    evaluations with constant factors. Its error is of the size of the error of the iteration. If a
    step does not converge, it is nan, and `Trajectory.success` is False. A partly converged step
    has order 2 but is symplectic only approximately: use more evaluations or shorter steps.

    evaluations: number of evaluations of the equations in a step, at least 2.
    """

    evaluations: int = 6

    def __post_init__(self) -> None:
        if not (isinstance(self.evaluations, int) and self.evaluations >= 2):
            raise InputError(
                f"VariationalMidpoint: evaluations is {self.evaluations!r}, "
                "expected an integer of at least 2"
            )

    def __call__(self, field: Field, t: Any, state: State, u: Inputs, dt: Any) -> State:
        model, q0, v0, x0 = field.precomputed, state.q, state.v, state.x
        p0, half = momentum(model, q0, v0), dt / 2
        middle = field.retract(q0, half * v0)
        slopes = field.slopes(t + half, State(middle, v0, x0), u, dt)
        extra = implicit_stiffness(model.topology, slopes, dt)
        correction = linearly_implicit_velocity(model, middle, jax.lax.stop_gradient(extra))

        def evaluated(w: jax.Array, x: Any) -> tuple[jax.Array, jax.Array, Any, Any]:
            """Compute the residual R(w), the force F, the rate x' and the error of the solver at
            the midpoint, for a mean velocity w."""
            at = State(field.retract(q0, half * w), w, x, state.memory, state.report)
            tau, f_ext, rate, error = field.forces(t + half, at, u)
            p, dp = momentum_and_rate(model, at.q, w, tau, f_ext)
            force = with_spin(model.topology, w, p, dp)
            return residual(model.topology, half, w, p, p0, force), force, rate, error

        def once(at: tuple, _: Any = None) -> tuple[tuple, Any]:
            w, x, *_, history = at
            R, force, rate, error = evaluated(w, x)
            dw = correction(R)
            x = None if x0 is None else x0 + half * rate
            new = w - dw
            if history is not None:
                new, history = accelerate(history, w, new, largest(dw))
            return (new, x, force, rate, error, dw, history), None

        at, _ = once((v0, x0, History.start(v0) if model.topology.frames else None))
        first = at[-2]
        more = self.evaluations - 1
        if self.evaluations * model.nv <= WRITTEN_UP_TO:
            for _ in range(more):
                at, _ = once(at)
        else:
            again = jax.checkpoint(once, prevent_cse=False)
            at, _ = jax.lax.scan(again, at, None, length=more)
        w, _, force, rate, error, last, _ = at
        q = field.retract(q0, dt * w)
        v = velocity_of(model, q, carried(model.topology, half, w, p0, force))
        digits = float(jnp.finfo(q.dtype).eps) ** 0.5 * (1 + largest(q0)) / dt
        kept = jnp.maximum(largest(first) / 2, LOST * largest(w))
        v = jnp.where(largest(last) > jnp.maximum(kept, digits), jnp.nan, v)
        return State(q, v, None if x0 is None else x0 + dt * rate, *field.kept(state, error))


variational_midpoint = VariationalMidpoint()


def implicit_stiffness(top: Topology, slopes: Sequence[Slope], h: Any) -> dict[int, Lane]:
    """Compute h D / 2 + h^2 K / 4 of the forces on single joints, by dof, where it is positive.

    A force with several moment arms r_i on a joint counts as the diagonal |r_i| sum |r_j|, which is
    at least r r^T. It is r_i^2 if the other arms are zero.
    """
    joints = {at + k: j for j, at in enumerate(top.joint_v) for k in range(top.joints[j].nv)}
    out: dict[int, Lane] = {}
    for slope in slopes:
        arms = {i: jnp.abs(r) for i, r in slope.arms.items() if not is_zero(r)}
        on = {joints[i] for i in arms}
        weight = add(mul(h / 2, slope.damping), mul(h * h / 4, slope.stiffness))
        if is_zero(weight) or len(on) != 1 or slope.along is not None:
            continue
        if len(arms) > 1 and any(top.joints[j].quaternion for j in on):
            continue
        weight = mul(jnp.maximum(weight, 0.0), total(arms.values()))
        for i, r in arms.items():
            out[i] = add(out.get(i, 0.0), mul(r, weight))
    return out


def largest(x: jax.Array) -> jax.Array:
    """Compute max |x| over coordinates, without a derivative."""
    return jnp.max(jnp.abs(jax.lax.stop_gradient(x)), 0)


def residual(
    top: Topology, half: Any, w: jax.Array, p: jax.Array, p0: jax.Array, force: jax.Array
) -> jax.Array:
    """Compute the residual p - S E p0 - h/2 J F of the midpoint momentum p.

    On attitudes S, E and J are 3 by 3 functions of half the rotation of the step. Elsewhere they
    are 1. `half` is h / 2, and `force` is F.
    """

    def turned(y: Vec3, p: Vec3, p0: Vec3, force: Vec3) -> Vec3:
        c1, c2, c3 = stumpff(y.dot(y), 1, 2, 3)
        back = _back(y, p0, c1, c2)
        back = back + y.cross(y.cross(back)) * c3
        across = y.cross(force)
        return p - back - (force - across * c2 + y.cross(across) * c3) * half

    return _on_attitudes(top, p - p0 - half * force, turned, half * w, p, p0, force)


def carried(top: Topology, half: Any, w: jax.Array, p0: jax.Array, force: jax.Array) -> jax.Array:
    """Compute the momentum after the step, p1 = E (E p0 + h F).

    For the angular velocities of free and ball joints E rotates by minus half the rotation of the
    step. For other dofs it is 1.
    `half` is h / 2, and `force` is F.
    """

    def turned(y: Vec3, p0: Vec3, force: Vec3) -> Vec3:
        c1, c2 = stumpff(y.dot(y), 1, 2)
        return _back(y, _back(y, p0, c1, c2) + force * (2 * half), c1, c2)

    return _on_attitudes(top, p0 + 2 * half * force, turned, half * w, p0, force)


def with_spin(top: Topology, w: jax.Array, p: jax.Array, rate: jax.Array) -> jax.Array:
    """Compute the force F at the midpoint: p' + w x p for the angular velocities of free and ball
    joints, p' for other dofs."""
    return _on_attitudes(top, rate, lambda w, p, rate: rate + w.cross(p), w, p, rate)


def _back(y: Vec3, p: Vec3, c1: Lane, c2: Lane) -> Vec3:
    """Rotate p by the rotation vector -y: exp(-[y]) p = p - c1 y x p + c2 y x (y x p)."""
    across = y.cross(p)
    return p - across * c1 + y.cross(across) * c2


def _on_attitudes(top: Topology, plain: jax.Array, f: Any, *given: jax.Array) -> jax.Array:
    """Replace the rows of each attitude in `plain` by f of the rows of the given arrays."""
    if not top.turn_starts:
        return plain
    out: list[Lane] = list(plain)
    for span in joint_slices(top):
        if span.attitude:
            by = span.attitude[1]
            out[by] = f(*(Vec3(*x[by]) for x in given))
    return jnp.stack(fusion_barrier(out))
