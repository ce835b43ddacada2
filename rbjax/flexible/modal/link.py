"""A modal body as a flexible link: its frames and its inertia on lanes.

The coordinates q are the factors of the modes. With the angular velocity w of the floating frame,
the linear acceleration a of its origin, and T of `rbjax.flexible.modal.body`, Lagrange's equations
in body axes are, with a stiffness w.G_jk w of rotation,

    f_v   = m a + w' x h + sum_j l_j q_j'' + w x (w x h) + 2 sum_j w x h1_j q_j'
    f_w   = h x a + J w' + sum_j c_j q_j'' + w x J w + sum_j q_j' (w x g_j + dJ/dq_j w)
    tau_j = l_j.a + c_j.w' + M_jk q_k''
            + sum_k q_k' w.(c1_jk - c1_kj) - w.(dJ/dq_j w) / 2 + sum_k w.G_jk w q_k

g_j is c_j without the symmetric part of c1. If the layout is `second_order`, the equations are
those of the kinetic energy with all terms of the displacements of second order. Otherwise second-
order terms enter the mass matrix and the stiffness w.G_jk w only, as in standard input data. Then
the equations of a body with geometric stiffening are not those of a kinetic energy: energy is not
conserved exactly, and `rb.coriolis_matrix` does not contain w.G_jk w.

Frame P has, with the rotation vector phi = V q and the right Jacobian J_r of SO(3):

    R = exp([phi]) R0,   p = f + U q + q.A q / 2,   S_j = [R0^T J_r(phi) V_j; R^T (U_j + A_j q)]

Elastic forces are not included: see `rbjax.flexible.modal.elastic_force`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.flexible.modal.body import ModalBody, array_module
from rbjax.joints.flexible import Flexible, LinkInertia
from rbjax.joints.frame_motion import FrameMotion
from rbjax.lanes import Lane, Mat3, Sym3, Vec3, add, inner, is_zero, mul, sub
from rbjax.rotations.coefficients import stumpff
from rbjax.spatial import Force, Motion, RigidInertia, Transform

#: the upper triangle of a symmetric (3, 3), in the order of `Sym3`
UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
FIELDS = (
    "mass",
    "first_moment",
    "first_moment1",
    "first_moment2",
    "inertia",
    "inertia1",
    "inertia2",
    "centrifugal_stiffness",
    "coupling",
    "gyroscopic",
    "symmetric_coupling",
    "modal_mass",
    "positions",
    "orientations",
    "modes",
    "rotation_modes",
    "second_modes",
)


@dataclass(frozen=True)
class ModalLayout:
    """The parameters of a `ModalLink`, in order. It is hashable and static.

    Fields:
        modes: number of modes.
        frames: number of frames.
        entries: field of `ModalBody` and index of each parameter. All other entries are structural
            zeros. Symmetric fields have one entry for each pair. `coupling1` is the sum of its
            antisymmetric part "gyroscopic" and its symmetric part "symmetric_coupling".
        unrotated: indices of the frames whose orientation is structurally the identity.
        second_order: True if the kinetic energy has all terms of displacements of second order. It
            is then exact for tests, but not positive definite for large deformations.
    """

    modes: int
    frames: int
    entries: tuple[tuple[str, tuple[int, ...]], ...]
    unrotated: frozenset[int]
    second_order: bool = False

    @classmethod
    def of(cls, body: ModalBody, tolerance: float = 0.0, second_order: bool = False) -> ModalLayout:
        """Return the layout of the entries of a body that are not zero.

        Args:
            body: a body whose arrays are not traced.
            tolerance: entries up to this multiple of the largest one of their array become
                structural zeros.
            second_order: see the field.
        """
        rotations = np.asarray(body.orientations)
        plain = frozenset(k for k, R in enumerate(rotations) if np.array_equal(R, np.eye(3)))
        entries = []
        arrays = _arrays(body)
        for name in FIELDS:
            x = np.abs(np.asarray(arrays[name]))
            own = body.coupling1 if name in ("gyroscopic", "symmetric_coupling") else x
            least = tolerance * np.abs(np.asarray(own)).max(initial=0.0)
            for index in np.argwhere((x > least) | (name == "mass")):
                at = tuple(map(int, index))
                if not (name == "orientations" and at[0] in plain) and _canonical(name, at) == at:
                    entries.append((name, at))
        return cls(body.mode_count, len(body.frame_names), tuple(entries), plain, second_order)

    def values(self, body: ModalBody) -> jax.Array:
        """Return the parameters (n,) of a body. They have derivatives by all of its fields."""
        if (body.mode_count, len(body.frame_names)) != (self.modes, self.frames):
            raise InputError(
                f"ModalLayout.values: got {body.mode_count} modes and {len(body.frame_names)} "
                f"frames, expected {self.modes} and {self.frames}"
            )
        flat: list[Any] = []
        arrays = _arrays(body)
        for name in FIELDS:
            at = [index for field, index in self.entries if field == name]
            if at:
                x = arrays[name]
                flat.append(x[tuple(zip(*at, strict=True))] if x.ndim else x[None])
        return jnp.asarray(array_module(flat).concatenate(flat))


class ModalLink(Flexible):
    """A flexible link with the modes of a `ModalBody`.

    Two links with the same layout are equal. Their numbers are parameters.

    Args:
        layout: the structure of the parameters.
        values: default values of the parameters; empty for zeros.

    Source: Jain & Rodriguez, JGCD 15(6), 1992; Shabana, chapter 5.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import ModalLink, from_points
        >>> shape = np.zeros((2, 3, 1)); shape[1, 2, 0] = 1.0
        >>> body = from_points([1.0, 2.0], [[0, 0, 0], [3, 0, 0]], shape, frames=[1])
        >>> link = ModalLink.of(body)
        >>> link.frames([0.5], [0.0], link.defaults)[0].at
        Vec3(3.0, 0.0, 0.5)
    """

    name = "modal"

    def __init__(self, layout: ModalLayout, values: Sequence[float] = ()):
        self.layout = layout
        self.coordinates, self.count = layout.modes, layout.frames
        values = tuple(map(float, values)) or (0.0,) * len(layout.entries)
        self.params: Mapping[str, Any] = MappingProxyType({"numbers": values})
        super().__init__()

    @classmethod
    def of(cls, body: ModalBody, tolerance: float = 0.0, second_order: bool = False) -> ModalLink:
        """Return the link of a body, whose default parameters are the numbers of the body.

        Args:
            body: a body whose arrays are not traced.
            tolerance, second_order: see `ModalLayout.of`.
        """
        layout = ModalLayout.of(body, tolerance, second_order)
        return cls(layout, [float(x) for x in layout.values(body)])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ModalLink) and self.layout == other.layout

    def __hash__(self) -> int:
        return hash(self.layout)

    def __reduce__(self) -> tuple:
        return ModalLink, (self.layout, self.params["numbers"])

    def frames(
        self, q: Sequence[Lane], v: Sequence[Lane], params: Sequence[Lane]
    ) -> list[FrameMotion]:
        read = _Reader(self.layout, params)
        return [_frame(read, k, q, v) for k in range(self.count)]

    def inertia(
        self, q: Sequence[Lane], v: Sequence[Lane], w: Vec3, params: Sequence[Lane]
    ) -> LinkInertia:
        read, every = _Reader(self.layout, params), range(self.coordinates)
        pairs = [(j, k) for j in every for k in every if j < k]
        none, zero = Vec3.zero(), Sym3.zero()

        # changes of l and J along q, and the stiffness of rotation
        bend = [
            _sum(none, (read.vector("first_moment2", j, k) * q[k] for k in every)) for j in every
        ]
        curve, spun = (
            [_sum(zero, (read.symmetric(name, j, k) * q[k] for k in every)) for j in every]
            for name in ("inertia2", "centrifugal_stiffness")
        )
        full = self.layout.second_order
        h, J, turned = read.vector("first_moment"), read.symmetric("inertia"), []
        h1 = [read.vector("first_moment1", j) for j in every]
        l = [a + b for a, b in zip(h1, bend, strict=True)]
        for j in every:
            J1, J2 = read.symmetric("inertia1", j), curve[j] - spun[j] if full else curve[j]
            h = h + (h1[j] + bend[j] * 0.5 if full else h1[j]) * q[j]
            J = J + (J1 + J2) * q[j]
            turned.append((J1 + J2 * 2.0) @ w)  # dJ/dq_j w
        forces = [mul(-0.5, w.dot(x)) for x in turned]
        if not full:
            forces = [add(f, w.dot(G @ w)) for f, G in zip(forces, spun, strict=True)]

        # c1_jk = g_jk + s_jk, with g_kj = -g_jk and s_kj = s_jk
        g = {pair: read.vector("gyroscopic", *pair) for pair in pairs}
        s = [[read.vector("symmetric_coupling", j, k) for k in every] for j in every]
        plain = [read.vector("coupling", j) for j in every]
        for (j, k), x in g.items():
            plain[j], plain[k] = plain[j] + x * q[k], plain[k] - x * q[j]
        c = [_sum(plain[j], (s[j][k] * q[k] for k in every)) for j in every]

        ang, lin = none, none
        for j in every:
            ang = ang + (w.cross(c[j] if full else plain[j]) + turned[j]) * v[j]
            lin = lin + w.cross(l[j] if full else h1[j]) * mul(2.0, v[j])
        for j, k in pairs:
            spin = mul(2.0, w.dot(g[j, k]))
            forces[j] = add(forces[j], mul(spin, v[k]))
            forces[k] = sub(forces[k], mul(spin, v[j]))
        for j, k in [*pairs, *((j, j) for j in every)] if full else ():
            rate = mul(1.0 if j == k else 2.0, mul(v[j], v[k]))
            ang, lin = ang + s[j][k] * rate, lin + read.vector("first_moment2", j, k) * rate
        return LinkInertia(
            RigidInertia(read("mass"), h, J),
            tuple(Force(a, b) for a, b in zip(c, l, strict=True)),
            tuple(tuple(read("modal_mass", j, k) for k in every) for j in every),
            Force(ang, lin),
            tuple(forces),
        )


class _Reader:
    """The parameters of a layout by field and index; other entries are structural zeros."""

    def __init__(self, layout: ModalLayout, params: Sequence[Lane]):
        if len(params) != len(layout.entries):
            raise InputError(
                f"ModalLink: got {len(params)} parameters, expected {len(layout.entries)}, as "
                "`ModalLayout.values` returns them"
            )
        self.values = dict(zip(layout.entries, params, strict=True))
        self.unrotated = layout.unrotated

    def __call__(self, name: str, *index: int) -> Lane:
        return self.values.get((name, _canonical(name, index)), 0.0)

    def vector(self, name: str, *index: int) -> Vec3:
        return Vec3(*(self(name, a, *index) for a in range(3)))

    def at_frame(self, name: str, k: int, *index: int) -> Vec3:
        return Vec3(*(self(name, k, a, *index) for a in range(3)))

    def symmetric(self, name: str, *index: int) -> Sym3:
        return Sym3(*(self(name, *index, a, b) for a, b in UPPER))

    def orientation(self, k: int) -> Mat3:
        if k in self.unrotated:
            return Mat3.identity()
        return Mat3(*(self("orientations", k, a, b) for a in range(3) for b in range(3)))


def _arrays(body: ModalBody) -> dict[str, Any]:
    """Return the arrays of a body by the names of `FIELDS`."""
    out = {name: getattr(body, name) for name in FIELDS if hasattr(body, name)}
    flipped = body.coupling1.swapaxes(1, 2)
    out["gyroscopic"] = (body.coupling1 - flipped) / 2
    out["symmetric_coupling"] = (body.coupling1 + flipped) / 2
    return out


def _canonical(name: str, at: tuple[int, ...]) -> tuple[int, ...]:
    """Return the index that stands for an entry of a symmetric field."""
    if name in ("modal_mass", "inertia"):
        return tuple(sorted(at))
    if name in ("first_moment2", "second_modes", "gyroscopic", "symmetric_coupling"):
        return (*at[:-2], *sorted(at[-2:]))
    if name == "inertia1":
        return (at[0], *sorted(at[1:]))
    if name in ("inertia2", "centrifugal_stiffness"):
        return (*sorted(at[:2]), *sorted(at[2:]))
    return at


def _sum(start: Any, terms: Any) -> Any:
    for term in terms:
        start = start + term
    return start


def _frame(read: _Reader, k: int, q: Sequence[Lane], v: Sequence[Lane]) -> FrameMotion:
    every = range(len(q))
    V = [read.at_frame("rotation_modes", k, j) for j in every]
    U = [read.at_frame("modes", k, j) for j in every]
    A = [[read.at_frame("second_modes", k, i, j) for j in every] for i in every]
    bent = [_sum(Vec3.zero(), (A[j][i] * q[i] for i in every)) for j in every]
    moved = [a + b for a, b in zip(U, bent, strict=True)]
    p = _sum(
        read.at_frame("positions", k),
        ((a + b * 0.5) * x for a, b, x in zip(U, bent, q, strict=True)),
    )
    phi = _sum(Vec3.zero(), (a * x for a, x in zip(V, q, strict=True)))
    rate = _sum(Vec3.zero(), (a * x for a, x in zip(V, v, strict=True)))
    turn, right, drift = _rotation(phi, rate)
    R0 = read.orientation(k)
    R, E0 = turn @ R0, R0.T
    E = R.T
    axes = [Motion(E0 @ right(a), E @ b) for a, b in zip(V, moved, strict=True)]
    twist = _sum(Motion.zero(), (s * x for s, x in zip(axes, v, strict=True)))
    bend = Vec3.zero()
    for i in every:
        for j in every:
            bend = bend + A[i][j] * mul(v[i], v[j])
    return FrameMotion.at_pose(Transform(R, p), axes, twist, Motion(E0 @ drift, E @ bend))


def _rotation(phi: Vec3, rate: Vec3) -> tuple[Mat3, Any, Vec3]:
    """Compute exp([phi]), the map a -> J_r(phi) a, and the rate of J_r along `rate`, times `rate`.

    J_r a = a - c2 phi x a + c3 phi x (phi x a), with Stumpff's functions c_k of |phi|^2.
    """
    x = phi.dot(phi)
    c1, c2 = _stumpff(x, 1, 2)
    (c3,) = _stumpff(x, 3)
    turn = _rotation_matrix(phi, x, c1, c2)

    def right(a: Vec3) -> Vec3:
        b = phi.cross(a)
        return a - b * c2 + phi.cross(b) * c3

    side = phi.cross(rate)
    if all(map(is_zero, side)):
        return turn, right, Vec3.zero()
    c4, c5 = _stumpff(x, 4, 5)
    along, twice = phi.dot(rate), phi.cross(side)
    drift = (
        side * mul(along, sub(c3, mul(2.0, c4)))
        + twice * mul(along, sub(mul(3.0, c5), c4))
        + rate.cross(side) * c3
    )
    return turn, right, drift


def _stumpff(x: Lane, *orders: int) -> list[Lane]:
    """Compute c_k of x; they are literals if x is a structural zero."""
    if is_zero(x):
        return [1.0 / math.factorial(k) for k in orders]
    return stumpff(jnp.asarray(x), *orders)


def _rotation_matrix(phi: Vec3, x: Lane, c1: Lane, c2: Lane) -> Mat3:
    """Compute exp([phi]) = 1 + c1 [phi] + c2 (phi phi^T - |phi|^2 1)."""
    if is_zero(x):
        return Mat3.identity()
    skew = list(Mat3.skew(phi))
    out = []
    for n in range(9):
        i, j = divmod(n, 3)
        if i == j:
            others = inner(*[[phi[k] for k in range(3) if k != i]] * 2)
            out.append(sub(1.0, mul(c2, others)))
        else:
            out.append(add(mul(c1, skew[n]), mul(c2, mul(phi[i], phi[j]))))
    return Mat3(*out)
