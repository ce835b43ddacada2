"""Solids of a model without geoms: rods between joints, and ellipsoids of inertia.

The ellipsoid is inscribed in the box of uniform density with the mass and inertia of the body. The
box has the half lengths a_i: m a_i^2 / 3 = (I_1 + I_2 + I_3) / 2 - I_i. An axis that would be
larger than the robot is limited to the robot's size.
"""

from __future__ import annotations

import colorsys

import numpy as np

from rbjax.dynamics.arguments import check_model
from rbjax.lanes import quaternion_matrix
from rbjax.model import WORLD, Model
from rbjax.plotting.flexible_links import flexible_links, tubes
from rbjax.plotting.solid_shapes import Solid, capsule, cylinder, ellipsoid, sphere
from rbjax.style import BLUE, GREEN, INK, PALETTE, RED, rgb

Array = np.ndarray


def skeleton(model: Model) -> list[Solid]:
    """Make solids of a model from its parameters, without a file or geoms.

    Args:
        model: one robot; lengths in m.

    Returns:
        Rods from joint to joint and to the ends of last bodies, a pin at each hinge, a rail along
        each slide, ellipsoids of inertia, red, green and blue axes on floating bodies, and tubes
        along flexible links.

    Raises:
        InputError: not a model, or a batch of models.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.plotting import skeleton
        >>> len(skeleton(rb.load("double_pendulum")))  # for each of two: rod, pin, ellipsoid
        6
    """
    check_model("skeleton", model)
    own = _Skeleton(model)
    return own.solids() + tubes(model, own.colors())


