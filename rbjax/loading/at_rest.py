"""Geometry and masses of a robot file at one configuration: joints, bodies, extents of shapes.

MuJoCo computes them in f64 at load time, so they are not traced. Vectors are in world axes. A joint
carries the bodies of its subtree. The chain of a body is the joints between the world and the body.

The extent of a convex shape in the direction d is its support h(d) = max over its points of d . x:

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
from rbjax.loading.checks import check_finite_fields, data_of
from rbjax.loading.mjcf.fields import (
    Bias,
    Dyn,
    Gain,
    Trn,
    Wrap,
    is_off,
    matrix_of,
    names_of,
    reflected,
)
from rbjax.loading.mjcf.fields import reason_left_out as left_out_of
from rbjax.loading.sources import compile_model

_OBJ = mujoco.mjtObj
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True)
class Composite:
    """Several bodies as one rigid body: mass, com (3,), inertia (3, 3) about com."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray

    def about(self, axis: np.ndarray, point: np.ndarray) -> float:
        """Compute the moment of inertia about a line through a point."""
        away = self.com - point
        away = away - (away @ axis) * axis
        return float(axis @ self.inertia @ axis + self.mass * away @ away)


@dataclass(frozen=True)
class FileActuator:
    """An actuator on hinges: tau_j = arm_j f, f = gain u + b . (1, l, l')."""

    name: str
    arms: Mapping[int, float]  # moment arms by joint, with l' = sum arm_j v_j
    gain: float
    bias: tuple[float, ...]  # b
    force: tuple[float, float]
    odd: str  # reason why the actuator does not have this force law; empty if it has


@dataclass(frozen=True)
class AtRest:
    """A robot file at the configuration q (nq,) of its compiled MuJoCo model."""

    source: Any
    m: mujoco.MjModel
    d: mujoco.MjData

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of all joints; a joint without a name is called joint0, joint1, ..."""
        return names_of(self.m, _OBJ.mjOBJ_JOINT, self.m.njnt)

    def kind(self, j: int) -> str:
        """Return the type of a joint: free, ball, slide or hinge."""
        return mujoco.mjtJoint(int(self.m.jnt_type[j])).name[6:].lower()

    def anchor(self, j: int) -> np.ndarray:
        """Return a point on the axis of a joint."""
        return self.d.xanchor[j].copy()

    def axis(self, j: int) -> np.ndarray:
        """Return the direction of the axis of a joint."""
        return self.d.xaxis[j].copy()

    def chain(self, body: int) -> tuple[int, ...]:
        """List the joints between the world and a body, from the world on."""
        up: list[int] = []
        while body:
            first, count = int(self.m.body_jntadr[body]), int(self.m.body_jntnum[body])
            up += range(first + count - 1, first - 1, -1)
            body = int(self.m.body_parentid[body])
        return tuple(reversed(up))

    def above(self, j: int) -> tuple[int, ...]:
        """List the joints between the world and a joint."""
        chain = self.chain(int(self.m.jnt_bodyid[j]))
        return chain[: chain.index(j)]

    def behind(self, j: int) -> tuple[int, ...]:
        """List the bodies that a joint carries."""
        return tuple(b for b in range(1, self.m.nbody) if j in self.chain(b))

    def root(self, j: int) -> int:
        """Return the child of the world whose tree contains a joint."""
        return int(self.m.body_rootid[self.m.jnt_bodyid[j]])

    def tree(self, root: int) -> tuple[int, ...]:
        """List all bodies of the tree of a root body, including the root."""
        return tuple(int(b) for b in np.flatnonzero(self.m.body_rootid == root))

    def body_name(self, body: int) -> str:
        return self.m.body(body).name

    def composite(self, bodies: Iterable[int]) -> Composite:
        """Combine several bodies into one rigid body."""
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
        """Return the origin and the rotation (3, 3) of a body, or of a site if no body has the
        name."""
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
        """Return the armature of a hinge, including its actuators' armature."""
        at = self.m.jnt_dofadr[j]
        return float(self.m.dof_armature[at] + reflected(self.m)[0][at])

    def damping(self, j: int) -> float:
        """Return the damping of a hinge in N m s/rad, including its actuators' damping."""
        at = self.m.jnt_dofadr[j]
        off = self.m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_DAMPER)
        return 0.0 if off else float(self.m.dof_damping[at] + reflected(self.m)[1][at])

    def resisting(self, j: int) -> tuple[str, ...]:
        """List the further passive forces of a hinge: friction loss, spring, nonlinear damping."""
        at = self.m.jnt_dofadr[j]
        found = {
            "friction loss": self.m.dof_frictionloss[at],
            "a spring": np.abs(self.m.jnt_stiffness[j]),
            "damping by powers of its rate": np.abs(self.m.dof_dampingpoly[at]).sum(),
        }
        return tuple(name for name, x in found.items() if x > 0)

    def round_shapes(self, joints: Sequence[int]) -> list[Round | None]:
        """Compute the extents about each joint's axis of the shapes that the joint carries; None
        without shapes.

        A URDF is compiled again with the shapes of these links.
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
        """List the enabled actuators of hinges and slides."""
        found = (_actuator(self.m, i) for i in range(self.m.nactuator) if not is_off(self.m, i))
        return tuple(x for x in found if x.arms)


def at_rest(source: Any, q: Any = None) -> AtRest:
    """Compute the geometry and masses of a file at its reference configuration or at q. A URDF gets
    a floating base.

    q: the name of a keyframe, a mapping from hinges and slides to values, or an array (nq,).
    """
    m = compile_model(source, floating_base=None)
    check_finite_fields(m)
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


#: number of directions across the axle in which a shape that is not round about it is measured
DIRECTIONS = 360
#: part of the largest radius that a shape must reach to belong to the rim
RIM = 1.0 - 1e-6

#: part of the largest radius that a vertex of a mesh must reach to belong to its rim
TREAD = 0.99
#: sine of the angle up to which a cylinder is aligned with the axle (a file may have pi/2 = 1.57)
ALIGNED = 1e-3

_GEOM = mujoco.mjtGeom
_LONG = (int(_GEOM.mjGEOM_CYLINDER), int(_GEOM.mjGEOM_CAPSULE))
Frame = tuple[np.ndarray, np.ndarray]


class Round(NamedTuple):
    """The extent of shapes about an axle."""

    radius: float  # m, distance of the farthest point from the axle
    centre: np.ndarray  # (3,) m, on the axle, midpoint of the shapes on the rim


def round_shape(
    m: mujoco.MjModel, frames: Mapping[int, Frame], anchor: np.ndarray, axis: np.ndarray
) -> Round | None:
    """Compute the extent of bodies' shapes about an axis, at given frames of the bodies.

    Collision shapes are used; if there are none, the visual shapes.
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
    """Compute the distance of the farthest point of a geom from the axis, and both ends of the geom
    along the axis; for a mesh the ends of its rim. Return None for a plane or a height field."""
    origin, turn = frame
    place = origin + turn @ m.geom_pos[g]
    turn = turn @ matrix_of(m.geom_quat[g])
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
    """Return unit vectors evenly around an axis, orthogonal to it. The first one is in the plane of
    `away`."""
    first = away - (away @ axis) * axis
    if np.linalg.norm(first) < 1e-12:
        first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first = first / np.linalg.norm(first)
    angles = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    return np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(axis, first))


def _support(kind: int, size: np.ndarray, d: np.ndarray) -> np.ndarray | None:
    """Compute the support h in unit directions (n, 3) in the shape's axes; None for planes and
    height fields."""
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
