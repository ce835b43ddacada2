"""Affine actuators, which `model.actuators` stores as columns.

    tau = moment^T f,   f = clip((g0 + g1 l + g2 l') clip(u) + b0 + b1 l + b2 l')
(MuJoCo, *Computation*, actuation model.) Each row is an `Actuator` at a joint or a site whose force
is affine in its control and has no state. A model of many motors then has five arrays, which are
parameters of identification, instead of five for each motor.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from rbjax.forces.actuators.actuator import Actuator, Affine, GainBias
from rbjax.forces.actuators.transmissions import JointAxis, SiteWrench
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.model import Actuators


def is_affine(element: Any) -> bool:
    """Whether an element can be a row of `model.actuators`."""
    if type(element) is not Actuator or type(element.law) is not GainBias:
        return False
    law, transmission = element.law, element.transmission
    axis = isinstance(transmission, JointAxis) and not transmission.in_parent
    affine = isinstance(law.gain, Affine) and (law.bias is None or isinstance(law.bias, Affine))
    stateless = law.activation is None and not law.circular and len(element.controls) == 1
    return affine and stateless and (axis or isinstance(transmission, SiteWrench))


def from_columns(model: Model) -> tuple[Actuator, ...]:
    """The actuators of `model.actuators` as elements, without the rows that drive nothing."""
    own = model.actuators
    names = ("gear", "gain", "bias", "ctrlrange", "forcerange")
    columns = (getattr(own, n) for n in names)
    parts: Any = (
        x if isinstance(x, np.ndarray) else table(x, x.dtype) for x in columns
    )
    gear, gain, bias, ctrl, force = parts

    def element(i: int) -> Actuator:
        joint, site = own.joints[i], own.sites[i]
        transmission = JointAxis(gear[i], joint) if site < 0 else SiteWrench(gear[i], site)
        law = GainBias(Affine(gain[i]), Affine(bias[i]), None)
        return Actuator(transmission, law, ctrl[i : i + 1], force[i], (i,))

    driving = (i for i in range(model.nu) if own.joints[i] >= 0 or own.sites[i] >= 0)
    return tuple(map(element, driving))


def to_columns(elements: Iterable[Any], nu: int) -> Actuators:
    """Affine actuators as columns, a row for each of nu controls; the other rows drive nothing."""
    gear, gain, bias = np.zeros((nu, 6)), np.zeros((nu, 3)), np.zeros((nu, 3))
    ctrlrange, forcerange = np.tile([-np.inf, np.inf], (2, nu, 1))
    joints, sites = [-1] * nu, [-1] * nu
    for one in elements:
        (i,), law, transmission = one.controls, one.law, one.transmission
        gear[i], ctrlrange[i], forcerange[i] = transmission.gear, one.ctrlrange[0], one.forcerange
        gain[i, : law.gain.coefficients.size] = law.gain.coefficients
        if law.bias is not None:
            bias[i, : law.bias.coefficients.size] = law.bias.coefficients
        if isinstance(transmission, SiteWrench):
            sites[i] = transmission.site
        else:
            joints[i] = transmission.joint
    make: Any = Actuators  # of arrays of NumPy
    columns = gear, gain, bias, ctrlrange, forcerange
    return make(*columns, joints=tuple(joints), sites=tuple(sites))
