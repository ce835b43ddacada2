"""Motors for robots whose file has no actuators, as URDFs do."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints import JointPolynomial
from rbjax.forces.acting import elements
from rbjax.forces.actuators.actuator import Actuator, Affine, GainBias
from rbjax.forces.actuators.affine import from_columns, to_columns
from rbjax.forces.actuators.transmissions import JointAxis, SiteWrench
from rbjax.forces.context import Context
from rbjax.model import Model

_UNLIMITED = np.array([-np.inf, np.inf])


def with_motors(model: Model) -> Model:
    """The model with a motor of gear 1 on each hinge and slide that no actuator drives and that
    follows no other joint.

    A motor has its joint's name, followed by "_motor" if an actuator has that name. Its control is
    a torque in N m or a force in N. The joint's force range (a URDF's effort) limits it.
    """
    top, keys = model.topology, model.keyframes
    taken = _driven(model) | _followers(model)
    kinds = enumerate(top.joint_kinds)
    free = [j for j, kind in kinds if kind in ("hinge", "slide") and j not in taken]
    names = top.actuator_names
    for j in free:
        name = top.joint_names[j]
        while name in names:
            name += "_motor"
        names = (*names, name)
    motors = [_motor(j, control) for control, j in enumerate(free, model.nu)]
    columns = to_columns((*from_columns(model), *motors), len(names))
    ctrl = jnp.pad(keys.ctrl, ((0, 0), (0, len(free))))
    return dataclasses.replace(
        model,
        actuators=jax.tree.map(lambda x: jnp.asarray(x, model.gravity.dtype), columns),
        topology=dataclasses.replace(top, actuator_names=names),
        keyframes=dataclasses.replace(keys, ctrl=ctrl),
    )


def _motor(joint: int, control: int) -> Actuator:
    one: Any = np.ones(1)
    unit: Any = np.eye(6)[0]
    limits: Any = _UNLIMITED
    law = GainBias(Affine(one), None, None)
    return Actuator(JointAxis(unit, joint), law, limits[None], limits, (control,))


def _driven(model: Model) -> set[int]:
    """The joints that an actuator drives by a joint or tendon transmission. A wrench at a site does
    not count as a motor of the joints that carry the site."""
    transmissions = [x.transmission for x in elements(model) if isinstance(x, Actuator)]
    now = Context.of(model, 0.0, model.default_state(), None)
    dofs = {
        i for x in transmissions if not isinstance(x, SiteWrench) for i in x.reach(now).arms
    }  # fmt: skip
    return {model.topology.dofs[i].joint for i in dofs}


def _followers(model: Model) -> set[int]:
    """The joints that a mimic or a joint equality couples to another joint, or holds."""
    couplings = [c for c in model.constraints if isinstance(c, JointPolynomial)]
    return {model.joint(c.joint) for c in couplings}
