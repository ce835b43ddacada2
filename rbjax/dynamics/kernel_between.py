"""What a kernel does between two evaluations of the dynamics: the model's forces, and motion.

Joints of one coordinate are a loop, in which `applied` and `integrate` see a model of one joint
(`Numbers.one`); free and ball joints, and joints with several actuators, are written out.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.kernel_drivers import loop
from rbjax.dynamics.kernel_layout import ACTUATOR, JOINT, SINGLE, Q, single_links
from rbjax.dynamics.manifold import integrate_lanes, rate_lanes
from rbjax.lanes import as_arrays
from rbjax.model import JOINT_SIZES


class Between:
    """Forces and motion of a block's model; `applied` is `forces.applied_lanes`."""

    def __init__(self, block: Any, applied: Callable, actuated: bool):
        self.known, self.index, self.like = block.known, block.index, block.like
        self.applied, self.model = applied, block.known.model
        top, joints = self.model.topology, self.model.actuators.joints
        self.single = single_links(top, joints)
        self.rest = [i for i in range(top.nv) if i not in self.single]
        kept = sorted({top.links[i].joint for i in self.rest})
        self.rest_u = [a for a, j in enumerate(joints) if j < 0 or j in kept]
        sizes = [JOINT_SIZES[top.joint_kinds[j]] for j in kept]
        self.rest_q = [
            top.joint_q[j] + k for j, (nq, _) in zip(kept, sizes, strict=True) for k in range(nq)
        ]
        self._part = SimpleNamespace(
            joint_kinds=[top.joint_kinds[j] for j in kept],
            joint_q=[sum(nq for nq, _ in sizes[:k]) for k in range(len(kept))],
            joint_v=[sum(nv for _, nv in sizes[:k]) for k in range(len(kept))],
        )
        with_actuator = [top.links[i].joint in joints for i in self.single]
        self.actuated, self.all_actuated = actuated and any(with_actuator), all(with_actuator)

    def each(self, visit: Callable[[Any, Any, Any], None]) -> None:
        """`visit(link, its place in q, its actuator or -1)` for the joints of one coordinate."""

        def body(k, _):
            i = self.index[SINGLE, k]
            visit(i, self.index[Q, i], self.index[ACTUATOR, i])
            return 0

        loop(body, 0, 0, len(self.single))

    def force(self, i: Any, at: Any, actuator: Any, q: Any, v: Any, u: Any) -> jax.Array:
        """The force on a joint of one coordinate; u is None without actuators."""
        alone = self.known.one(i, self.index[JOINT, i], jnp.maximum(actuator, 0), at)
        passive = None
        if u is None or not self.all_actuated:
            passive = as_arrays(self.applied(alone, [q], [v], None)[0], self.like)
            if u is None:
                return passive
        driven = as_arrays(self.applied(alone, [q], [v], [u])[0], self.like)
        return driven if passive is None else jnp.where(actuator >= 0, driven, passive)

    def rest_forces(self, q: list, v: list, u: list | None) -> list[jax.Array]:
        """Forces on the links of `rest`, from their coordinates and actuators alone."""
        model = self.model
        none = [jnp.zeros_like(self.like)] * max(model.nq, model.nv, model.nu)

        def filled(count, places, lanes):
            out = none[:count]
            for place, x in zip(places, lanes, strict=True):
                out[place] = x
            return out

        ctrl = None if u is None else filled(model.nu, self.rest_u, u)
        q, v = filled(model.nq, self.rest_q, q), filled(model.nv, self.rest, v)
        out = self.applied(model, q, v, ctrl)
        return [as_arrays(out[i], self.like) for i in self.rest]

    def rest_moved(self, q: list, dq: list) -> list[jax.Array]:
        """Their configuration q + dq."""
        return as_arrays(integrate_lanes(self._part, q, dq), self.like)

    def rest_rates(self, u: list, v: list) -> list[jax.Array]:
        """Rates of their increments u at speeds v."""
        return as_arrays(rate_lanes(self._part, u, v), self.like)
