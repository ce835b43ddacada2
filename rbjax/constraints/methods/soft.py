"""Rows that yield, as MuJoCo's do.

    g'' + R f = -b g' - d k g,     g'' = G a + G' v,     R = (1 - d) / d w
f, the force on a row, is what is left of the multiplier; w its inverse inertia, a number of the
row; d its impedance, between 0 and 1, a function of how far the constraint is off, r = |g|:

    d(r) = d_0 + (d_w - d_0) y(r / width),   y(x) = x^p / m^(p-1) up to m,
                                             1 - (1 - x)^p / (1 - m)^(p-1) above, 1 from x = 1 on
and their mean where the width is zero;
k, b from solref = (time constant T, damping ratio z): k = 1 / (d_w T z)^2, b = 2 / (d_w T); or,
where its numbers are not above zero, from (-stiffness, -damping): k = stiffness / d_w^2,
b = damping / d_w.

MuJoCo 4 has G' v in connects and welds, and not in the couplings of joints; MJX has it nowhere.
(MuJoCo, *Computation*, constraint model; Todorov 2014)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.equations.constrained_motion import (
    OnMatrices,
    Solve,
    System,
    asked,
    constrained_motion,
)
from rbjax.constraints.equations.model_rows import gradient_matrix, jacobian
from rbjax.constraints.methods.method import Method
from rbjax.constraints.rows.row import Constraint, Row
from rbjax.dynamics.algorithms.aba import aba
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.dynamics.drivers.choice import Driver
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.lanes import Lane, sub
from rbjax.lanes.arrays import matvec, pack
from rbjax.model import Model, State
from rbjax.model.record import check_fields, floats

#: within which MuJoCo holds impedances and the place of their middle
IMPEDANCES = 1e-4, 0.9999
#: a width below which it is none
LEAST = 1e-15
SOLREF = (0.02, 1.0)
SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)


class Soft(Constraint):
    """A constraint whose rows yield under the formulation "compliant"; others hold them as ever.

    Fields: of, the constraint; solref (2,), (time constant s, damping ratio) or (-stiffness 1/s^2,
    -damping 1/s); solimp (5,), d_0, d_w, width in the unit of its rows, m, p; weight (rows,), the
    inverse inertias of the rows. Static: bias, whether g'' has its part G' v.

    Source: MuJoCo, *Computation*, constraint model, parameters.

    Example:
        >>> import rbjax as rb
        >>> from rbjax import constraints as rc
        >>> model = rb.load("double_pendulum")
        >>> tip = rc.Inplane.between(model, None, "lower", point=[0.0, 0.0, 1.2])
        >>> model = model.with_constraints(rc.Soft.on(model, tip, solref=(0.01, 1.0)))
        >>> path = rb.rollout(model, model.default_state(), None, 1e-3, steps=9)
    """

    of: Constraint
    solref: jax.Array = eqx.field(converter=floats)
    solimp: jax.Array = eqx.field(converter=floats)
    weight: jax.Array = eqx.field(converter=floats)
    bias: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        if not isinstance(self.of, Constraint) or isinstance(self.of, Soft):
            raise InputError(
                f"Soft(of=...): got {type(self.of).__name__}, expected a Constraint that is not "
                "soft already"
            )
        check_fields(self)
        for name, due in {"solref": (2,), "solimp": (5,), "weight": (self.of.size,)}.items():
            if jnp.shape(getattr(self, name)) != due:
                raise InputError(
                    f"Soft({name}=...): got the shape {jnp.shape(getattr(self, name))}, "
                    f"expected {due}"
                )
        if not isinstance(self.solref, jax.core.Tracer):
            first, second = np.asarray(self.solref)
            if (first > 0) != (second > 0):
                raise InputError(
                    f"Soft(solref=...): got {[float(first), float(second)]}, expected two numbers "
                    "above zero (time constant, damping ratio), or none (-stiffness, -damping)"
                )

    @classmethod
    def on(
        cls,
        model: Model,
        of: Constraint,
        solref: Any = SOLREF,
        solimp: Any = SOLIMP,
        q: jax.Array | None = None,
    ) -> Soft:
        """A constraint with the weights diag(G M^-1 G^T) that it has in a configuration (nq,); the
        model's default state if None."""
        q = model.default_state().q if q is None else q
        G = jacobian(model.replace(constraints=(of,)), q)
        weight = (G * jnp.linalg.solve(mass_matrix(model, q), G.T).T).sum(-1)
        return cls(of, solref, solimp, weight)

    @property
    def size(self) -> int:
        return self.of.size

    def rows(self, now: Context) -> Sequence[Row]:
        return self.of.rows(now)

    def yielding(self, rows: Sequence[Row], dtype: Any) -> tuple[list[Lane], list[Lane]]:
        """R, and what g'' + R f shall be, of its rows."""
        low, high, width, middle, power = self.solimp.astype(dtype)
        low, high, middle = (jnp.clip(x, *IMPEDANCES) for x in (low, high, middle))
        g = jnp.stack([jnp.asarray(row.residual, dtype) for row in rows])
        rate = jnp.stack([jnp.asarray(row.rate, dtype) for row in rows])
        d = impedance(_norm(g), low, high, width, middle, jnp.maximum(power, 1.0))
        k, b = reference(self.solref.astype(dtype), high)
        asked = -b * rate - d * k * g
        R = (1 - d) / d * self.weight.astype(dtype)
        return list(R), list(asked)


