"""All formulations of one rigid body's motion, by name; they describe one and the same motion.

Those without an attitude in their name hold for every attitude. `lagrange_*` are the direct
Lagrangian equations in each representation with three numbers, each singular somewhere.
"""

from __future__ import annotations

import functools
from types import MappingProxyType

from rbjax.body.attitude_lagrange import Lagrange, QuasiLagrange
from rbjax.body.formulation import Formulation
from rbjax.body.kirchhoff import Kirchhoff
from rbjax.body.newton_euler import NewtonEuler
from rbjax.body.spatial_equations import Momentum, Spatial
from rbjax.errors import UnknownName
from rbjax.rotations import representations


@functools.cache
def formulations() -> MappingProxyType[str, Formulation]:
    """Name -> formulation, in a stable order; the attitude-free ones first.

    >>> list(formulations())[:3], len(formulations()) >= 36
    (['newton_euler', 'newton_euler_origin', 'kirchhoff'], True)
    """
    entries: dict[str, Formulation] = {
        "newton_euler": NewtonEuler(),
        "newton_euler_origin": NewtonEuler((0.0, 0.0, 0.0)),
        "kirchhoff": Kirchhoff(),
        "spatial_body": Spatial(),
        "spatial_world": Spatial((0.0, 0.0, 0.0)),
        "momentum_body": Momentum(),
        "momentum_world": Momentum((0.0, 0.0, 0.0)),
        "quasi_lagrange": QuasiLagrange("unit_quaternion"),
    }
    minimal = (name for name, rep in representations().items() if rep.size == 3)
    entries |= {f"lagrange_{name}": Lagrange(name) for name in minimal}
    return MappingProxyType(entries)


def formulation(name: str) -> Formulation:
    """The formulation of that name."""
    known = formulations()
    if name not in known:
        raise UnknownName("formulation", name, known)
    return known[name]