class _Skeleton:
    """The parameters of a model as arrays, and the solids made from them."""

    def __init__(self, model: Model):
        top = model.topology
        self.parents, self.kinds = top.body_parents, top.joint_kinds
        self.joints: list[list[int]] = [[] for _ in range(top.nb)]
        for joint, body in enumerate(top.joint_bodies):
            self.joints[body].append(joint)
        self.children: list[list[int]] = [[] for _ in range(top.nb)]
        for body, parent in enumerate(self.parents):
            if parent != WORLD:
                self.children[parent].append(body)
        bodies, joints = model.bodies, model.joints
        self.mass, self.com, self.inertia, self.position = (
            np.asarray(x, float) for x in (bodies.mass, bodies.com, bodies.inertia, bodies.position)
        )
        self.links = {link.body: link for link in flexible_links(model)}
        self.frames = {body: (top.joint_bodies[j], k) for body, j, k in top.frame_bodies}
        self.frames |= {body: (body, link.joint.body_frame) for body, link in self.links.items()}
        self.anchor, self.axis, self.range = (
            np.asarray(x, float) for x in (joints.placement, joints.axis, joints.range)
        )
        turn = quaternion_matrix(*np.asarray(bodies.orientation, float).T)
        self.turn = np.stack([*turn], -1).reshape(-1, 3, 3)
        self.size = self._size()
        self.radius = 0.016 * self.size

    def hub(self, body: int) -> Array:
        """Return the joint by which a body is attached to its parent, in the body's frame. Without
        a joint it is the body's origin; for a free body it is the centre of mass."""
        held = [j for j in self.joints[body] if self.kinds[j] != "free"]
        if held:
            return self.anchor[held[-1]]
        return self.com[body] if self.joints[body] else np.zeros(3)

    def held_at(self, body: int) -> Array:
        """Compute the joint of a body (`hub`) in the frame of its parent, with joints at zero."""
        return self.position[body] + self.turn[body] @ self.hub(body)

    def _size(self) -> float:
        """Compute the extent of the robot with its joints at zero, m."""
        R: list[Array] = []
        p: list[Array] = []
        points: list[Array] = []
        base: dict[int, tuple[Array, Array]] = {}
        for body, parent in enumerate(self.parents):
            free = any(self.kinds[j] == "free" for j in self.joints[body])
            Rp, pp = (np.eye(3), np.zeros(3)) if parent == WORLD else (R[parent], p[parent])
            place = np.zeros(3) if free else self.position[body]
            R.append(Rp @ self.turn[body])
            p.append(pp + Rp @ place)
            if body in self.links:
                base[body] = R[body], p[body]
            if body in self.frames:  # a frame of a flexible link
                owner, k = self.frames[body]
                (R0, p0), (frame_R, frame_p) = base[owner], self.links[owner].at_rest()
                R[body], p[body] = R0 @ frame_R[k], p0 + R0 @ frame_p[k]
            points += [p[body] + R[body] @ x for x in (self.com[body], self.hub(body))]
        extent = float(np.ptp(np.array(points), axis=0).max()) if points else 0.0
        axes = [self._semi_axes(b)[0].max() for b in range(len(self.parents))]
        return extent if extent > 1e-9 else 2.0 * max([*axes, 0.0]) or 1.0

    def _semi_axes(self, body: int) -> tuple[Array, Array]:
        """Compute lengths (3,) and directions (3, 3), by column, of the ellipsoid of inertia."""
        if not self.mass[body] > 0:
            return np.zeros(3), np.eye(3)
        values, vectors = np.linalg.eigh(self.inertia[body])
        square = 3.0 / self.mass[body] * (values.sum() / 2 - values)
        return np.sqrt(np.maximum(square, 0.0)), vectors

    def colors(self) -> list[tuple[float, float, float]]:
        """Choose a colour for each limb, lighter from body to body along it."""
        limb, depth = [0] * len(self.parents), [0] * len(self.parents)
        limbs = 0
        for body, parent in enumerate(self.parents):
            if parent == WORLD or len(self.children[parent]) > 1:
                limb[body], limbs = limbs, limbs + 1
            else:
                limb[body], depth[body] = limb[parent], depth[parent] + 1
        return [
            _lighter(PALETTE[k % len(PALETTE)], 0.10 * (d % 4))
            for k, d in zip(limb, depth, strict=True)
        ]

    def solids(self) -> list[Solid]:
        out: list[Solid] = []
        colors, ink, r = self.colors(), rgb(INK), self.radius
        for body, color in enumerate(colors):
            # the ellipsoid before the rod inside it: at equal depth, the later solid is in front
            out += self._ellipsoid(body, color)
            hub = self.hub(body)
            ends = [self.held_at(child) for child in self.children[body]] or [self._tip(body, hub)]
            rods = [end for end in ends if np.linalg.norm(end - hub) > 0.5 * r]
            out += [Solid(capsule(hub, end, r), body, color, 1.0) for end in rods]
            for joint in self.joints[body]:
                if body not in self.links:
                    out += self._joint(body, joint, ink)
        return out

    def _tip(self, body: int, hub: Array) -> Array:
        """Compute the end of a last body: on its ellipsoid, in the direction of its centre of
        mass."""
        com, (axes, directions) = self.com[body], self._semi_axes(body)
        way = com - hub
        if not np.linalg.norm(way) > 0 or not axes.min() > 0:
            return com
        reach = 1.0 / np.linalg.norm(directions.T @ way / axes)  # in units of way
        return com + way * min(reach, 1.0)

    def _ellipsoid(self, body: int, color: tuple[float, float, float]) -> list[Solid]:
        axes, directions = self._semi_axes(body)
        alone = len(self.parents) == 1
        axes = np.clip(axes, 0.8 * self.radius, self.size * (2.0 if alone else 0.6))
        if not self.mass[body] > 0:
            return []
        points = ellipsoid(*axes) @ directions.T + self.com[body]
        return [Solid(points, body, _lighter(color, 0.3), 0.45)]

    def _joint(self, body: int, joint: int, ink: tuple[float, float, float]) -> list[Solid]:
        kind, at, r = self.kinds[joint], self.anchor[joint], self.radius
        if kind == "hinge":
            pin = cylinder(1.15 * r, 1.5 * r) @ _towards(self.axis[joint]).T
            return [Solid(pin + at, body, ink, 1.0)]
        if kind == "slide":
            reach = self.range[joint]
            reach = reach if np.isfinite(reach).all() else np.array([-0.5, 0.5]) * self.size
            turn = self.turn[body]
            begin, end = (self.position[body] + turn @ (at + x * self.axis[joint]) for x in reach)
            return [Solid(capsule(begin, end, 0.3 * r), self.parents[body], ink, 0.5)]
        length = max(0.15 * self.size, 1.15 * self._semi_axes(body)[0].max(initial=0.0))
        length = min(length, 0.75 * self.size)
        centre = self.com[body] if kind == "free" else at
        pins = zip(np.eye(3), (RED, GREEN, BLUE), strict=True)
        axes = [
            Solid(capsule(centre, centre + length * x, 0.35 * r), body, rgb(c), 1.0)
            for x, c in pins
        ]
        return axes if kind == "free" else [Solid(sphere(1.4 * r) + at, body, ink, 1.0), *axes]


def _towards(axis: Array) -> Array:
    """Compute a rotation that maps z to an axis."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], -1)


def _lighter(color: object, by: float) -> tuple[float, float, float]:
    """Lighten a colour towards white. by: a fraction from 0 to 1."""
    hue, light, saturation = colorsys.rgb_to_hls(*rgb(color))
    return colorsys.hls_to_rgb(hue, light + by * (1 - light), saturation)
