"""The constraints of a compiled MuJoCo model: its equalities.

    connect                   Spherical
    weld                      Weld; Spherical where torquescale is zero
    joint                     JointPolynomial
They hold exactly. MuJoCo's are soft, as `solref` and `solimp` say: so are these if `compliant` is
asked for, with the same accelerations (`Soft`, of a weld `QuaternionWeld`). torquescale only weighs
rotation against translation there.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.constraints import (
    Constraint,
    JointPolynomial,
    Place,
    QuaternionWeld,
    Soft,
    Spherical,
    Weld,
)
from rbjax.errors import ModelError

_KIND = mujoco.mjtEq
_LOADED = {int(_KIND.mjEQ_CONNECT), int(_KIND.mjEQ_WELD), int(_KIND.mjEQ_JOINT)}
_TERMS = 5  # of MuJoCo's polynomials


def constraints_of(m: mujoco.MjModel, *, compliant: bool = False) -> tuple[Constraint, ...]:
    """The equalities that are on and have a kind here, in the file's order."""
    found = []
    if equalities_are_on(m):
        for i in np.flatnonzero(m.eq_active0).tolist():
            if is_loaded(m, i) and _moves(m, i):
                _refuse_nan(m, i)
                found.append(_soft(m, i) if compliant else _constraint(m, i))
    return tuple(found)


def equalities_are_on(m: mujoco.MjModel) -> bool:
    """Whether the file has not switched all equalities off."""
    bits = mujoco.mjtDisableBit
    return not m.opt.disableflags & (int(bits.mjDSBL_CONSTRAINT) | int(bits.mjDSBL_EQUALITY))


def is_loaded(m: mujoco.MjModel, i: int) -> bool:
    """Whether equality i is of a kind that loads."""
    return int(m.eq_type[i]) in _LOADED


def _refuse_nan(m: mujoco.MjModel, i: int) -> None:
    numbers = m.eq_data[i]
    bad = numbers[~np.isfinite(numbers)]
    if bad.size:
        name = mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_EQUALITY, i) or i
        raise ModelError(
            f"equality {name!r} has {bad[0]} among its numbers, which is not finite; correct that "
            "number in the file"
        )


def _constraint(m: mujoco.MjModel, i: int) -> Constraint:
    kind, data = int(m.eq_type[i]), m.eq_data[i]
    first, second = int(m.eq_obj1id[i]), int(m.eq_obj2id[i])
    if kind == int(_KIND.mjEQ_JOINT):
        driver = None if second < 0 else second
        return JointPolynomial(first, driver, _array(data[:_TERMS]))
    is_weld = kind == int(_KIND.mjEQ_WELD)
    if _has_sites(m, i):
        a, b = (Place.on(site=s) for s in (first, second))
    elif is_weld:  # of the second body its anchor, of the first where that is in it, and its axes
        a = _on_body(first, data[3:6], data[6:10])
        b = _on_body(second, data[:3])
    else:
        a, b = _on_body(first, data[:3]), _on_body(second, data[3:6])
    return (Weld if is_weld and data[10] != 0 else Spherical)(a, b)


def _soft(m: mujoco.MjModel, i: int) -> Soft:
    """An equality with its softness; a time constant is at least two of the file's steps, unless
    the file switches that off."""
    one = _constraint(m, i)
    if isinstance(one, Weld):
        one = QuaternionWeld(one.a, one.b, _array(m.eq_data[i, 10]))
    solref = m.eq_solref[i].copy()
    if solref[0] > 0 and not m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_REFSAFE):
        solref[0] = max(solref[0], 2 * m.opt.timestep)
    solref, solimp, weight = map(_array, (solref, m.eq_solimp[i], _weights(m, i, one.size)))
    return Soft(one, solref, solimp, weight, bias=not isinstance(one, JointPolynomial))


def _weights(m: mujoco.MjModel, i: int, rows: int) -> np.ndarray:
    """MuJoCo's estimate of diag(G M^-1 G^T), from the file's own configuration."""
    ends = np.array([m.eq_obj1id[i], m.eq_obj2id[i]])
    if int(m.eq_type[i]) == int(_KIND.mjEQ_JOINT):
        return m.dof_invweight0[m.jnt_dofadr[ends[ends >= 0]]].sum(keepdims=True)
    bodies = m.site_bodyid[ends] if _has_sites(m, i) else ends
    along, about = m.body_invweight0[bodies].sum(0)
    return np.array([along] * 3 + [about] * (rows - 3))


def _on_body(body: int, point: np.ndarray, quat: np.ndarray | None = None) -> Place:
    return Place(_array(point), _quaternion(quat), body - 1 if body else None)


def _quaternion(quat: np.ndarray | None) -> jax.Array:
    return _array([1.0, 0.0, 0.0, 0.0] if quat is None else quat / np.linalg.norm(quat))


def _has_sites(m: mujoco.MjModel, i: int) -> bool:
    return int(m.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_SITE)


def _moves(m: mujoco.MjModel, i: int) -> bool:
    """Whether a joint lies between the two bodies; else MuJoCo has no rows of it either."""
    if int(m.eq_type[i]) == int(_KIND.mjEQ_JOINT):
        return True
    ends = np.array([m.eq_obj1id[i], m.eq_obj2id[i]])
    bodies = m.site_bodyid[ends] if _has_sites(m, i) else ends
    first, second = m.body_weldid[bodies]
    return bool(first != second)


def _array(x: Any) -> jax.Array:
    return jnp.asarray(np.asarray(x, np.float64))
