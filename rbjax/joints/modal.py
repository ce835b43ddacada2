"""Modal inertia: the inertia of a flexible link, which depends on the coordinate of its own joint.

With the twist V of a link and the rate of its coordinate q, the kinetic energy of the link is

    T = V.I(q) V / 2 + C(q).V q' + m(q) q'^2 / 2

I is the inertia of the deformed link, C couples the acceleration of the link with that of its mode
(Shabana, *Dynamics of Multibody Systems*, 5.3: floating frame of reference), and m is the modal
mass. Lagrange's equations of T in body axes give the wrench f and the generalized force tau. With
classical accelerations a of the origin they do not depend on its velocity:

    f   = I a + C q'' + [w x J w; w x (w x h)] + q' (w x* C + I_q [w; 0] + C_q q')
    tau = C.a + m q'' + m_q q'^2 / 2 - w.J_q w / 2
"""

from __future__ import annotations

from dataclasses import dataclass

import jax

from rbjax.lanes import Lane, Vec3, add, mul, sub
from rbjax.spatial import Force, Motion, RigidInertia, Transform


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ModalInertia:
    """The coefficients of the kinetic energy of a flexible link with one coordinate.

    Fields:
        rigid: inertia I of the deformed link; its mass is constant.
        coupling: momentum C [angular; linear] for a unit rate of the coordinate. The linear part is
            the derivative of the first moment of `rigid` by the coordinate.
        mass: modal mass m.

    Example:
        >>> from rbjax.joints import ModalInertia
        >>> from rbjax.lanes import Vec3
        >>> from rbjax.spatial import Force, RigidInertia
        >>> ModalInertia(RigidInertia.zero(), Force(Vec3.zero(), Vec3(0.5, 0.0, 0.0)), 0.25).mass
        0.25
    """

    rigid: RigidInertia
    coupling: Force
    mass: Lane

    def at_frame(self, T: Transform, S: Motion) -> ModalInertia:
        """Return the coefficients for the twist of a frame at T, which moves with the twist S q'.

        S is relative to the frame in which the coefficients are given, in the axes of T.
        """
        E, f = T.E, self.coupling
        rigid = self.rigid.shifted(-T.p).rotated(E)
        C = Force(E @ (f.ang - T.p.cross(f.lin)), E @ f.lin)
        along = rigid(S)
        mass = add(self.mass, add(S.dot(along), mul(-2.0, S.dot(C))))
        return ModalInertia(rigid, C - along, mass)

    def momentum(self, V: Motion, rate: Lane) -> tuple[Force, Lane]:
        """Compute C q' and C.V + m q'; the momentum I V of the rigid inertia is not included."""
        return self.coupling * rate, add(V.dot(self.coupling), mul(self.mass, rate))

    def kinetic_energy(self, V: Motion, rate: Lane) -> Lane:
        """Compute V.I V / 2 + C.V q' + m q'^2 / 2."""
        own, square = V.dot(self.rigid(V)), mul(mul(self.mass, rate), rate)
        return add(mul(0.5, add(own, square)), mul(V.dot(self.coupling), rate))

    def velocity_forces(self, slope: ModalInertia, w: Vec3, rate: Lane) -> tuple[Force, Lane]:
        """Compute the wrench and joint force of velocities, without the terms of `rigid`.

        `slope` has the derivatives of all coefficients by the coordinate.
        """
        turn = Motion(w, Vec3.zero())
        own = slope.rigid(turn)
        f = (turn.cross_force(self.coupling) + own + slope.coupling * rate) * rate
        return f, mul(0.5, sub(mul(mul(slope.mass, rate), rate), w.dot(own.ang)))


#: the modal inertia of a rigid link
RIGID = ModalInertia(RigidInertia.zero(), Force.zero(), 0.0)
