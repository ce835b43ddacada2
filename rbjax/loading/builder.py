"""`ModelBuilder`: robots built by calls, from bodies, joints, shapes, sites, motors and robots.

The robot is a `mujoco.MjSpec`, which `build` loads.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from rbjax.arguments import choice, instance, real_array, real_number
from rbjax.errors import InputError, UnknownName
from rbjax.loading.builder_arguments import (
    attributes,
    found_by_name,
    limits,
    new_name,
    pose,
    vector,
)
from rbjax.loading.loader import load
from rbjax.loading.mjcf.fields import matrix_of
from rbjax.loading.sources import spec_of
from rbjax.loading.write.mjcf import write_mjcf
from rbjax.model import Model

_JOINTS = {
    "hinge": mujoco.mjtJoint.mjJNT_HINGE, "slide": mujoco.mjtJoint.mjJNT_SLIDE,
    "ball": mujoco.mjtJoint.mjJNT_BALL, "free": mujoco.mjtJoint.mjJNT_FREE,
}  # fmt: skip
_GEOMS = {
    name: getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}")
    for name in ("sphere", "capsule", "ellipsoid", "cylinder", "box", "plane")
}


class ModelBuilder:
    """Build a robot step by step. Positions and orientations (quaternions) are in the frame of the
    given body, or of the world if it is None.

    Args:
        source: initial robot, of any type that `attach` accepts; None for an empty world.
        gravity: (3,) m/s^2; None for the gravity of the source.
        timestep: s; None for the timestep of the source.

    Example:
        >>> import rbjax as rb
        >>> builder = rb.ModelBuilder()
        >>> builder.add_body("arm", mass=1.0, com=[0, 0, -0.5], inertia=[0.1, 0.1, 0.01])
        >>> builder.add_joint("shoulder", "arm", axis=[0, 1, 0], damping=0.1)
        >>> builder.add_site("tip", "arm", position=[0, 0, -1.0])
        >>> builder.add_motor("motor", "shoulder", gear=5.0)
        >>> model = builder.build()
        >>> model.nv, model.nu, model.site_names
        (1, 1, ('tip',))
    """

    def __init__(self, source: Any = None, *, gravity: Any = None, timestep: float | None = None):
        self.spec = mujoco.MjSpec() if source is None else _spec(source)
        if source is None:
            self.spec.compiler.degree = False
        if gravity is not None:
            self.spec.option.gravity = vector("ModelBuilder", "gravity", gravity, 3)
        if timestep is not None:
            step = real_number("ModelBuilder", "timestep", timestep, above=0.0)
            self.spec.option.timestep = step

    def add_body(
        self, name: str, parent: str | None = None, *, position: Any = (0, 0, 0),
        orientation: Any = (1, 0, 0, 0), mass: float | None = None, com: Any = (0, 0, 0),
        inertia: Any = None,
    ) -> None:  # fmt: skip
        """Add a body, welded to its parent until it has joints.

        Args:
            name: name of the body.
            parent: parent body; None for the world.
            position: (3,) m.
            orientation: (4,) quaternion.
            mass: kg; None computes mass and inertia from the body's geoms.
            com: (3,) m, center of mass.
            inertia: kg m^2 about the com in the body's axes: (3,) diagonal, or (3, 3).
        """
        where = "ModelBuilder.add_body"
        given: dict[str, Any] = {"name": new_name(where, "body", name, self.spec.bodies)}
        given |= pose(where, position, orientation)
        if mass is None:
            self._body(parent).add_body(**given)
            return
        mass, com = real_number(where, "mass", mass, least=0.0), vector(where, "com", com, 3)
        I = real_array(where, "inertia", np.zeros(3) if inertia is None else inertia)
        I = np.diag(vector(where, "inertia", I, 3)) if I.ndim == 1 else I
        if I.shape != (3, 3):
            raise InputError(f"{where}: inertia has shape {I.shape}, expected (3,) or (3, 3)")
        if not np.allclose(I, I.T):
            raise InputError(f"{where}: inertia is {I.tolist()}, expected a symmetric matrix")
        body = self._body(parent).add_body(**given)
        body.mass, body.ipos = mass, com
        body.fullinertia = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]
        body.explicitinertial = True

    def add_joint(
        self, name: str, body: str, kind: str = "hinge", *, axis: Any = (0, 0, 1),
        position: Any = (0, 0, 0), range: Any = None, **numbers: float,
    ) -> None:  # fmt: skip
        """Add a joint between a body and its parent, after the existing joints of the body.

        Args:
            name: name of the joint.
            body: child body of the joint.
            kind: "hinge", "slide", "ball" or "free".
            axis: (3,) axis of a hinge or slide, in the body's frame.
            position: (3,) m, the anchor in the body's frame.
            range: (2,) rad or m, smallest and largest coordinate.
            numbers: MuJoCo's attributes damping, stiffness, springref, armature, frictionloss, ref.
        """
        where = "ModelBuilder.add_joint"
        choice("kind of joint", kind, _JOINTS)
        given: dict[str, Any] = {"name": new_name(where, "joint", name, self.spec.joints)}
        given["type"] = _JOINTS[kind]
        if kind in ("hinge", "slide"):
            given["axis"] = vector(where, "axis", axis, 3)
        if kind != "free":
            given["pos"] = vector(where, "position", position, 3)
        if range is not None:
            given["range"] = limits(where, "range", range)
        known = ("damping", "stiffness", "springref", "armature", "frictionloss", "ref")
        for key, x in numbers.items():
            choice("parameter of a joint", key, known)
            x = real_number(where, key, x)
            polynomial = key in ("damping", "stiffness")
            given[key] = [x, 0.0, 0.0] if polynomial else x
        joint = self._body(body).add_joint(**given)
        if joint.compiler.degree and kind in ("hinge", "ball"):
            joint.range = np.rad2deg(joint.range)
            joint.ref, joint.springref = np.rad2deg([joint.ref, joint.springref])

    def add_geom(
        self, name: str, body: str | None, kind: str, size: Any, *, position: Any = (0, 0, 0),
        orientation: Any = (1, 0, 0, 0), **numbers: Any,
    ) -> None:  # fmt: skip
        """Add a shape to a body.

        Args:
            name: name of the geom.
            body: None for the world.
            kind: "sphere", "capsule", "ellipsoid", "cylinder", "box" or "plane".
            size: one to three numbers in m, as in `model.geoms.size`.
            position: (3,) m.
            orientation: (4,) quaternion.
            numbers: MuJoCo's attributes, such as friction, density, mass, contype, rgba.
        """
        where = "ModelBuilder.add_geom"
        choice("kind of geom", kind, _GEOMS)
        sizes = np.zeros(3)
        given = np.atleast_1d(real_array(where, "size", size))
        if given.ndim > 1 or not 1 <= given.size <= 3:
            raise InputError(f"{where}: size has shape {given.shape}, expected 1 to 3 numbers in m")
        sizes[: given.size] = given
        name = new_name(where, "geom", name, self.spec.geoms)
        numbers = attributes(where, numbers) | pose(where, position, orientation)
        self._body(body).add_geom(name=name, type=_GEOMS[kind], size=sizes, **numbers)

    def add_site(
        self, name: str, body: str | None, *, position: Any = (0, 0, 0),
        orientation: Any = (1, 0, 0, 0),
    ) -> None:  # fmt: skip
        """Add a site (a frame) to a body, at position (3,) m with orientation (4,)."""
        where = "ModelBuilder.add_site"
        name = new_name(where, "site", name, self.spec.sites)
        self._body(body).add_site(name=name, **pose(where, position, orientation))

    def add_motor(self, name: str, joint: str, *, gear: float = 1.0, ctrlrange: Any = None) -> None:
        """Add a motor to a joint with the force gear times control, in N m or N."""
        where = "ModelBuilder.add_motor"
        self._joint(joint)
        name = new_name(where, "actuator", name, self.spec.actuators)
        gear = real_number(where, "gear", gear)
        given: dict[str, Any] = {}
        if ctrlrange is not None:
            given["ctrlrange"] = limits(where, "ctrlrange", ctrlrange)
        self.spec.add_actuator(
            name=name, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gear=[gear, 0, 0, 0, 0, 0], **given,
        )  # fmt: skip

    def attach(
        self, source: Any, parent: str | None = None, *, prefix: str = "",
        position: Any = (0, 0, 0), orientation: Any = (1, 0, 0, 0),
    ) -> None:  # fmt: skip
        """Attach another robot to a body, with its joints, actuators, sites and shapes.

        Args:
            source: a source of `load`, a `Model`, or another builder. Models and URDFs are attached
                without meshes, and every robot without its floor.
            parent: parent body; None for the world.
            prefix: prefix of all names of the robot, which must differ from the existing names.
            position: (3,) m.
            orientation: (4,) quaternion.
        """
        where = "ModelBuilder.attach"
        instance(where, "prefix", prefix, str, "a word")
        placement = pose(where, position, orientation)
        other = _spec(source)
        floors = [x for x in other.worldbody.geoms if x.type == mujoco.mjtGeom.mjGEOM_PLANE]
        for x in (*other.keys, *floors):
            other.delete(x)
        frame = self._body(parent).add_frame(**placement)
        self.spec.attach(other, prefix=prefix, frame=frame)
        self._forget_keyframes()

    def lock(self, joint: str, q: Any = None) -> None:
        """Remove a joint, at the coordinates q; None for the reference configuration.

        The joint's actuators, equalities and sensors and the robot's keyframes are removed too. A
        robot with a tendon over the joint cannot be built after that.
        """
        own = self._joint(joint)
        body, kind = own.parent, mujoco.mjtJoint(own.type).name[6:].lower()
        n = {"ball": 4, "free": 7}.get(kind, 1)
        if q is not None:
            _move(body, own, kind, vector("ModelBuilder.lock", "q", q, n))
        spec = self.spec
        for x in (*spec.actuators, *spec.equalities, *spec.sensors):
            ends = [getattr(x, end, "") for end in ("target", "name1", "name2", "objname")]
            if joint in ends:
                spec.delete(x)
        spec.delete(own)
        self._forget_keyframes()

    def build(self, **options: Any) -> Model:
        """Load the model, with the options of `load`."""
        return load(self.spec.copy(), **options)

    def _forget_keyframes(self) -> None:
        for key in list(self.spec.keys):
            self.spec.delete(key)

    def _body(self, name: str | None) -> Any:
        if name is None:
            return self.spec.worldbody
        found = found_by_name(self.spec.body, name)
        if found is None:
            raise UnknownName("body", name, [b.name for b in self.spec.bodies])
        return found

    def _joint(self, name: str) -> Any:
        found = found_by_name(self.spec.joint, name)
        if found is None:
            raise UnknownName("joint", name, [j.name for j in self.spec.joints])
        return found


def _spec(source: Any) -> mujoco.MjSpec:
    """Make a new spec from a source of `ModelBuilder.attach`."""
    if isinstance(source, ModelBuilder):
        return source.spec.copy()
    if isinstance(source, Model):
        return mujoco.MjSpec.from_string(write_mjcf(source))
    spec = spec_of(source)
    return mujoco.MjSpec.from_string(write_mjcf(load(source))) if spec is None else spec


def _move(body: Any, joint: Any, kind: str, q: np.ndarray) -> None:
    """Move a body by a joint at q. Keep the body's earlier joints unchanged in the parent's frame
    (their anchors and axes are stored in the body's frame)."""
    turn, identity = np.array([1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
    shift = np.zeros(3)
    if kind in ("ball", "free"):
        turn = q[-4:] / np.linalg.norm(q[-4:])
    else:
        turning = kind == "hinge"
        ref = np.deg2rad(joint.ref) if turning and joint.compiler.degree else joint.ref
        axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
        if turning:
            mujoco.mju_axisAngle2Quat(turn, axis, float(q[0] - ref))
        else:
            shift = axis * (q[0] - ref)
    if kind == "free":
        body.pos, body.quat = q[:3], turn
        return
    R = matrix_of(turn)
    shift = shift + np.asarray(joint.pos) - R @ np.asarray(joint.pos)
    for other in body.joints[: [x.name for x in body.joints].index(joint.name)]:
        if other.type == mujoco.mjtJoint.mjJNT_BALL and (turn != identity).any():
            raise InputError(
                f"ModelBuilder.lock: {joint.name!r} turns after the ball {other.name!r} of its "
                "body, whose coordinates would change; lock the ball first"
            )
        other.pos = R.T @ (np.asarray(other.pos) - shift)
        other.axis = R.T @ np.asarray(other.axis)
    old = np.array(body.quat, float)
    body.pos = np.asarray(body.pos) + matrix_of(old) @ shift
    mujoco.mju_mulQuat(turn, old, turn.copy())
    body.quat = turn
