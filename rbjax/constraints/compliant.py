"""Rows that yield (`Soft`), held as MuJoCo holds them; rows that do not, beside them.

    M a + b = tau + sum of J_i^T f_i + G^T f
    g'' + R f = -b g' - d k g     of soft rows;        g'' = 0     of others
so (A + R) f = (what is asked) - g''(a_0): with equalities only, MuJoCo's convex problem is linear.

How near it is to rigid rows. The residual and the motion's distance from the rigid one fall as the
square of the time constant T, as 1 / k. MuJoCo's four-bar after 0.25 s of its fall, T halved from
0.02 s on: 6.6e-4, 1.9e-4, 4.9e-5, 1.2e-5, 3.1e-6 rad beside the rigid one
(`tests/loading/test_compliant.py`).
(MuJoCo, *Computation*, constraint model; Todorov 2014)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from rbjax.constraints.formulation import Formulation
from rbjax.constraints.projection import projected
from rbjax.constraints.soft import Soft, softness
from rbjax.constraints.system import OnMatrices, gradient_matrix, rows_of, with_multipliers
from rbjax.dynamics.aba import aba
from rbjax.dynamics.drivers import driver
from rbjax.dynamics.link_forces import LinkForces
from rbjax.dynamics.rnea import rnea
from rbjax.dynamics.tracing import split_tracers, with_implicit_jvp
from rbjax.forces.instant import Instant
from rbjax.model import Model, State


@dataclass(frozen=True)
class Compliant(Formulation):
    """Index 0 in soft rows, by MuJoCo's law; 1 in others, which are put back on their constraints
    after each step.

    Enforces the models of `rb.load(file, compliant=True)`, and those with a `Soft` if no other
    formulation is named. An explicit step needs T well above it, as MuJoCo's own (twice there).

    Source: MuJoCo, *Computation*, constraint model.
    """

    name: ClassVar[str] = "compliant"
    family: ClassVar[str] = "unconstrained"
    index: ClassVar[int] = 0

    def __call__(self, model, t, state, tau, pushes):
        return compliant_motion(model, t, state, tau, pushes)[0]

    def settled(self, model: Model, t: Any, state: State) -> State:
        held = tuple(x for x in model.constraints if not isinstance(x, Soft))
        return projected(model.replace(constraints=held), t, state) if held else state


def compliant_motion(
    model: Model, t: Any, state: State, tau: jax.Array, pushes: LinkForces
) -> tuple[jax.Array, jax.Array]:
    """a (nv,) and the forces f (rows,) on the rows, of a sample."""
    given, rebuilt = split_tracers((model, pushes, t))
    known_model, nv = not split_tracers(model)[0], model.nv

    def run(changed, q, v, tau, values=False):
        model, pushes, t = rebuilt(changed)
        d = driver(model, q.dtype, values=values)
        now = Instant.of(model, t, State(q, v), None, d=d)
        qdd, factors = aba(d, now.links.joints, d.lanes(tau), d.prepared.gravity, pushes)
        a = d.pack(qdd, tau)
        now = now.accelerating(a)
        rows = rows_of(model, now)
        system = OnMatrices(d, factors, now, rows)
        R, left = softness(model, rows, a, system.G)
        system = system.with_compliance(R)
        da, f = system.solved(None, list(left))
        return jnp.concatenate([a + da, f]), system

    def plain(changed, q, v, tau):
        return run(changed, q, v, tau, values=known_model)[0]

    def solved(changed, q, v, tau):
        x, system = run(changed, q, v, tau)

        def solution(change):
            return jnp.concatenate(system.solved(change[:nv], list(change[nv:])))

        return x, solution

    def residual(changed, q, v, tau, x):
        model, pushes, t = rebuilt(changed)
        a, f = x[:nv], x[nv:]
        d = driver(model, q.dtype)
        now = Instant.of(model, t, State(q, v), None, d=d).accelerating(a)
        rows = rows_of(model, now)
        R, left = softness(model, rows, a, gradient_matrix(now, rows))
        joints = now.links.joints  # first: a driver learns from them what its lanes are
        tau, pushes = with_multipliers(d, rows, list(f), tau, pushes)
        forces = rnea(d, joints, d.lanes(a), d.prepared.gravity, pushes)
        return jnp.concatenate([tau - d.pack(forces, tau), left - R * f])

    found = with_implicit_jvp(plain, solved, residual)(given, state.q, state.v, tau)
    return found[:nv], found[nv:]
