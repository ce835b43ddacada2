"""A joint at an instant, as a force element reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.errors import InputError
from rbjax.forces.element import Loads
from rbjax.lanes import Lane


@dataclass(frozen=True)
class JointState:
    """A joint at an instant.

    Fields:
        kind: name of its kind.
        q, v: coordinates and velocities, as lanes: m, rad, m/s, rad/s.
        start: index of its first dof in v of the model.
    """

    kind: str
    q: Sequence[Lane]
    v: Sequence[Lane]
    start: int

    def push(self, *tau: Any) -> Loads:
        """Make loads of generalized forces on the dofs of the joint: N m for a rotation, N for a
        translation."""
        if len(tau) == 1 and np.ndim(tau[0]) == 1:
            tau = tuple(tau[0])
        if len(tau) != len(self.v):
            raise InputError(
                f"push: got {len(tau)} forces on a {self.kind} joint, expected {len(self.v)}"
            )
        return Loads({self.start + k: x for k, x in enumerate(tau)})
