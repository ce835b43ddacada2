"""External forces on links, each in its link's axes at its link's origin.

    tau = sum over links of J_i^T f_i:   f_i + sum of the children's X^T f,   tau_i = S_i . f_i
(virtual work; Featherstone, 5.3). ABA and RNEA add such forces to the bias forces. `generalized`
converts them to generalized forces.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.algorithms.kinematics import ROTATION, sweep
from rbjax.dynamics.drivers.choice import Driver
from rbjax.lanes import Mat3, Vec3
from rbjax.model import WORLD
from rbjax.spatial import Force

#: forces on some links by their index, or columns over all links
LinkForces = Mapping[int, Force] | Force


def per_link(d: Driver, f_ext: LinkForces | None) -> Any:
    """The force on each link, in the driver's form."""
    if isinstance(f_ext, Force):
        return jax.tree.map(lambda *x: Force.from_lanes(x), *map(d.lanes, f_ext))
    return d.scattered(f_ext or {}, Force.zero())


def added(a: LinkForces, b: LinkForces) -> LinkForces:
    """The sum of both."""
    a, b = a or {}, b or {}  # None is no force
    if isinstance(a, Force) and isinstance(b, Force):
        return a + b
    if isinstance(a, Force):
        return added(b, a)
    if isinstance(b, Force):
        for i, f in a.items():
            b = jax.tree.map(lambda x, y, i=i: x.at[i].add(y), b, f)
        return b
    out = dict(a)
    for i, f in b.items():
        out[i] = out[i] + f if i in out else f
    return out


def over_links(d: Driver, links: np.ndarray, forces: Force, dtype: Any) -> Force:
    """The sums of forces on these links, which may repeat, as columns over all links."""
    nothing = jnp.zeros(d.topology.nv, dtype)
    return jax.tree.map(lambda x: nothing.at[links].add(x), forces)


def generalized(d: Driver, joints: Any, f_ext: LinkForces) -> Any:
    """Generalized forces per link of forces on links."""

    def inward(x, children):
        link, joint, push = x
        f = push + children
        return joint.transform(link).T(f), joint.S.dot(f)

    return d.inward(inward, Force.zero(), d.zip(d.constants, joints, per_link(d, f_ext)))


def on_links(d: Driver, joints: Any, wrenches: jax.Array) -> LinkForces:
    """Wrenches (nb, 6) on bodies, in world axes at the bodies' origins, as forces on links."""
    top = d.topology
    rotations = d.whole(*sweep(d, joints, ROTATION))
    if not d.listed:
        bodies = np.array([b for b, k in enumerate(top.body_links) if k != WORLD], int)
        links = [top.body_links[b] for b in bodies]
        arms = Vec3(*jnp.asarray(d.prepared.body_p, wrenches.dtype)[bodies].T)
        found = _turned(d.take(rotations, links), arms, Force.from_lanes(wrenches[bodies].T))
        return over_links(d, np.array(links, int), found, wrenches.dtype)
    out: dict[int, Force] = {}
    for b, k in enumerate(top.body_links):
        if k != WORLD:
            push = _turned(rotations[k], d.prepared.weld(b).p, Force.from_lanes(wrenches[b]))
            out[k] = out[k] + push if k in out else push
    return out


def _turned(R: Mat3, arm: Vec3, wrench: Force) -> Force:
    """A wrench in world axes, at a point of a link, in the link's axes at its origin."""
    force = R.T @ wrench.lin
    return Force(R.T @ wrench.ang + arm.cross(force), force)
