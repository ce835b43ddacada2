"""Parameters of the constraint problem of a file, and of its explicit contact pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import mujoco
import numpy as np

from rbjax.loading.mjcf.contact_pairs import contact_pairs
from rbjax.loading.mjcf.dropped import inverted_limits
from rbjax.loading.mjcf.fields import Off, is_on
from rbjax.model import SolverParameters

_OVERRIDE = int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)
_SLIDES = 2  # body_simple of a body that only slides along its axes
_EULER = int(mujoco.mjtIntegrator.mjINT_EULER)
#: MuJoCo's integrator -> the integrator of `rb.rollout`
INTEGRATORS = {
    _EULER: "euler_implicit_damping",
    int(mujoco.mjtIntegrator.mjINT_RK4): "rk4",
    int(mujoco.mjtIntegrator.mjINT_IMPLICIT): "implicit",
    int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST): "implicitfast",
    int(mujoco.mjtIntegrator.mjINT_DISCRETE): "discrete",
}
_CONES = {int(mujoco.mjtCone.mjCONE_PYRAMIDAL): "pyramidal"}


def solver_parameters(
    m: mujoco.MjModel, array: Callable, *, limits: bool = True, friction: bool = True
) -> SolverParameters:
    """Read the parameters of limits and friction loss.

    Args:
        array: function that makes a leaf.
        limits, friction: whether joint limits and friction loss are rows of the contact problem.
    """
    solved = is_on(m, Off.mjDSBL_CONSTRAINT)
    limited = m.jnt_limited.astype(bool) & ~inverted_limits(m)
    rubbing = m.dof_frictionloss > 0
    limited &= limits and solved and is_on(m, Off.mjDSBL_LIMIT)
    rubbing &= friction and solved and is_on(m, Off.mjDSBL_FRICTIONLOSS)
    return SolverParameters(
        impratio=array(m.opt.impratio),
        limit_solref=array(m.jnt_solref),
        limit_solimp=array(m.jnt_solimp),
        limit_margin=array(m.jnt_margin),
        frictionloss=array(m.dof_frictionloss),
        friction_solref=array(m.dof_solref),
        friction_solimp=array(m.dof_solimp),
        cone=_CONES.get(int(m.opt.cone), "elliptic"),
        integrator=_integrator(m),
        refsafe=is_on(m, Off.mjDSBL_REFSAFE),
        limited=tuple(np.flatnonzero(limited).tolist()),
        rubbing=tuple(np.flatnonzero(rubbing).tolist()),
        translating=tuple(np.flatnonzero(m.body_simple[1:] == _SLIDES).tolist()),
    )


def _integrator(m: mujoco.MjModel) -> str:
    """Return the name of the file's integrator in `rb.rollout`."""
    kind = int(m.opt.integrator)
    if kind == _EULER and not is_on(m, Off.mjDSBL_EULERDAMP):
        return "semi_implicit_euler"
    return INTEGRATORS[kind]


def pair_fields(
    m: mujoco.MjModel, array: Callable, kept: Sequence[int] | None = None
) -> dict[str, Any]:
    """Read the fields of `Geoms` about pairs.

    If the file overrides the parameters of all contacts, all pairs are explicit. `kept` are the
    positions in `contact_pairs` of the pairs to read; None for all.
    """
    pairs, n = contact_pairs(m), m.npair
    if not pairs:
        n = 0
    friction, solref, solimp = m.pair_friction[:n], m.pair_solref[:n], m.pair_solimp[:n]
    margin, gap, condim = m.pair_margin[:n], m.pair_gap[:n], m.pair_dim[:n].tolist()
    tangential = m.pair_solreffriction[:n]
    if m.opt.enableflags & _OVERRIDE:
        others = np.array(pairs[n:], int).reshape(-1, 2)
        one, other = others.T
        own, priority = m.geom_condim, m.geom_priority
        first, second = priority[one] > priority[other], priority[one] < priority[other]
        larger = np.maximum(own[one], own[other])
        condim += np.where(first, own[one], np.where(second, own[other], larger)).tolist()
        gap = np.concatenate([gap, m.geom_gap[one] + m.geom_gap[other]])
        n = len(pairs)
        friction, solref, solimp = (
            np.tile(x, (n, 1)) for x in (m.opt.o_friction, m.opt.o_solref, m.opt.o_solimp)
        )
        margin, tangential = np.full(n, m.opt.o_margin), solref
    fields = {
        "friction": friction, "solref": solref, "solreffriction": tangential, "solimp": solimp,
        "margin": margin, "gap": gap,
    }  # fmt: skip
    kept = range(len(pairs)) if kept is None else kept
    own = [i for i in kept if i < n]
    leaves: dict[str, jax.Array] = {f"pair_{name}": array(x[own]) for name, x in fields.items()}
    chosen = tuple(pairs[i] for i in kept)
    return leaves | {"pairs": chosen, "pair_condim": tuple(condim[i] for i in own)}
