"""The joints of a URDF that mimic others: q = offset + multiplier times the other's q."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp

from rbjax.constraints import JointPolynomial
from rbjax.errors import ModelError
from rbjax.loading.urdf.numbers import number
from rbjax.loading.urdf.tree import Tree

_MOVING = ("revolute", "continuous", "prismatic")  # of one coordinate


@dataclass(frozen=True)
class Mimics:
    """The mimics of a file.

    couplings: the constraints of joints of one coordinate; one on a fixed joint is held.
    names: of the couplings, "joint of driver".
    others: of joints of several coordinates, which are not modelled.
    """

    couplings: tuple[JointPolynomial, ...] = ()
    names: tuple[str, ...] = ()
    others: tuple[str, ...] = ()

    def left_out(self, *, constraints: bool) -> tuple[str, ...]:
        """The entries of `Model.dropped`."""
        names = ", ".join((*(() if constraints else self.names), *self.others))
        return (f"mimic joints, which move on their own ({names})",) if names else ()


def read_mimics(tree: Tree, name: str) -> Mimics:
    """The mimics of a robot. A fixed joint has nothing to mimic with."""
    kinds = {joint.name: joint.kind for joint in tree.joints}
    couplings, names, others = [], [], []
    for joint in tree.joints:
        for mimic in () if joint.element is None else joint.element.findall("mimic"):
            driver, where = mimic.get("joint", ""), f"{name}: joint {joint.name!r}"
            if driver not in kinds or driver == joint.name:
                raise ModelError(
                    f"{where} mimics {driver!r}, expected another one of the joints "
                    f"{', '.join(sorted(kinds))}"
                )
            line = [number(mimic, "offset", where), number(mimic, "multiplier", where, 1.0)]
            if joint.kind in _MOVING and kinds[driver] in (*_MOVING, "fixed"):
                leader = None if kinds[driver] == "fixed" else driver
                couplings.append(JointPolynomial(joint.name, leader, jnp.asarray(line, float)))
                names.append(f"{joint.name} of {driver}")
            elif joint.kind != "fixed":
                others.append(f"{joint.name} of {driver}")
    return Mimics(tuple(couplings), tuple(names), tuple(others))
