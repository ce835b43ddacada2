"""A robot file at one configuration: positions of its joints and bodies, masses, extents of shapes.

MuJoCo computes them at load time, in f64; nothing is traced. Vectors are in world axes. A joint
carries the bodies behind it; the chain of a body is the joints between the world and it.

The extent of a convex shape across an axle is its support h(d) = max over its points of d . x:

    sphere, capsule     h = r |d|  (+ l |d_z|)         cylinder    h = r |(d_x, d_y)| + l |d_z|
    ellipsoid           h = |s d|                      box         h = s . |d|
(Ericson, *Real-Time Collision Detection*, 9.5)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np

from rbjax.errors import InputError, UnknownName
from rbjax.loading.checks import data_of
from rbjax.loading.mjcf.fields import Bias, Dyn, Gain, Trn, Wrap, is_off, names_of, reflected
from rbjax.loading.mjcf.fields import reason_left_out as left_out_of
from rbjax.loading.sources import compile_model

_OBJ = mujoco.mjtObj
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True)
class Composite:
    """Several bodies as one: mass, com (3,), inertia (3, 3) about com."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray

    def about(self, axis: np.ndarray, point: np.ndarray) -> float:
        """The moment of inertia about a line."""
        away = self.com - point
        away = away - (away @ axis) * axis
        return float(axis @ self.inertia @ axis + self.mass * away @ away)


@dataclass(frozen=True)
class FileActuator:
    """An actuator on hinges: tau_j = arm_j f,  f = gain u + b0 + b1 l + b2 l',  l' = sum arm_j v_j.

    arms: joint -> arm.
    odd: the reason for which it has no such law; empty if it has.
    """

    name: str
    arms: Mapping[int, float]
    gain: float
    bias: tuple[float, ...]
    force: tuple[float, float]
    odd: str


