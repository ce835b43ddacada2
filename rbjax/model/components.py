"""The parts of a model: bodies, joints, actuators, sites and keyframes, each with its leaves."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax

from rbjax.model.record import Record, check_order


class Bodies(Record):
    """The moving bodies, in the order of the file.

    mass: (nb,) kg.
    com: (nb, 3) m, center of mass in the body's frame.
    inertia: (nb, 3, 3) kg m^2, about the center of mass, in the body's axes.
    position: (nb, 3) m, of the body's frame in its parent's at zero joint displacement.
    orientation: (nb, 4) quaternion of the body's frame in its parent's at zero joint displacement.
    """

    mass: jax.Array
    com: jax.Array
    inertia: jax.Array
    position: jax.Array
    orientation: jax.Array


class Joints(Record):
    """The joints. Coordinates are in rad or m.

    placement: (nj, 3) anchor of the joint in the frame of its body.
    axis: (nj, 3) in the frame of the joint's body; not used by ball and free joints.
    reference: (nq,) configuration at zero displacement of the joints, qpos0 of MJCF.
    armature, damping: (nv,) including the contributions of actuators at the joint.
    stiffness, springref: (nj,) and (nq,), of the joint's spring and its rest position.
    forcerange: (nj, 2) limits of the sum of the actuator forces on the joint.
    range: (nj, 2) limits of the coordinate; of a ball 0 and the largest angle of rotation.
    params: (n,) parameters of the joint kinds, such as the pitch of a screw, joint by joint.

    Limits that the file does not set are infinite. `rbjax.forces.JointLimits` enforces `range`.
    """

    placement: jax.Array
    axis: jax.Array
    reference: jax.Array
    armature: jax.Array
    damping: jax.Array
    stiffness: jax.Array
    springref: jax.Array
    forcerange: jax.Array
    range: jax.Array
    params: jax.Array

    def replace(self, **changes: Any) -> Joints:
        """Return a copy with the given fields changed. Arrays must keep their shapes.

        Raises:
            InputError: a number is not finite, or a range has its larger number first.
        """
        new = super().replace(**changes)
        for name in changes.keys() & {"range", "forcerange"}:
            check_order(f"Joints.replace({name}=...)", getattr(new, name))
        return new


class Actuators(Record):
    """Actuators with force = clip((g0 + g1 l + g2 l') clip(u) + b0 + b1 l + b2 l'), l = gear . q.

    One row for each control u; l is the length of the transmission, as in MuJoCo. Rows of actuators
    that are force elements, in `Model.forces`, are zero.

    gear: (nu, 6); at a site it is a wrench [force; torque] in the axes of the site.
    gain, bias: (nu, 3), g and b.
    ctrlrange, forcerange: (nu, 2) limits of u and of the force, infinite if the file sets none.
    joints, sites: the joint or the site on which each actuator acts, or -1; static.
    """

    gear: jax.Array
    gain: jax.Array
    bias: jax.Array
    ctrlrange: jax.Array
    forcerange: jax.Array
    joints: tuple[int, ...] = eqx.field(static=True)
    sites: tuple[int, ...] = eqx.field(static=True)


class Sites(Record):
    """Frames fixed to bodies: position (ns, 3) m and orientation (ns, 4) in the body's frame."""

    position: jax.Array
    orientation: jax.Array


class Keyframes(Record):
    """Named states: q (nk, nq), v (nk, nv), ctrl (nk, nu), and x (nk, n) of force elements."""

    q: jax.Array
    v: jax.Array
    ctrl: jax.Array
    x: jax.Array | None = None