def is_soft(model: Model) -> bool:
    """Whether a model has a `Soft` constraint. If so, "compliant" is the default formulation."""
    return any(isinstance(x, Soft) for x in model.constraints)


def reference(solref: jax.Array, high: jax.Array) -> tuple[jax.Array, jax.Array]:
    """k 1/s^2 and b 1/s."""
    direct = solref[0] <= 0
    time, ratio = jnp.where(direct, 1.0, solref)
    k = jnp.where(direct, -solref[0], 1 / (time * ratio) ** 2) / high**2
    return k, jnp.where(direct, -solref[1], 2 / time) / high


def impedance(r: jax.Array, low: Any, high: Any, width: Any, middle: Any, power: Any) -> jax.Array:
    """d at a distance r."""
    x = jnp.minimum(r / jnp.maximum(width, LEAST), 1.0)
    inner = x**power / middle ** (power - 1)
    outer = 1 - (1 - x) ** power / (1 - middle) ** (power - 1)
    y = jnp.where(x <= middle, inner, outer)
    return low + (high - low) * jnp.where(width > LEAST, y, 0.5)


def _norm(g: jax.Array) -> jax.Array:
    """|g|, with the derivative zero at zero."""
    square = (g * g).sum()
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def softness(
    now: Context, rows: Sequence[Row], alpha: Any = 0.0, beta: Any = 0.0
) -> tuple[jax.Array, jax.Array]:
    """R (rows,), zero where a constraint is not soft, and what is left of the rows' equations at
    the accelerations of the instant without forces on them: asked - g''; of rigid ones those of
    Baumgarte's feedback."""
    R: list[Any] = []
    left: list[Any] = []
    a = now.a
    done = matvec(gradient_matrix(now, rows), a)
    for constraint in now.model.constraints:
        at = slice(len(R), len(R) + constraint.size)
        has = [row.acceleration for row in rows[at]]
        if isinstance(constraint, Soft):
            own, wanted = constraint.yielding(rows[at], a.dtype)
            R += own
            has = has if constraint.bias else list(done[at])
            left += [sub(x, y) for x, y in zip(wanted, has, strict=True)]
        else:
            R += [jnp.zeros((), a.dtype)] * constraint.size
            left += [asked(row, alpha, beta) for row in rows[at]]
    return jnp.stack(R), pack(left, a)


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
