"""The geoms of a compiled MuJoCo model."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from rbjax.loading.mjcf.names import names_of
from rbjax.model.geoms import Geoms


def geoms_of(m: mujoco.MjModel, array: Callable) -> Geoms:
    """All geoms, in the file's order. array: makes a leaf of a model."""

    def static(x: np.ndarray) -> tuple:
        return tuple(x.tolist())

    colors = [m.geom_rgba[i] if k < 0 else m.mat_rgba[k] for i, k in enumerate(m.geom_matid)]
    return Geoms(
        size=array(m.geom_size),
        position=array(m.geom_pos),
        orientation=array(m.geom_quat),
        friction=array(m.geom_friction),
        solref=array(m.geom_solref),
        solimp=array(m.geom_solimp),
        margin=array(m.geom_margin),
        gap=array(m.geom_gap),
        names=names_of(m, mujoco.mjtObj.mjOBJ_GEOM, m.ngeom),
        types=tuple(mujoco.mjtGeom(int(t)).name[7:].lower() for t in m.geom_type),
        bodies=static(m.geom_bodyid - 1),
        contype=static(m.geom_contype),
        conaffinity=static(m.geom_conaffinity),
        condim=static(m.geom_condim),
        priority=static(m.geom_priority),
        group=static(m.geom_group),
        rgba=tuple(tuple(x.tolist()) for x in colors),
    )
