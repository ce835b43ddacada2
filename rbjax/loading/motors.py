"""Motors for robots whose file names none, as URDFs do."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from rbjax.model import Model


def with_motors(model: Model) -> Model:
    """The model with a motor of gear 1 on each hinge and slide that no actuator drives.

    A motor has its joint's name; its control is a torque in N m or a force in N, and the joint's
    force range (a URDF's effort) limits it.
    """
    top, old = model.topology, model.actuators
    free = [
        j
        for j, kind in enumerate(top.joint_kinds)
        if kind in ("hinge", "slide") and j not in old.joints
    ]
    n = len(free)

    def more(x, rows):
        return jnp.concatenate([x, jnp.asarray(rows, x.dtype).reshape(n, *x.shape[1:])])

    unit, endless = np.eye(6)[[0] * n], np.tile([-np.inf, np.inf], (n, 1))
    actuators = dataclasses.replace(
        old,
        gear=more(old.gear, unit),
        gain=more(old.gain, unit[:, :3]),
        bias=more(old.bias, np.zeros((n, 3))),
        ctrlrange=more(old.ctrlrange, endless),
        forcerange=more(old.forcerange, endless),
        joints=(*old.joints, *free),
        sites=(*old.sites, *[-1] * n),
    )
    names = (*top.actuator_names, *(top.joint_names[j] for j in free))
    keys = model.keyframes
    ctrl = jnp.concatenate([keys.ctrl, jnp.zeros((len(keys.ctrl), n), keys.ctrl.dtype)], 1)
    return dataclasses.replace(
        model,
        actuators=actuators,
        topology=dataclasses.replace(top, actuator_names=names),
        keyframes=dataclasses.replace(keys, ctrl=ctrl),
    )
