"""Numbers that are not finite: MuJoCo compiles them, and the loader rejects them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rbjax.errors import ModelError
from rbjax.model.record import Record

#: leaves in which infinite means that there is no limit
_LIMITS = ("range", "limits", "windup", "slew", "drive", "current_rate", "strongest")


def refuse_nan(record: Record) -> None:
    """Refuse a force element of numbers that are not finite."""
    for at, leaf in jax.tree_util.tree_leaves_with_path(record):
        name, values = jax.tree_util.keystr(at).lstrip("."), np.asarray(leaf)
        bad = np.isnan(values) if name.endswith(_LIMITS) else ~np.isfinite(values)
        if bad.any():
            raise ModelError(
                f"the compiled model has {type(record).__name__}.{name} = {values[bad][0]}, which "
                f"is not finite; correct that number in the file"
            )


def within_range(x: np.ndarray) -> jax.Array:
    """Cast numbers of a file to JAX's default dtype. Raise if a finite number overflows."""
    with np.errstate(over="ignore"):
        out = x.astype(jax.dtypes.canonicalize_dtype(x.dtype))
    lost = np.isfinite(x) & ~np.isfinite(out)
    if lost.any():
        raise ModelError(
            f"the file has the number {x[lost][0]}, which is too large for {out.dtype}; correct "
            "it, or enable float64: jax.config.update('jax_enable_x64', True)"
        )
    return jnp.asarray(out)


def refuse_nan_in(m: mujoco.MjModel) -> None:
    """Reject a compiled model with numbers that are not finite. MuJoCo only warns of them."""
    fields = "qpos0 qpos_spring body_mass body_ipos body_iquat body_inertia body_pos body_quat"
    fields += " jnt_pos jnt_axis jnt_stiffness dof_armature dof_damping site_pos site_quat"
    fields += " actuator_gear actuator_gainprm actuator_biasprm key_qpos key_qvel key_ctrl"
    for name in fields.split():
        values = np.asarray(getattr(m, name))
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            raise ModelError(
                f"the compiled model has {name}[{int(bad[0][0])}] = {values[bad[0][0]]}, which is "
                f"not finite; correct that number in the file"
            )
    for name in ["jnt_range", "jnt_actfrcrange", "actuator_ctrlrange", "actuator_forcerange"]:
        bad = np.argwhere(np.isnan(getattr(m, name)))
        if len(bad):
            raise ModelError(
                f"the compiled model has {name}[{int(bad[0][0])}] = {getattr(m, name)[bad[0][0]]}, "
                f"expected two numbers, which may be infinite; correct them in the file"
            )
    if not np.isfinite(m.opt.gravity).all():
        raise ModelError(f"gravity is {m.opt.gravity}, which is not finite; correct the file")