@dataclass(frozen=True)
class AtRest:
    """A file at the configuration q (nq,) of its own compiled model."""

    source: Any
    m: mujoco.MjModel
    d: mujoco.MjData

    @property
    def joint_names(self) -> tuple[str, ...]:
        """All joints; one without a name is called joint0, joint1, ... by its number."""
        return names_of(self.m, _OBJ.mjOBJ_JOINT, self.m.njnt)

    def kind(self, j: int) -> str:
        """free, ball, slide or hinge."""
        return mujoco.mjtJoint(int(self.m.jnt_type[j])).name[6:].lower()

    def anchor(self, j: int) -> np.ndarray:
        """A point of the axis of a joint."""
        return self.d.xanchor[j].copy()

    def axis(self, j: int) -> np.ndarray:
        """The direction of the axis of a joint."""
        return self.d.xaxis[j].copy()

    def chain(self, body: int) -> tuple[int, ...]:
        """The joints between the world and a body, first to last."""
        up: list[int] = []
        while body:
            first, count = int(self.m.body_jntadr[body]), int(self.m.body_jntnum[body])
            up += range(first + count - 1, first - 1, -1)
            body = int(self.m.body_parentid[body])
        return tuple(reversed(up))

    def above(self, j: int) -> tuple[int, ...]:
        """The joints between the world and a joint."""
        chain = self.chain(int(self.m.jnt_bodyid[j]))
        return chain[: chain.index(j)]

    def behind(self, j: int) -> tuple[int, ...]:
        """The bodies that a joint carries."""
        return tuple(b for b in range(1, self.m.nbody) if j in self.chain(b))

    def root(self, j: int) -> int:
        """The body on the world from which a joint hangs."""
        return int(self.m.body_rootid[self.m.jnt_bodyid[j]])

    def tree(self, root: int) -> tuple[int, ...]:
        """All bodies that hang from a body on the world, with it."""
        return tuple(int(b) for b in np.flatnonzero(self.m.body_rootid == root))

    def body_name(self, body: int) -> str:
        return self.m.body(body).name

    def composite(self, bodies: Iterable[int]) -> Composite:
        """Several bodies as one rigid body."""
        rows = list(bodies)
        mass = self.m.body_mass[rows]
        whole = float(mass.sum())
        com = mass @ self.d.xipos[rows] / whole if whole > 0 else self.d.xpos[rows[0]].copy()
        turn = self.d.ximat[rows].reshape(-1, 3, 3)
        inertia = np.einsum("bij,bj,bkj->ik", turn, self.m.body_inertia[rows], turn)
        away = self.d.xipos[rows] - com
        inertia += np.einsum("b,bi,bi->", mass, away, away) * np.eye(3)
        inertia -= np.einsum("b,bi,bj->ij", mass, away, away)
        return Composite(whole, com, inertia)

    def frame(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """The origin and the rotation (3, 3) of a body, or of a site if no body has the name."""
        bodies = names_of(self.m, _OBJ.mjOBJ_BODY, self.m.nbody)[1:]
        sites = names_of(self.m, _OBJ.mjOBJ_SITE, self.m.nsite)
        if name in bodies:
            i = bodies.index(name) + 1
            return self.d.xpos[i].copy(), self.d.xmat[i].reshape(3, 3).copy()
        if name in sites:
            i = sites.index(name)
            return self.d.site_xpos[i].copy(), self.d.site_xmat[i].reshape(3, 3).copy()
        raise UnknownName("body or site", name, apart={"body": bodies, "site": sites})

    @property
    def gravity(self) -> np.ndarray:
        off = self.m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        return np.zeros(3) if off else self.m.opt.gravity.copy()

    def armature(self, j: int) -> float:
        """The armature of a hinge, with that of its actuators."""
        at = self.m.jnt_dofadr[j]
        return float(self.m.dof_armature[at] + reflected(self.m)[0][at])

    def damping(self, j: int) -> float:
        """The damping of a hinge in N m s/rad, with that of its actuators."""
        at = self.m.jnt_dofadr[j]
        off = self.m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_DAMPER)
        return 0.0 if off else float(self.m.dof_damping[at] + reflected(self.m)[1][at])

    def resisting(self, j: int) -> tuple[str, ...]:
        """The names of further forces that resist the motion of a hinge."""
        at = self.m.jnt_dofadr[j]
        found = {
            "friction loss": self.m.dof_frictionloss[at],
            "a spring": np.abs(self.m.jnt_stiffness[j]),
            "damping by powers of its rate": np.abs(self.m.dof_dampingpoly[at]).sum(),
        }
        return tuple(name for name, x in found.items() if x > 0)

    def round_shapes(self, joints: Sequence[int]) -> list[Round | None]:
        """The extents about each joint's axis of the shapes that the joint carries, or None.

        The links of a URDF are compiled with their shapes for this.
        """
        carried = [self.behind(j) for j in joints]
        m, names = self.m, {self.body_name(b) for bodies in carried for b in bodies}
        bare = not np.isin(m.geom_bodyid, [b for bodies in carried for b in bodies]).any()
        if bare and not isinstance(self.source, (mujoco.MjModel, mujoco.MjSpec)):
            m = compile_model(self.source, floating_base=None, shapes=names)
        out = []
        for j, bodies in zip(joints, carried, strict=True):
            frames = {
                m.body(self.body_name(b)).id: (self.d.xpos[b], self.d.xmat[b].reshape(3, 3))
                for b in bodies
            }
            out.append(round_shape(m, frames, self.anchor(j), self.axis(j)))
        return out

    def actuators(self) -> tuple[FileActuator, ...]:
        """The actuators of joints of one coordinate."""
        found = (_actuator(self.m, i) for i in range(self.m.nactuator) if not is_off(self.m, i))
        return tuple(x for x in found if x.arms)


