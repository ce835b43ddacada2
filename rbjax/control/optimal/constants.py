"""The numbers of a robot as constants of a program.

Most numbers of a model are zeros and ones. If they are compile-time constants, half of the
operations are left out: expanding a quadrotor's problem and trying steps take 0.4 of the time. But
other numbers need another program. So the numbers of the first few robots of a form are constants,
and those of later ones are arguments.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import equinox as eqx
import jax
import numpy as np

#: robots of the same form whose numbers become constants
ROBOTS = 2
#: robots, and their forms, that are remembered
REMEMBERED = 64


class Constants:
    """A pytree that is compared by its numbers, so that a program may be known by it."""

    def __init__(self, leaves: list, tree: Any):
        self.leaves, self.tree = leaves, tree
        self._key = tuple(
            (x.shape, x.dtype.str, x.tobytes()) if isinstance(x, np.ndarray) else x
            for x in (np.asarray(x) if eqx.is_array(x) else x for x in leaves)
        )
        self._hash = hash((tree, self._key))

    def unflatten(self) -> Any:
        """The pytree."""
        return jax.tree.unflatten(self.tree, self.leaves)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        return (
            isinstance(other, Constants) and self._hash == other._hash
            and self.tree == other.tree and self._key == other._key
        )  # fmt: skip


class ConstantRobots:
    """What has been made constant. Robots are found again by the identity of their arrays, for
    reading these from a GPU takes longer than a call."""

    def __init__(self) -> None:
        self._seen: dict[tuple, Constants] = {}
        self._forms: dict[Hashable, list[Constants]] = {}

    def constants(self, robot: Any) -> Constants | None:
        """A robot as constants; None if its numbers are traced, cannot be compared, or there were
        others of the same form before."""
        leaves, tree = jax.tree.flatten(robot)
        if any(isinstance(x, jax.core.Tracer) for x in leaves):
            return None
        key = (tree, *map(id, leaves))
        found = self._seen.get(key)
        if found is None:
            try:
                found = Constants(leaves, tree)
            except TypeError:  # a function without a hash
                return None
            _forget(self._seen)
            self._seen[key] = found  # its arrays live as long, so that no other has their identity
        form = (tree, *(x.shape if eqx.is_array(x) else x for x in leaves))
        same = self._forms.get(form)
        if same is None:
            _forget(self._forms)
            same = self._forms[form] = []
        for other in same:
            if other == found:
                return other
        if len(same) >= ROBOTS:
            return None
        same.append(found)
        return found


def _forget(found: dict) -> None:
    """Makes room for one more, of the oldest."""
    while len(found) >= REMEMBERED:
        del found[next(iter(found))]
