"""Motors for robots whose file names none, as URDFs do."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from rbjax.constraints import JointPolynomial
from rbjax.forces.actuators.actuator import Actuator
from rbjax.forces.actuators.transmissions import SiteWrench
from rbjax.forces.instant import Instant
from rbjax.model import Model


def with_motors(model: Model) -> Model:
    """The model with a motor of gear 1 on each hinge and slide that no actuator drives and that
    follows no other joint.

    A motor has its joint's name, followed by "_motor" if an actuator has that name. Its control is
    a torque in N m or a force in N. The joint's force range (a URDF's effort) limits it.
    """
    top, old = model.topology, model.actuators
    taken = _driven(model) | _followers(model)
    free = [
        j
        for j, kind in enumerate(top.joint_kinds)
        if kind in ("hinge", "slide") and j not in taken
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
    names = top.actuator_names
    for j in free:
        name = top.joint_names[j]
        while name in names:
            name += "_motor"
        names = (*names, name)
    keys = model.keyframes
    ctrl = jnp.concatenate([keys.ctrl, jnp.zeros((len(keys.ctrl), n), keys.ctrl.dtype)], 1)
    return dataclasses.replace(
        model,
        actuators=actuators,
        topology=dataclasses.replace(top, actuator_names=names),
        keyframes=dataclasses.replace(keys, ctrl=ctrl),
    )


def _driven(model: Model) -> set[int]:
    """The joints that an actuator drives by a joint or tendon transmission. A wrench at a site does
    not count as a motor of the joints that carry the site."""
    top = model.topology
    driven = set(model.actuators.joints)
    elements = [e for e in model.forces if isinstance(e, Actuator)]
    transmissions = [e.transmission for e in elements if not isinstance(e.transmission, SiteWrench)]
    if transmissions:
        now = Instant.of(model, 0.0, model.default_state(), None)
        dofs = {i for one in transmissions for i in one.reach(now).arms}
        driven |= {top.links[i].joint for i in dofs}
    return driven


def _followers(model: Model) -> set[int]:
    """The joints that a mimic or a joint equality couples to another joint, or holds."""
    couplings = [c for c in model.constraints if isinstance(c, JointPolynomial)]
    return {model.joint(c.joint) for c in couplings}