def at_rest(source: Any, q: Any = None) -> AtRest:
    """A file, at its reference configuration or at q.

    Args:
        source: as for `rbjax.load`; a URDF gets a floating base.
        q: None, the name of a keyframe, values by names of hinges and slides, or (nq,).

    Raises:
        ModelError: the source cannot be read. UnknownName, InputError: q is none of these.
    """
    m = compile_model(source, floating_base=None)
    d = data_of(m)
    names = names_of(m, _OBJ.mjOBJ_JOINT, m.njnt)
    if isinstance(q, str):
        keys = names_of(m, _OBJ.mjOBJ_KEY, m.nkey)
        if q not in keys:
            raise UnknownName("keyframe", q, keys)
        d.qpos[:] = m.key_qpos[keys.index(q)]
    elif isinstance(q, Mapping):
        scalar = {n: int(m.jnt_qposadr[j]) for j, n in enumerate(names) if m.jnt_type[j] in _SCALAR}
        for name, value in q.items():
            if name not in scalar:
                raise UnknownName("joint", name, scalar)
            d.qpos[scalar[name]] = _finite(f"q[{name!r}]", value, ())
    elif q is not None:
        d.qpos[:] = _finite("q", q, (m.nq,))
    mujoco.mj_kinematics(m, d)
    mujoco.mj_comPos(m, d)
    return AtRest(source, m, d)


