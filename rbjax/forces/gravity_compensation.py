"""Gravity compensation: forces that carry all or a part of the weight of bodies.

    w_b = -c_b m_b g   at the body's center of mass,      tau = sum over bodies of J_b^T w_b

c = 1 makes a body weightless; c = 2 lets it rise as fast as it would fall. On all joints these are
constant forces with the energy V = sum of c_b m_b g . p_b, p_b the center of mass. The actuators of
some joints may apply their part, which is then clipped to the force ranges of these joints (MuJoCo:
`actuatorgravcomp` of a joint). The part of the other joints is passive. Such a robot has two
elements, one for the passive joints and one for the actuated ones.
"""

from __future__ import annotations

import equinox as eqx
import jax

from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.lanes import Lane, Vec3, inner, is_zero, mul, total
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane


class GravityCompensation(Element):
    """Forces against the weight of bodies.

    w_b = -c_b m_b g at the center of mass of each body.

    fraction: c (n,), compensated fraction of each body's weight.
    bodies: names or indices of the bodies; static.
    joints: names or indices of the joints on which the forces act, None for all; static.
    actuated: whether the forces are actuator forces: absent without controls, and clipped to the
        force ranges of the joints; static.

    Source: MuJoCo, XML reference, body gravcomp and joint actuatorgravcomp.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("two_link")
        >>> held = rb.forces.GravityCompensation(jnp.ones(model.nb), model.body_names)
        >>> state = model.default_state()
        >>> tau = rb.applied_forces(model.with_forces(held), state)
        >>> bool(jnp.allclose(tau, rb.gravity_forces(model, state.q)))
        True
    """

    fraction: jax.Array
    bodies: tuple[str | int, ...] = eqx.field(static=True)
    joints: tuple[str | int, ...] | None = eqx.field(static=True, default=None)
    actuated: bool = eqx.field(static=True, default=False)
    unlimited = ()

    @property
    def actuates(self) -> bool:
        return self.actuated

    def shapes(self, model: Model) -> Shapes:
        return {"fraction": (len(self.bodies),)}

    def loads(self, context: Context) -> Loads:
        f_ext = Loads()
        for frame, force in self._lifted(context):
            f_ext = f_ext + frame.push(force)
        if self.joints is None and not self.actuated:
            return f_ext
        if not f_ext.wrenches:
            return Loads()
        top, tau = context.model.topology, context.generalized_of(f_ext.wrenches)
        named = range(len(top.joint_kinds)) if self.joints is None else self.joints
        joints = [context.model.joint(j) for j in named]
        at = [top.joint_v[j] + k for j in joints for k in range(top.joints[j].nv)]
        return Loads({i: tau[i] for i in at})

    def energy(self, context: Context) -> Lane:
        """Compute the energy sum of c m g . p if the forces act on all joints. On only some joints
        the forces are not conservative, and the energy is 0."""
        if self.joints is not None:
            return 0.0
        return total(-inner(force, frame.position) for frame, force in self._lifted(context))

    def _lifted(self, context: Context) -> list:
        """List the frame at the center of mass of each body, and the force on it."""
        model, dtype, out = context.model, context.q.dtype, []
        mass, com = table(model.bodies.mass, dtype), table(model.bodies.com, dtype)
        fraction, gravity = table(self.fraction, dtype), table(model.gravity, dtype)
        for n, name in enumerate(self.bodies):
            b = model.body(name)
            lift = mul(-1.0, mul(lane(fraction, n), lane(mass, b)))
            force = Vec3(*(mul(lift, lane(gravity, k)) for k in range(3)))
            if not all(map(is_zero, force)):
                out.append(
                    (context.body(b).at(Vec3(*(lane(com[:, k], b) for k in range(3)))), force)
                )
        return out
