"""Elasticity of a cable: bending and torsion between neighbouring rigid segments on ball joints.

The segments of a cable are bodies in a chain. R = exp(phi) is the attitude of a segment in its
parent, x is the axis of the cable, L the distance of neighbouring joints, and

    s = -K (phi - phi_0) / L,    K = diag(G J, E I_y, E I_z)

the elastic torque on the segment in the parent's axes; -s acts on the parent. The generalized force
of the ball joint, whose velocity is in the axes of the segment, is

    tau = R^T s                law = "mujoco"
    tau = J_l(phi)^-1 s        law = "gradient"

The first law is MuJoCo's plugin. It has a potential only if K is isotropic and phi_0 is zero. The
second law is the gradient of V = (phi - phi_0) . K (phi - phi_0) / (2 L), because phi' = J_r^-1 w
and J_r(phi)^-T = J_l(phi)^-1. Both are equal if phi is parallel to s, for example in the plane.
They differ by [phi] s / 2 to first order in phi. A free body on a cable of a rectangular section,
1 : 3, bent by 0.7 rad gains or loses a third of its energy in two seconds with the first law.

The cable neither stretches nor shears. Its error falls as the square of the length of a segment.
phi is at most half a turn: a segment that turns further springs to the other side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice
from rbjax.dynamics.arguments import check_array, check_model
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.forces.slopes import Slope
from rbjax.lanes import Lane, Mat3, Vec3, inner, is_literal, mul, neg, sub, total
from rbjax.model import Model
from rbjax.model.leaves import scalar, table
from rbjax.model.links import lane
from rbjax.rotations import quaternion
from rbjax.rotations.coefficients import inverse_left_lanes, polynomial, stumpff

#: laws of the torque
LAWS = ("gradient", "mujoco")


class Cable(Element):
    """Bending and torsion of a chain of bodies on ball joints, as of MuJoCo's cables.

    tau = -J_l(phi)^-1 K (phi - phi_0) / L with K = diag(G J, E I_y, E I_z) and the rotation phi of
    a segment from its parent. The axis of the cable is x of the segments. With `law="mujoco"` it is
    -R^T K (phi - phi_0) / L, the law of MuJoCo's plugin, which has no potential at large angles.

    Fields:
        twist: shear modulus G, Pa.
        bend: Young's modulus E, Pa.
        section: (n, 3), the torsion constant J and the second moments of area I_y, I_z of each
            segment, m^4.
        length: (n,), distance of the joint of a segment from the joint of its parent, m.
        rest: (n, 3), rotation phi_0 of a segment from its parent without stress, rad.
        joints: the ball joints of the segments, names or indices; static.
        law: "gradient" or "mujoco"; static.

    `Cable.of` makes it from a circular or rectangular section. The integrators `discrete` and
    `variational_midpoint` are implicit in its stiffness.

    Source: MuJoCo 3, plugin/elasticity, `mujoco.elasticity.cable`; the Jacobian is Sola's,
    arXiv:1812.01537, eq. 146.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load('''<mujoco><worldbody><body name="a"><geom size=".1" mass="1"/>
        ...     <body pos="1 0 0"><joint name="j" type="ball"/><geom size=".1" mass="1"/></body>
        ... </body></worldbody></mujoco>''')
        >>> cable = rb.forces.Cable.of(model, ["j"], twist=8e6, bend=2e7, radius=0.01)
        >>> state = model.default_state().replace(q=jnp.array([0.8, 0.0, 0.6, 0.0]))
        >>> tau = rb.applied_forces(model.with_forces(cable), state)
        >>> bool(abs(tau[1] + 0.2022) < 1e-4)  # E I angle / L
        True
    """

    twist: jax.Array
    bend: jax.Array
    section: jax.Array
    length: jax.Array
    rest: jax.Array
    joints: tuple[str | int, ...] = eqx.field(static=True)
    law: str = eqx.field(static=True, default="gradient")
    unlimited = ()
    positive = ("length",)

    @classmethod
    def of(
        cls, model: Model, joints: Sequence[str | int], *, twist: Any, bend: Any,
        radius: Any = None, half_sizes: Any = None, length: Any = None, flat: bool = False,
        law: str = "gradient",
    ) -> Cable:  # fmt: skip
        """Make the elasticity of the segments that ball joints of a model carry.

        Args:
            model: the robot.
            joints: names or indices of the ball joints, one for each segment with a stiffness.
            twist, bend: moduli G and E, Pa.
            radius: radius of a circular section, m.
            half_sizes: (2,) m, half width along y and z of a rectangular section, instead of
                `radius`.
            length: (n,) or a number, m; None for the distances of the bodies' frames.
            flat: whether the cable without stress is straight. Otherwise its shape without stress
                is the model's at zero rotations of the joints.
            law: "gradient" or "mujoco".

        Raises:
            InputError: other joints than balls, no section or two, a distance of zero.
        """
        check_model("Cable.of", model)
        index = [model.joint(j) for j in joints]
        if (radius is None) == (half_sizes is None):
            raise InputError(
                "Cable.of: got radius and half_sizes, expected one of them"
                if radius is not None
                else "Cable.of: got no section, expected radius=..., m, or half_sizes=(y, z), m"
            )
        one = circle(radius) if half_sizes is None else rectangle(*half_sizes)
        bodies = np.array([model.topology.joint_bodies[j] for j in index], int)
        n, dtype = len(index), model.gravity.dtype
        if length is None:
            length = jnp.linalg.norm(model.bodies.position[bodies], axis=-1)
        turn = jnp.zeros((n, 3)) if flat else quaternion.log(model.bodies.orientation[bodies])
        L = jnp.broadcast_to(check_array("Cable.of", "length", length, (), (n,)), (n,))
        G, E = (check_array("Cable.of", k, x, ()) for k, x in (("twist", twist), ("bend", bend)))
        rows = jnp.broadcast_to(jnp.asarray(one), (n, 3))
        G, E, rows, L, turn = (jnp.asarray(x, dtype) for x in (G, E, rows, L, turn))
        return cls(G, E, rows, L, turn, tuple(joints), law)

    def __check_init__(self) -> None:
        super().__check_init__()
        choice("law of a cable", self.law, LAWS)

    def shapes(self, model: Model) -> Shapes:
        kinds = [model.topology.joint_kinds[model.joint(j)] for j in self.joints]
        others = [f"{j} ({k})" for j, k in zip(self.joints, kinds, strict=True) if k != "ball"]
        if others:
            raise InputError(
                f"Cable: got the joints {', '.join(others)}, expected ball joints; for hinges use "
                "model.joints.stiffness"
            )
        n = len(self.joints)
        each: Shapes = {"section": (n, 3), "length": (n,), "rest": (n, 3)}
        return {"twist": (), "bend": (), **each}

    def loads(self, context: Context) -> Loads:
        out = Loads()
        for joint, phi, stretch, stiffness in self._segments(context):
            stress = Vec3(*(mul(neg(k), x) for k, x in zip(stiffness, stretch, strict=True)))
            tau = Mat3(*self._to_dofs(phi)) @ stress
            out = out + joint.push(*tau)
        return out

    def slopes(self, context: Context) -> list[Slope]:
        """Compute the stiffness of each segment, K / L along the rows of J_r^-1. It is exact for
        the straight cable and positive semidefinite at any angle."""
        out = []
        for joint, phi, _, stiffness in self._segments(context):
            rows = inverse_left_lanes([-x for x in phi])
            for a, k in enumerate(stiffness):
                arms = {joint.start + b: rows[3 * a + b] for b in range(3)}
                out.append(Slope(arms, k, 0.0))
        return out

    def energy(self, context: Context) -> Lane:
        """Compute the elastic energy, J: the sum of (phi - phi_0) . K (phi - phi_0) / (2 L). It is
        the potential of the law "gradient"."""
        return total(
            mul(0.5, inner([mul(k, x) for k, x in zip(stiffness, stretch, strict=True)], stretch))
            for _, _, stretch, stiffness in self._segments(context)
        )

    def _to_dofs(self, phi: list) -> list:
        """Return the matrix, row by row, from the stress to the generalized force."""
        if self.law == "gradient":
            return inverse_left_lanes(phi)
        c1, c2 = stumpff(sum(x * x for x in phi), 1, 2)
        return polynomial(1.0, -c1, c2, phi)

    def _segments(self, context: Context) -> list[tuple[Any, list, list[Lane], list[Lane]]]:
        """List the joint, the rotation phi, phi - phi_0 and the stiffness K / L of each segment."""
        model, dtype = context.model, context.q.dtype
        turned, section, rest = (
            table(x, dtype) for x in (model.bodies.orientation, self.section, self.rest)
        )
        length, moduli = table(self.length, dtype), [scalar(self.twist, dtype)]
        moduli += [scalar(self.bend, dtype)] * 2
        out = []
        for n, name in enumerate(self.joints):
            joint, body = context.joint(name), model.topology.joint_bodies[model.joint(name)]
            placed = [lane(turned[:, k], body) for k in range(4)]
            phi = quaternion.log_lanes(_attitude(placed, joint.q))
            stretch = [sub(x, lane(rest[:, k], n)) for k, x in enumerate(phi)]
            L = lane(length, n)
            K = [mul(m, lane(section[:, k], n)) / L for k, m in enumerate(moduli)]
            out.append((joint, phi, stretch, K))
        return out


def circle(radius: Any) -> list:
    """Compute J, I_y, I_z of a circle, m^4: pi r^4 / 2 and twice pi r^4 / 4."""
    quarter = jnp.pi * radius**4 / 4
    return [2 * quarter, quarter, quarter]


def rectangle(y: Any, z: Any) -> list:
    """Compute J, I_y, I_z of a rectangle of half sizes y, z, m^4.

    J = a b^3 (16/3 - 3.36 b/a (1 - b^4 / (12 a^4))) for a = max(y, z), b = min(y, z), with an error
    below 1 % (Young & Budynas, *Roark's Formulas for Stress and Strain*, table 10.1).
    """
    a, b = (y, z) if y >= z else (z, y)
    J = a * b**3 * (16 / 3 - 3.36 * b / a * (1 - b**4 / (12 * a**4)))
    return [J, 4 / 3 * y * z**3, 4 / 3 * z * y**3]


def _attitude(placed: list[Lane], q: Sequence[Lane]) -> list[Lane]:
    """Multiply the quaternion of a body's frame, often a constant identity, with its joint's."""
    if all(map(is_literal, placed)) and placed == [1.0, 0.0, 0.0, 0.0]:
        return list(q)
    return quaternion.product(placed, list(q))