def _finite(what: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        x = np.asarray(value, float)
    except (TypeError, ValueError):
        x = np.full((), np.nan)
    if x.shape != shape or not np.isfinite(x).all():
        raise InputError(
            f"{what}: got {value!r}, expected {'a finite number' if not shape else f'{shape[0]} '}"
            f"{'' if not shape else 'finite numbers, as model.default_state().q has them, a '}"
            f"{'' if not shape else 'mapping of joints to values, or the name of a keyframe'}"
        )
    return x


def _actuator(m: mujoco.MjModel, i: int) -> FileActuator:
    name = mujoco.mj_id2name(m, _OBJ.mjOBJ_ACTUATOR, i) or f"actuator{i}"
    gear, target = float(m.actuator_gear[m.actuator_outadr[i], 0]), int(m.actuator_trnid[i, 0])
    arms: dict[int, float] = {}
    if m.actuator_trntype[i] in (Trn.JOINT, Trn.JOINTINPARENT):
        if m.jnt_type[target] in _SCALAR:
            arms[target] = gear
    elif m.actuator_trntype[i] == Trn.TENDON:
        at, count = int(m.tendon_adr[target]), int(m.tendon_num[target])
        for k in range(at, at + count):
            if m.wrap_type[k] == Wrap.JOINT:
                arms[int(m.wrap_objid[k])] = gear * float(m.wrap_prm[k])
    affine = m.actuator_biastype[i] == Bias.AFFINE
    known = m.actuator_gaintype[i] == Gain.FIXED and (affine or m.actuator_biastype[i] == Bias.NONE)
    odd = left_out_of(m, i)
    if not odd and m.actuator_dyntype[i] != Dyn.NONE:
        odd = "it has a state"
    elif not odd and not known:
        odd = "its force is not affine in control and speed"
    force = m.actuator_forcerange[i] if m.actuator_forcelimited[i] else (-np.inf, np.inf)
    bias = tuple(float(x) for x in m.actuator_biasprm[i, :3]) if affine else (0.0, 0.0, 0.0)
    gain, (low, high) = float(m.actuator_gainprm[i, 0]), force
    return FileActuator(name, arms, gain, bias, (float(low), float(high)), odd)


#: directions across the axle in which a shape is measured that is not round about it
DIRECTIONS = 360
#: shapes that reach this much of the farthest make the rim
RIM = 1.0 - 1e-6

#: vertices of a mesh that reach this much of the farthest are its rim, without hub and spokes
TREAD = 0.99
#: the sine of an angle up to which a cylinder lies along the axle: that of a file with pi/2 = 1.57
ALIGNED = 1e-3

_GEOM = mujoco.mjtGeom
_LONG = (int(_GEOM.mjGEOM_CYLINDER), int(_GEOM.mjGEOM_CAPSULE))
Frame = tuple[np.ndarray, np.ndarray]


class Round(NamedTuple):
    """The extent of shapes about an axle.

    radius: m, the distance of the farthest point from the axle.
    centre: (3,), on the axle, the middle of the shapes that reach that far.
    """

    radius: float
    centre: np.ndarray


def round_shape(
    m: mujoco.MjModel, frames: Mapping[int, Frame], anchor: np.ndarray, axis: np.ndarray
) -> Round | None:
    """The extents about an axis of the shapes of bodies whose frames are given.

    Shapes that touch others count; if there are none, the visual ones count.
    """
    own = [g for g in range(m.ngeom) if int(m.geom_bodyid[g]) in frames]
    touching = [g for g in own if m.geom_contype[g] or m.geom_conaffinity[g]]
    extents = [_extents(m, g, frames[int(m.geom_bodyid[g])], anchor, axis) for g in touching or own]
    found = [x for x in extents if x is not None]
    if not found:
        return None
    radius = max(x[0] for x in found)
    rim = [x for x in found if x[0] >= RIM * radius]
    middle = (min(x[1] for x in rim) + max(x[2] for x in rim)) / 2
    return Round(float(radius), anchor + middle * axis)


def _extents(
    m: mujoco.MjModel, g: int, frame: Frame, anchor: np.ndarray, axis: np.ndarray
) -> tuple[float, float, float] | None:
    """The distance of the farthest point from the axis, and both ends along it; of a mesh, those of
    its rim."""
    origin, turn = frame
    place = origin + turn @ m.geom_pos[g]
    own = np.empty(9)
    mujoco.mju_quat2Mat(own, m.geom_quat[g])
    turn = turn @ own.reshape(3, 3)
    away = place - anchor
    if m.geom_type[g] == int(_GEOM.mjGEOM_MESH):
        mesh = int(m.geom_dataid[g])
        at, count = int(m.mesh_vertadr[mesh]), int(m.mesh_vertnum[mesh])
        points = away + m.mesh_vert[at : at + count] @ turn.T
        along = points @ axis
        reach = np.linalg.norm(points - np.outer(along, axis), axis=1)
        rim = along[reach >= TREAD * reach.max()]
        return float(reach.max()), float(rim.min()), float(rim.max())
    if m.geom_type[g] in _LONG and np.linalg.norm(np.cross(axis, turn[:, 2])) < ALIGNED:
        turn = np.stack([*np.linalg.svd(axis[None])[2][1:], axis], 1)
    across = _directions(axis, away)
    reach = _support(int(m.geom_type[g]), m.geom_size[g], np.vstack([across, axis, -axis]) @ turn)
    if reach is None:
        return None
    radius = (reach[:-2] + across @ away).max()
    middle = away @ axis
    return float(radius), float(middle - reach[-1]), float(middle + reach[-2])


def _directions(axis: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Unit vectors across an axis, the first towards a shape that is off it."""
    first = away - (away @ axis) * axis
    if np.linalg.norm(first) < 1e-12:
        first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first = first / np.linalg.norm(first)
    angles = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    return np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(axis, first))


def _support(kind: int, size: np.ndarray, d: np.ndarray) -> np.ndarray | None:
    """h in unit directions (n, 3) of the shape's own axes; None of planes and height fields."""
    if kind == int(_GEOM.mjGEOM_SPHERE):
        return np.full(len(d), size[0])
    if kind == int(_GEOM.mjGEOM_CAPSULE):
        return size[0] + size[1] * np.abs(d[:, 2])
    if kind == int(_GEOM.mjGEOM_CYLINDER):
        return size[0] * np.hypot(d[:, 0], d[:, 1]) + size[1] * np.abs(d[:, 2])
    if kind == int(_GEOM.mjGEOM_ELLIPSOID):
        return np.linalg.norm(size * d, axis=1)
    if kind == int(_GEOM.mjGEOM_BOX):
        return np.abs(d) @ size
    return None
