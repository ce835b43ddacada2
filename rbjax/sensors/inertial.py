"""Sensors of an inertial unit at a frame, in the axes of the frame, and the wrench at the frame.

    gyro           R^T w                 velocimeter   R^T v
    accelerometer  R^T (p'' - g)         magnetometer  R^T B
    force, torque  R^T f, R^T n          of the parent on the body, at the frame
With the sum over the bodies b of the subtree, and the external wrenches on them:

    f = sum of m_b (c_b'' - g) - f_ext,   n = sum of (I_b w)' + (c_b - p) x m_b (c_b'' - g) - n_ext
(Featherstone, 5.3; MuJoCo, *XML reference*, sensor.)
"""

from __future__ import annotations

import equinox as eqx
import jax

from rbjax.arguments import real_array
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.lanes import Mat3, Vec3
from rbjax.model import WORLD, Frame, Model
from rbjax.model.leaves import frame_transform, table
from rbjax.model.links import lane
from rbjax.sensors.fixed import FrameSensor, named_frame, reading
from rbjax.sensors.frames import gravity
from rbjax.sensors.protocol import register
from rbjax.sensors.solution import solution_of
from rbjax.spatial import Force, Motion


@register("gyro", placed=True)
class Gyro(FrameSensor):
    """Measure the angular velocity R^T w (3,) of a frame in its own axes."""

    of = "rad/s"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, self.at(context).twist.ang)


@register("velocimeter", placed=True)
class Velocimeter(FrameSensor):
    """Measure the velocity R^T v (3,) of the origin of a frame in its own axes."""

    of = "m/s"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, self.at(context).twist.lin)


@register("accelerometer", placed=True)
class Accelerometer(FrameSensor):
    """Measure the specific force R^T (p'' - g) (3,) at a frame in its own axes.

    A sensor at rest measures g upwards. A sensor in free fall measures zero.
    """

    of = "m/s^2"

    def __call__(self, context: Context) -> jax.Array:
        moving = self.at(solution_of(context).accelerated)
        g = moving.rotation.T @ gravity(context)
        return reading(context, moving.own_acceleration.lin - g)


@register("magnetometer", placed=True)
class Magnetometer(FrameSensor):
    """Measure a magnetic field R^T B (3,) in the axes of a frame.

    field: B in world axes, in the unit of the readings; MuJoCo's default points along -y; static.
    """

    field: tuple[float, float, float] = eqx.field(static=True, default=(0.0, -0.5, 0.0))

    def __check_init__(self) -> None:
        if real_array("Magnetometer", "field", self.field, "(3,) numbers").shape != (3,):
            raise InputError(f"Magnetometer: field is {self.field}, expected three numbers")

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, self.at(context).rotation.T @ Vec3(*map(float, self.field)))


class WrenchSensor(FrameSensor):
    """Base class of a sensor of the wrench that the parent of a body exerts on it, at a frame."""

    def wrench(self, context: Context) -> Force:
        """Return the wrench in the axes of the frame."""
        frame, body = self.at(context), self._body(context.model)
        total = transmitted_wrench(context, body)
        arm = context.body(body).position - frame.position
        E = frame.rotation.T
        return Force(E @ (total.ang + arm.cross(total.lin)), E @ total.lin)

    def _body(self, model: Model) -> int:
        return frame_transform(model, named_frame(model, self.frame), float)[0]


@register("force", placed=True)
class ForceSensor(WrenchSensor):
    """Measure the force (3,) that the parent exerts on the body of a frame, in axes of the frame.

    It is the rate of momentum of the body and of all bodies that it carries, less their weight and
    the forces of contacts, connects, welds and spatial tendons and the given wrenches on them. At
    the tip of a beam it is the force of the tip's section, without the inertia of the beam.
    """

    of = "N"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, self.wrench(context).lin)


@register("torque", placed=True)
class TorqueSensor(WrenchSensor):
    """Measure the torque (3,) that the parent exerts on the body of a frame, about the origin of
    the frame and in its axes; see `ForceSensor`."""

    of = "N m"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, self.wrench(context).ang)


def transmitted_wrench(context: Context, body: int) -> Force:
    """Return the wrench of the parent on a body, in world axes at the origin of the body."""
    found: dict[int, Force] = context.once(transmitted_wrench, dict)
    top = context.model.topology
    # a body at a frame of a flexible link loads the parent of the link, not the body at its tip
    bases = {k: top.body_parents[top.joint_bodies[j]] for k, j, _ in top.frame_bodies}
    parents = [bases.get(k, parent) for k, parent in enumerate(top.body_parents)]

    def children(b: int) -> list[int]:
        return [k for k, parent in enumerate(parents) if parent == b]

    order, waiting = [], [body]
    while waiting:
        order.append(waiting.pop())
        waiting += [k for k in children(order[-1]) if k not in found]
    for b in reversed(order):
        if b in found:
            continue
        total = Force.zero() if b == WORLD else _rate_of_momentum(context, b)
        origin = context.body(b).position
        for k in children(b):
            arm, own = context.body(k).position - origin, found[k]
            total = total + Force(own.ang + arm.cross(own.lin), own.lin)
            if top.frames:
                total = total + _rate_of_flexible_link(context, k, origin)
        external = solution_of(context).body_wrenches.get(b)
        found[b] = total if external is None else total - external
    return found[body]


def _rate_of_momentum(context: Context, body: int) -> Force:
    """Return the rate of momentum of a body less its weight, in world axes at its origin."""
    bodies, dtype = context.model.bodies, context.q.dtype
    moving = solution_of(context).accelerated.frame(Frame(center=body))
    mass = lane(table(bodies.mass, dtype), body)
    J = table(bodies.inertia, dtype)
    inertia = Mat3(*(lane(J[:, i, j], body) for i in range(3) for j in range(3)))
    w, a = moving.twist.ang, moving.own_acceleration
    force = moving.rotation @ (a.lin * mass) - gravity(context) * mass
    torque = moving.rotation @ (inertia @ a.ang + w.cross(inertia @ w))
    arm = moving.position - context.body(body).position
    return Force(torque + arm.cross(force), force)


def _rate_of_flexible_link(context: Context, body: int, origin: Vec3) -> Force:
    """Return the rate of momentum less the weight of the flexible links that move a body, without
    the body, in world axes at a point `origin`."""
    solution, total = solution_of(context), Force.zero()
    links, rates = solution.accelerated.links, solution.acceleration
    for i, link in enumerate(context.model.topology.links):
        if link.body != body:
            continue
        joint, pose, w = links.to_parent(i)[1], links.pose(i), links.twist(i).ang
        a = links.acceleration(i)
        a = Motion(a.ang, a.lin - pose.R.T @ gravity(context))
        if joint.frame_axes is not None:
            own, _ = joint.own_momentum(Motion.zero())
            f = own(a) + own.bias_force(w)
        elif (modal := joint.link_inertia(w)) is not None:
            f, _ = modal.inertial_forces(w, a, [rates[n] for n in link.v])
        else:
            continue
        force, arm = pose.R @ f.lin, pose.p - origin
        total = total + Force(pose.R @ f.ang + arm.cross(force), force)
    return total
