"""A builder of models from lanes that keeps structural zeros."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.joints import kind as kind_of
from rbjax.lanes import Lane, is_literal
from rbjax.model import WORLD, Model
from rbjax.model.components import Actuators, Bodies, Joints, Keyframes, Sites
from rbjax.model.topology import Topology

Lanes = Sequence[Lane]
ORIGIN: Lanes = (0.0, 0.0, 0.0)
STRAIGHT: Lanes = (1.0, 0.0, 0.0, 0.0)
UP: Lanes = (0.0, 0.0, 1.0)
LEFT: Lanes = (0.0, 1.0, 0.0)
TIMESTEP = 0.002


class TreeBody(NamedTuple):
    """A body. Its moments of inertia are about its centre of mass, along its own axes."""

    name: str
    parent: int = WORLD
    position: Lanes = ORIGIN
    orientation: Lanes = STRAIGHT
    mass: Lane = 0.0
    com: Lanes = ORIGIN
    moments: Lanes = ORIGIN


class TreeJoint(NamedTuple):
    """A joint of a body."""

    name: str
    kind: str
    body: int
    axis: Lanes = UP
    placement: Lanes = ORIGIN
    armature: Lane = 0.0


@dataclass
class BodyTree:
    """Bodies and joints of a model, parents first. The joints of a body follow it."""

    dtype: Any
    bodies: list[TreeBody] = field(default_factory=list)
    joints: list[TreeJoint] = field(default_factory=list)

    def body(self, *given: Any, **named: Any) -> int:
        """Add a `TreeBody`. Return its index."""
        self.bodies.append(TreeBody(*given, **named))
        return len(self.bodies) - 1

    def joint(self, *given: Any, **named: Any) -> None:
        """Add a `TreeJoint` of the last body."""
        self.joints.append(TreeJoint(*given, **named))

    def model(self, gravity: Lanes, motors: Sequence[str]) -> Model:
        """Make the model, with a motor of gear 1 on each of the named hinges."""
        kinds = [kind_of(joint.kind) for joint in self.joints]
        nv, nq, nj = sum(k.nv for k in kinds), sum(k.nq for k in kinds), len(kinds)
        names = tuple(joint.name for joint in self.joints)
        at_rest: list[Lane] = []
        armature: list[Lane] = []
        for kind, joint in zip(kinds, self.joints, strict=True):
            at_rest += [0.0] * (kind.nq - 4) + [*STRAIGHT] if kind.quaternion else [0.0] * kind.nq
            armature += [joint.armature] * kind.nv
        squares = [[(m[i] if i == j else 0.0) for i in range(3) for j in range(3)]
                   for m in (b.moments for b in self.bodies)]  # fmt: skip
        given: dict[str, Any] = {
            "mass": [[b.mass] for b in self.bodies],
            "com": [b.com for b in self.bodies],
            "inertia": squares,
            "position": [b.position for b in self.bodies],
            "orientation": [b.orientation for b in self.bodies],
            "placement": [j.placement for j in self.joints],
            "axis": [j.axis for j in self.joints],
            "reference": [[x] for x in at_rest],
            "armature": [[x] for x in armature],
            "gravity": [[x] for x in gravity],
        }
        shapes = {
            name: (len(rows), len(rows[0])) if len(rows[0]) > 1 else (len(rows),)
            for name, rows in given.items()
        } | {"inertia": (len(self.bodies), 3, 3)}
        leaf = {k: _array(x, self.dtype).reshape(shapes[k]) for k, x in given.items()}
        nu = len(motors)
        one: Any = np.eye(6)[[0] * nu]
        endless: Any = np.tile([-np.inf, np.inf], (nj, 1))
        unlimited: Any = np.tile([-np.inf, np.inf], (nu, 1))

        def zeros(*shape: int) -> Any:
            return np.zeros(shape)

        model = Model(
            Bodies(*(leaf[k] for k in ("mass", "com", "inertia", "position", "orientation"))),
            Joints(
                leaf["placement"], leaf["axis"], leaf["reference"], leaf["armature"], zeros(nv),
                zeros(nj), leaf["reference"], endless, endless, zeros(0),
            ),
            Actuators(
                one, one[:, :3], zeros(nu, 3), unlimited, unlimited,
                joints=tuple(map(names.index, motors)), sites=(-1,) * nu,
            ),
            Sites(zeros(0, 3), zeros(0, 4)),
            Keyframes(zeros(0, nq), zeros(0, nv), zeros(0, nu)),
            leaf["gravity"],
            Topology(
                tuple(b.parent for b in self.bodies), tuple(j.kind for j in self.joints),
                tuple(j.body for j in self.joints), tuple(b.name for b in self.bodies), names,
                tuple(motors),
            ),
            TIMESTEP,
            (),
        )  # fmt: skip
        if any(isinstance(x, jax.core.Tracer) for x in leaf.values()):
            known = {k: _known(x, k in ("axis", "orientation")) for k, x in given.items()}
            return model.replace(zeros=tuple((known | {"numbers": ()}).items()))
        return model


def _array(rows: Sequence[Lanes], dtype: Any) -> Any:
    """Stack rows of lanes, as a numpy array if all lanes are constants."""
    lanes = [x for row in rows for x in row]
    if all(map(is_literal, lanes)):
        return np.array(lanes)
    return jnp.stack([jnp.asarray(x, dtype) for x in lanes])


def _known(rows: Sequence[Lanes], units: bool) -> tuple:
    """Return, for each entry, its value if it is the constant 0 (if `units`, also 1 and -1), else
    None."""
    known = (0.0, 1.0, -1.0) if units else (0.0,)
    return tuple(x if is_literal(x) and x in known else None for row in rows for x in row)
