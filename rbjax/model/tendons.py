"""Tendons: cables along which actuators, springs, dampers and limits act."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from rbjax.errors import InputError
from rbjax.model.record import Record, check_least, check_order, check_rows


@dataclass(frozen=True)
class Waypoint:
    """One element of the path of a tendon."""

    kind: str  # "joint" of a fixed tendon; "site", "geom" or "pulley" of a spatial tendon
    index: int = -1  # index of the joint, site or geom; -1 for a pulley
    side: int = -1  # index of the side site of a geom, or -1


class Tendons(Record):
    """The tendons of a model, with MuJoCo's parameters.

    A fixed tendon has the length l = sum of c_k q_k over hinges and slides. A spatial tendon is the
    shortest path through its sites and around its spheres and cylinders; the lengths of the
    branches after a pulley are divided by its divisor. `rb.tendon_lengths` computes l.

    Fields:
        coefficients: (nc,) c_k of each joint and divisor of each pulley, in the order of the paths.
        stiffness: (nt, s) k_0, k_1, ... of the spring, N/m, N/m^2, ...
        damping: (nt, c) d_0, d_1, ... of the damper, N s/m, N s^2/m^2, ...
        springlength: (nt, 2) m, the lengths between which the spring is slack.
        range: (nt, 2) m, limits of the length; infinite for none.
        forcerange: (nt, 2) N, limits of the sum of the actuator forces; infinite for none.
        frictionloss: (nt,) N.
        armature: (nt,) kg, the inertia of the change of length, a row of the contact problem.
        limit_margin: (nt,) m, distance before a limit at which it begins to act.
        limit_solref, limit_solimp: (nt, 2) and (nt, 5), softness of the limits, as in MuJoCo.
        friction_solref, friction_solimp: (nt, 2) and (nt, 5), softness of the friction loss.
        length0: (nt,) m, length in the file's configuration, from which equalities are measured.
        names: of each tendon; static.
        paths: the waypoints of each tendon; static.
        limited, rubbing, inertial: the tendons with limits, friction loss and armature; static.
    """

    coefficients: jax.Array
    stiffness: jax.Array
    damping: jax.Array
    springlength: jax.Array
    range: jax.Array
    forcerange: jax.Array
    frictionloss: jax.Array
    armature: jax.Array
    limit_margin: jax.Array
    limit_solref: jax.Array
    limit_solimp: jax.Array
    friction_solref: jax.Array
    friction_solimp: jax.Array
    length0: jax.Array
    names: tuple[str, ...] = eqx.field(static=True)
    paths: tuple[tuple[Waypoint, ...], ...] = eqx.field(static=True)
    limited: tuple[int, ...] = eqx.field(static=True, default=())
    rubbing: tuple[int, ...] = eqx.field(static=True, default=())
    inertial: tuple[int, ...] = eqx.field(static=True, default=())

    def replace(self, **changes: Any) -> Tendons:
        """Return a copy with the given fields changed. Arrays must keep their shapes.

        Raises:
            InputError: a number is not finite, a range has its larger number first, a friction loss
                or an armature is negative, or a tendon gets a limit, friction loss or armature but
                is not in `limited`, `rubbing` or `inertial`.
        """
        new, count = super().replace(**changes), len(self.names)
        for name, rows in (("range", "limited"), ("frictionloss", "rubbing"),
                           ("armature", "inertial")):  # fmt: skip
            where, x = f"Tendons.replace({name}=...)", getattr(new, name)
            check_rows(f"Tendons.replace({rows}=...)", getattr(new, rows), count)
            if name not in changes or isinstance(x, jax.core.Tracer):
                continue
            if name == "range":
                check_order(where, x)
                given = np.isfinite(x).any(-1)
            else:
                check_least(where, x)
                given = np.asarray(x) != 0
            missing = [i for i in np.flatnonzero(given).tolist() if i not in getattr(new, rows)]
            if missing:
                raise InputError(
                    f"{where}: tendons {missing} are not in {rows}={getattr(new, rows)}, so that "
                    f"it would have no effect; replace {rows}=, too"
                )
        if "forcerange" in changes:
            check_order("Tendons.replace(forcerange=...)", new.forcerange)
        return new

    def first_coefficient(self, tendon: int) -> int:
        """Return the index of the first coefficient of a tendon."""
        return sum(x.kind in ("joint", "pulley") for path in self.paths[:tendon] for x in path)
