"""The names of the elements of a compiled MuJoCo model."""

from __future__ import annotations

import mujoco


def names_of(m: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> tuple[str, ...]:
    """The names of joints, bodies, ...; one without a name is named by its index, as joint0."""
    return tuple(
        mujoco.mj_id2name(m, kind, i) or f"{kind.name[6:].lower()}{i}" for i in range(count)
    )
