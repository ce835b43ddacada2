"""All formulations of one rigid body's motion, by name. They describe the same motion.

`lagrange_*` are Lagrange's equations in a representation of attitude with three parameters, and
each has a singularity. All other formulations have none.
"""

from __future__ import annotations

import functools
from types import MappingProxyType

from rbjax.arguments import choice
from rbjax.body.attitude_lagrange import Lagrange, QuasiLagrange
from rbjax.body.formulation_types import Formulation, Kirchhoff, Momentum, NewtonEuler, Spatial
from rbjax.rotations import representations


@functools.cache
def formulations() -> MappingProxyType[str, Formulation]:
    """Return all formulations by name, in a fixed order.

    Returns:
        Name -> `Formulation`.

    Example:
        >>> from rbjax.body import formulations
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
    """Return a formulation by its name.

    Args:
        name: one of `formulations()`.

    Returns:
        The `Formulation`.

    Raises:
        UnknownName: no such formulation.

    Example:
        >>> from rbjax.body import formulation
        >>> type(formulation("kirchhoff")).__name__
        'Kirchhoff'
    """
    known = formulations()
    return known[choice("formulation", name, known)]
