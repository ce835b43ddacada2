"""The contact sensor: number, forces and places of the contacts between parts of a robot.

The contacts are those of two geoms, one of which belongs to the first part and the other one to the
second. The axes of a contact are its normal, from the first part to the second, and two tangents.
The force is the force of the first part on the second. If the geoms are in the other order,

    n, t1, t2 -> -n, -t1, t2,      f = (f_n, f_1, f_2) -> (f_n, f_1, -f_2)
(MuJoCo, *XML reference*, sensor/contact.)
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.contact.solver.contact_forces import ContactForces
from rbjax.errors import InputError, UnknownName
from rbjax.forces.context import Context
from rbjax.lanes import Vec3, safe_sqrt
from rbjax.lanes.arrays import matvec
from rbjax.model import WORLD, Frame, Model
from rbjax.sensors.columns import Columns
from rbjax.sensors.fixed import AXES, FixedSensor, check_data
from rbjax.sensors.geometry.volumes import Volume
from rbjax.sensors.protocol import register
from rbjax.sensors.solution import solution_of

_IN_AXES = ("n", "t1", "t2")
#: data of a contact sensor -> names of its values and their unit, in MuJoCo's order
DATA = {
    "found": (("found",), "1"),
    "force": (tuple(f"force_{x}" for x in _IN_AXES), "N"),
    "torque": (tuple(f"torque_{x}" for x in _IN_AXES), "N m"),
    "dist": (("dist",), "m"),
    "pos": (tuple(f"pos_{x}" for x in AXES), "m"),
    "normal": (tuple(f"normal_{x}" for x in AXES), "1"),
    "tangent": (tuple(f"tangent_{x}" for x in AXES), "1"),
    "linvel": (tuple(f"linvel_{x}" for x in _IN_AXES), "m/s"),
    "angvel": (tuple(f"angvel_{x}" for x in _IN_AXES), "rad/s"),
}
#: order of the contacts that are returned
REDUCTIONS = ("none", "mindist", "maxforce", "netforce")
PARTS = ("geom", "body", "subtree", "site")


@register("contact", placed=True)
class ContactSensor(FixedSensor):
    """Measure the contacts between two parts of a robot, in `num` slots; unused slots are zero.

    It reads zero if the dynamics has no contacts.

    first, second: the parts, as "geom:NAME", "body:NAME", "subtree:NAME" or a pair of kind and
        index; None for any part; static. The first part may be "site:NAME": contacts whose position
        is in the volume of the site.
    data: values of each slot, of `DATA`; static. "found" is the number of all contacts.
    reduce: "none": the first contacts; "mindist": the deepest ones; "maxforce": the ones with the
        largest forces; "netforce": the sum of the forces, and of the torques about their centroid,
        in world axes, in the first slot; static.
    num: the number of slots; static.
    volume: the shape of the site, which a model does not keep; None without a site; static.
    """

    first: Any = eqx.field(static=True, default=None)
    second: Any = eqx.field(static=True, default=None)
    data: tuple[str, ...] = eqx.field(static=True, default=("found",))
    reduce: str = eqx.field(static=True, default="none")
    num: int = eqx.field(static=True, default=1)
    volume: Volume | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        integer("ContactSensor", "num", self.num, least=1)
        if self.reduce not in REDUCTIONS:
            raise UnknownName("reduction of a contact sensor", self.reduce, REDUCTIONS)
        check_data("ContactSensor", "data of a contact sensor", self.data, DATA)
        if self.reduce == "netforce" and {"linvel", "angvel"} & {*self.data}:
            raise InputError(
                "ContactSensor: reduce='netforce' has no velocities, expected data without "
                "'linvel' and 'angvel', or another reduction"
            )

    def check(self, model: Model) -> None:
        for part in (self.first, self.second):
            part_of(model, part)
        if self.second is not None and part_of(model, self.second)[0] == "site":
            raise InputError("ContactSensor: second is a site, expected a geom, body or subtree")
        if self.volume is None and self.first and part_of(model, self.first)[0] == "site":
            raise InputError(
                "ContactSensor: first is a site and volume is None, expected a "
                "rbjax.sensors.Volume(kind, size), the shape of the site in its file"
            )

    def columns(self, model: Model) -> Columns:
        self.check(model)
        return Columns(len(self.names(model)))

    def names(self, model: Model) -> tuple[str, ...]:
        one = [name for part in self.data for name in DATA[part][0]]
        if self.num == 1:
            return tuple(one)
        return tuple(f"{name}[{k}]" for k in range(self.num) for name in one)

    def unit(self, model: Model) -> str:
        return " or ".join(dict.fromkeys(DATA[part][1] for part in self.data))

    def __call__(self, context: Context) -> jax.Array:
        model, contacts = context.model, solution_of(context).contacts
        self.check(model)
        rows, signs = ([], []) if contacts is None else self._rows(model, contacts)
        if contacts is None or not rows:
            return jnp.zeros(len(self.names(model)), context.q.dtype)
        values = self._values(context, contacts, rows, np.array(signs))
        active = contacts.exists[np.array(rows)]
        if self.first is not None and part_of(model, self.first)[0] == "site":
            active = active & self._inside(context, values["pos"])
        count = active.sum().astype(context.q.dtype)
        if self.reduce == "netforce":
            slots = [self._net(values, active, count)]
            slots += [{name: 0.0 * x for name, x in slots[0].items()}] * (self.num - 1)
        else:
            slots = self._slots(values, active, count)
        return jnp.concatenate([slot[part] for slot in slots for part in self.data])

    def _rows(self, model: Model, contacts: ContactForces) -> tuple[list[int], list[float]]:
        """Return the candidates between both parts in the order of the pairs of the model, with -1
        for those whose geoms are in the other order, else 1."""
        geoms: Any = model.geoms
        place = {pair: k for k, pair in enumerate(geoms.pairs)}  # a law may have other pairs
        rows, signs = [], []
        order = sorted(
            range(len(contacts.geoms)), key=lambda row: place.get(contacts.geoms[row], len(place))
        )
        for row in order:
            a, b = contacts.geoms[row]
            for one, other, sign in ((a, b, 1.0), (b, a, -1.0)):
                if _belongs(model, one, self.first) and _belongs(model, other, self.second):
                    rows.append(row)
                    signs.append(sign)
                    break
        return rows, signs

    def _values(
        self, context: Context, contacts: ContactForces, rows: list[int], signs: np.ndarray
    ) -> dict[str, jax.Array]:
        """Return the data of the contacts (m, n), and the wrench "world" (m, 6) in world axes."""
        dtype = context.q.dtype
        at, sign = np.array(rows), jnp.asarray(signs, dtype)[:, None]
        turn = jnp.concatenate([0 * sign + 1, 0 * sign + 1, sign], 1)  # of components
        frame = contacts.frame[at]
        force, torque = contacts.force[at, :3], contacts.force[at, 3:]
        world = [sign * matvec(frame.swapaxes(-1, -2), x) for x in (force, torque)]
        found = {
            "force": turn * force,
            "torque": turn * torque,
            "dist": contacts.distance[at][:, None],
            "pos": contacts.position[at],
            "normal": sign * frame[:, 0],
            "tangent": sign * frame[:, 1],
            "world": jnp.concatenate(world, 1),
        }
        if {"linvel", "angvel"} & {*self.data}:
            pairs = [_velocity(context, contacts, row) for row in rows]
            for k, name in enumerate(("linvel", "angvel")):
                each = jnp.stack([jnp.stack([jnp.asarray(x, dtype) for x in p[k]]) for p in pairs])
                found[name] = turn * matvec(frame, each)
        return found

    def _inside(self, context: Context, positions: jax.Array) -> jax.Array:
        """Return whether each position (m, 3) is in the volume of the site."""
        site = context.frame(Frame(site=part_of(context.model, self.first)[1]))
        points = [Vec3(*(p[k] for k in range(3))) for p in positions]
        local = [site.rotation.T @ (p - site.position) for p in points]
        assert self.volume is not None
        return jnp.stack([jnp.asarray(self.volume.contains(p)) for p in local])

    def _slots(
        self, values: dict[str, jax.Array], active: jax.Array, count: jax.Array
    ) -> list[dict[str, jax.Array]]:
        """Return, for each slot, the data of the contact in it: the contacts in the order that
        `reduce` sets."""
        before: Any = np.tri(len(active), k=-1, dtype=bool)  # whether contact j is before contact i
        if self.reduce != "none":
            key = values["dist"][:, 0]
            if self.reduce == "maxforce":
                key = -(values["force"] ** 2).sum(1)
            before = (key < key[:, None]) | ((key == key[:, None]) & before)
        rank = (active & before).sum(1)
        out = []
        for slot in range(self.num):
            here = (active & (rank == slot))[:, None]
            own = {name: jnp.where(here, x, 0.0).sum(0) for name, x in values.items()}
            out.append(own | {"found": jnp.where(slot < count, count, 0.0)[None]})
        return out

    def _net(
        self, values: dict[str, jax.Array], active: jax.Array, count: jax.Array
    ) -> dict[str, jax.Array]:
        """Return the sum of all contacts as the data of one slot."""
        force, torque, position = values["world"][:, :3], values["world"][:, 3:], values["pos"]
        weight = jnp.where(active, safe_sqrt((force**2).sum(1)), 0.0)
        total = weight.sum()
        some = total > 0
        center = jnp.where(
            some, (weight[:, None] * position).sum(0) / jnp.where(some, total, 1.0), 0.0
        )
        moment = torque + jnp.cross(position - center, force)
        world = jnp.where(active[:, None], jnp.concatenate([force, moment], 1), 0.0).sum(0)
        axes = jnp.where(count > 0, jnp.eye(3, dtype=force.dtype)[:2], 0.0)
        return {
            "found": count[None],
            "force": world[:3],
            "torque": world[3:],
            "dist": jnp.zeros(1, force.dtype),
            "pos": center,
            "normal": axes[0],
            "tangent": axes[1],
        }


def part_of(model: Model, part: Any) -> tuple[str, int]:
    """Return the kind and the index of a part of a robot; ("", 0) for any part."""
    if part is None:
        return "", 0
    kind, name = part.split(":", 1) if isinstance(part, str) and ":" in part else ("", part)
    if isinstance(part, tuple) and len(part) == 2:
        kind, name = part
    if kind not in PARTS:
        raise InputError(
            f"ContactSensor: a part is {part!r}, expected one of "
            f"{[f'{x}:NAME' for x in PARTS]}, or a pair of kind and index"
        )
    if kind == "geom":
        return kind, model.geom(name)
    if kind == "site":
        return kind, model.site(name)
    if (name == "world" and name not in model.body_names) or name == WORLD:
        return kind, WORLD
    return kind, model.body(name)


def _belongs(model: Model, geom: int, part: Any) -> bool:
    """Check whether a geom belongs to a part. All geoms can touch in the volume of a site."""
    kind, index = part_of(model, part)
    if kind in ("", "site"):
        return True
    if kind == "geom":
        return geom == index
    body = model.geoms.bodies[geom]  # type: ignore[union-attr]
    if kind == "body":
        return body == index
    while body not in (index, WORLD):
        body = model.topology.body_parents[body]
    return body == index


def _velocity(context: Context, contacts: ContactForces, row: int) -> tuple[Vec3, Vec3]:
    """Return the velocity of the second geom relative to the first one at a contact, linear and
    angular, in world axes."""
    geoms: Any = context.model.geoms
    point, found = contacts.point(row), []
    for geom in contacts.geoms[row]:
        body = context.body(geoms.bodies[geom])
        w = body.angular_velocity
        found.append((body.velocity + w.cross(point - body.position), w))
    (v1, w1), (v2, w2) = found
    return v2 - v1, w2 - w1
