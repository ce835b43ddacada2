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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax

from rbjax.constraints.equations.law import Solve, System, constrained_motion
from rbjax.constraints.equations.system import OnMatrices
from rbjax.constraints.methods.method import Method
from rbjax.constraints.methods.soft import Soft, softness
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.aba import aba
from rbjax.dynamics.algorithms.link_forces import LinkForces
from rbjax.dynamics.drivers.choice import Driver
from rbjax.forces.context import Context
from rbjax.lanes import Lane
from rbjax.model import Model, State


@dataclass(frozen=True)
class Compliant(Method):
    """Index 0 in soft rows, by MuJoCo's law; 1 in others. Feedback and projection apply to others
    only.

    With a projection it is "compliant" of `rb.constraints.formulations()`, which enforces the
    models of `rb.load(file, compliant=True)`, and those with a `Soft` if no other formulation is
    given. An explicit step needs T well above it, as MuJoCo's own (twice there).

    Source: MuJoCo, *Computation*, constraint model.
    """

    name: ClassVar[str] = "compliant"
    family: ClassVar[str] = "unconstrained"
    index: ClassVar[int] = 0

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        return compliant_motion(model, t, state, tau, f_ext, alpha, beta)[0]

    def projected_rows(self, model: Model) -> Model:
        rigid = tuple(x for x in model.constraints if not isinstance(x, Soft))
        return model.replace(constraints=rigid)


def compliant_motion(
    model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces,
    alpha: Any = 0.0, beta: Any = 0.0,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """a (nv,) and the forces f (rows,) on the rows, of a sample."""
    return constrained_motion(
        model, t, state, tau, f_ext, alpha, beta, method=yielding, left_of=left_of
    )


def yielding(
    d: Driver, now: Context, tau: jax.Array, f_ext: LinkForces
) -> tuple[jax.Array, None, System]:
    """From free motion on: (A + R) df = c - G M^-1 f."""
    qdd, factors = aba(d, now.links.joints, d.lanes(tau), d.prepared.gravity, f_ext)

    def system(now: Context, rows: Sequence[Row]) -> Solve:
        return OnMatrices(d, factors, now, rows, R=softness(now, rows)[0]).solved

    return d.pack(qdd, tau), None, system


def left_of(
    now: Context, rows: Sequence[Row], f: jax.Array | None, alpha: Any, beta: Any
) -> Sequence[Lane]:
    """The right-hand side - g'' - R f."""
    R, left = softness(now, rows, alpha, beta)
    return list(left if f is None else left - R * f)
