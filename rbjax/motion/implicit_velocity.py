"""Steps that are implicit in the velocity, with the derivatives of the forces by velocity.

    (M + h D) (v+ - v) / h = M a(q, v),      q+ = q (+) h v+

a is the acceleration with all forces and contacts at the start of the step. D is a part of the
derivative -d(tau - b)/dv of the forces:

    euler_implicit_damping      the dampers of joints, a diagonal matrix
    implicitfast                the symmetric part of -d tau/dv: dampers of joints and tendons,
                                actuators, fluid; and -d(tau - b)/dv of bodies that float freely
    implicit                    -d(tau - b)/dv

With D = 0 it is semi-implicit Euler. The order is 1. Contact forces are those of the mass matrix M,
as in MuJoCo, so stiff dampers weaken them (MuJoCo, *Computation*, numerical integration).
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from typing import Any

from rbjax.constraints.formulation import Formulation
from rbjax.contact.soft import SoftContact
from rbjax.dynamics.algorithms.derivatives import bias_derivative
from rbjax.dynamics.algorithms.energy import Entries, product, velocity_of
from rbjax.errors import InputError
from rbjax.forces.element import Element
from rbjax.forces.inputs import Inputs
from rbjax.forces.slopes import matrix
from rbjax.forces.tendons.tendon_weights import armature_entries
from rbjax.lanes import Lane, add, mul
from rbjax.model import WORLD, Model, State, Topology
from rbjax.motion.field import Field, free_motion


@dataclass(frozen=True)
class ImplicitVelocity:
    """Integrator of `rollout` that is implicit in the velocity.

    name: the integrator's name.
    of: the class of force elements whose damping is in the matrix D of the module's formula.
    """

    name: str
    of: type[Element] = Element

    def __call__(self, field: Field, t: Any, state: State, u: Inputs, dt: Any) -> State:
        if isinstance(field.dynamics, Formulation):
            raise InputError(
                f"integrator {self.name!r} changes the acceleration after the constraint forces "
                "are known, so the constraints of the model would not hold; expected "
                "'semi_implicit_euler', or 'variational_midpoint' for stiff dampers"
            )
        model, q = field.precomputed, state.q
        damping = self._damping(field, t, state, u, dt)
        entries = {at: mul(dt, d) for at, d in damping.items()}
        if field.dynamics is free_motion:
            force, x, kept = field.inertial_force(t, state, u, dt)
            a = velocity_of(model, q, force, entries)
        elif isinstance(field.dynamics, SoftContact) and is_diagonal(model, q, entries):
            a, x, kept = field.damped_acceleration(t, state, u, dt, entries)
        else:  # (M + h D)^-1 M a = a - (M + h D)^-1 h D a
            a, x, kept = field.acceleration(t, state, u, dt)
            if entries:
                loss, left = product(entries, a), dict(entries)
                for at, m in armature_entries(model, q).items():
                    left[at] = add(left.get(at, 0.0), m)
                a = a - velocity_of(model, q, loss, left)
        v = state.v + dt * a
        return State(field.retract(state.q, dt * v), v, x, *kept)

    def _damping(self, field: Field, t: Any, state: State, u: Inputs, dt: Any) -> dict:
        """Compute the entries (i, j) -> value of the implicit damping matrix D."""
        model = field.precomputed
        turning = self._with_bias(model.topology)
        found = field.slopes(t, state, u, dt, of=self.of)
        out: dict[tuple[int, int], Lane] = matrix(found, lambda slope: slope.damping, turning)
        if turning:
            bias = bias_derivative(model, state.q, state.v)
            for i, j in coupled(model.topology, turning):
                out[i, j] = add(out.get((i, j), 0.0), bias[i, j])
        return out

    def _with_bias(self, top: Topology) -> Container[int]:
        """Return the dofs whose bias forces are implicit."""
        if self.name == "implicit":
            return range(top.nv)
        return floating(top) if self.name == "implicitfast" else ()


def is_diagonal(model: Model, q: Any, entries: Entries) -> bool:
    """Return whether the matrix D has entries, all on the diagonal, and M none of tendons."""
    return bool(entries) and all(i == j for i, j in entries) and not armature_entries(model, q)


def floating(top: Topology) -> set[int]:
    """Return the dofs of bodies that float freely and carry no joint."""
    out: set[int] = set()
    for kind, at in zip(top.joint_kinds, top.joint_v, strict=True):
        own = range(at, at + 6)
        carries = any(p in own for i, p in enumerate(top.parents) if i not in own)
        if kind == "free" and top.parents[at] == WORLD and not carries:
            out |= set(own)
    return out


def coupled(top: Topology, dofs: Container[int]) -> list[tuple[int, int]]:
    """List the pairs of dofs that the tree couples."""
    paths = enumerate(top.ancestors[: top.nv])
    pairs = [(i, j) for i, path in paths for j in path if i in dofs and j < top.nv]
    return [*pairs, *((j, i) for i, j in pairs if i != j)]
