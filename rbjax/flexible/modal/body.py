"""The record of a modal body: the numbers of an elastic body whose deformation is a sum of modes.

The deformation is u = U q in a floating frame. With the twist (w, v) of this frame the kinetic
energy is that of a Taylor expansion (Shabana, *Dynamics of Multibody Systems*, ch. 5; Schwertassek
& Wallrapp, *Dynamik flexibler Mehrkörpersysteme*, ch. 6):

    T = (w.J w + 2 w.(h x v) + m v.v) / 2 + sum_j (c_j.w + l_j.v) q_j' + q'.M q' / 2
    h   = h0 + sum_j h1_j q_j                                 first moment
    J   = J0 + sum_j J1_j q_j + sum_jk J2_jk q_j q_k          inertia about the origin
    c_j = c0_j + sum_k c1_jk q_k                              angular momentum of a unit rate
    l_j = h1_j                                                linear momentum of a unit rate

Displacements of second order in q add l_j += h2_jk q_k, the symmetric part of c1, and the stiffness
w.G_jk w. They are the geometric stiffening of `rbjax.flexible.modal.stiffening`, and zero in a
linear floating frame. Their own terms in the kinetic energy, h += h2_jk q_j q_k / 2 and
J += -G_jk q_j q_k, are small, but without the terms of higher order that belong to them T is not
positive definite if the modes contain almost all of the motion of the base. So they are left out,
as in standard input data, unless `second_order` is set.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, real_number, shown
from rbjax.errors import InputError, UnknownName
from rbjax.model.record import Record, check_numbers, floats


def check_body(where: str, body: Any) -> None:
    """Raise InputError unless a value is a `ModalBody`."""
    instance(where, "body", body, ModalBody, "a ModalBody, such as that of craig_bampton")


class ModalBody(Record):
    """An elastic body of m modes with P frames, in the axes of its floating frame.

    Use the functions of `rbjax.flexible.modal` that return one: `craig_bampton`, `from_points`,
    `read_sid`, `read_mbdyn_modal`.

    Fields:
        mass: mass, kg.
        first_moment: h0 (3,), kg m.
        first_moment1: h1 (3, m).
        first_moment2: h2 (3, m, m), symmetric in the modes.
        inertia: J0 (3, 3), kg m^2.
        inertia1: J1 (m, 3, 3).
        inertia2: J2 (m, m, 3, 3), symmetric in the modes.
        centrifugal_stiffness: G (m, m, 3, 3), symmetric in the modes.
        coupling: c0 (3, m).
        coupling1: c1 (3, m, m); entry (a, j, k) is the derivative of c_j by q_k.
        modal_mass: M (m, m).
        stiffness: K (m, m).
        damping: D (m, m).
        positions: places of the frames without deformation (P, 3), m.
        orientations: rotations of the frames without deformation (P, 3, 3), to body axes.
        modes: displacements of the frames (P, 3, m).
        rotation_modes: rotations of the frames (P, 3, m).
        second_modes: second-order displacements A of the frames (P, 3, m, m): the displacement is
            U q + q.A q / 2.
        mode_names: m names.
        frame_names: P names.

    Raises:
        InputError: a field has a wrong shape or a number that is not finite.

    Source: Schwertassek & Wallrapp 1999, section 6.4; Shabana, sections 5.2-5.6.

    Example:
        >>> import numpy as np
        >>> from rbjax.flexible.modal import from_points
        >>> shape = np.zeros((2, 3, 1)); shape[1, 2, 0] = 1.0
        >>> body = from_points([1.0, 2.0], [[0, 0, 0], [1, 0, 0]], shape, stiffness=[[8.0]])
        >>> float(body.modal_mass[0, 0]), body.frequencies.round(12).tolist()
        (2.0, [2.0])
    """

    mass: jax.Array = eqx.field(converter=floats)
    first_moment: jax.Array = eqx.field(converter=floats)
    first_moment1: jax.Array = eqx.field(converter=floats)
    first_moment2: jax.Array = eqx.field(converter=floats)
    inertia: jax.Array = eqx.field(converter=floats)
    inertia1: jax.Array = eqx.field(converter=floats)
    inertia2: jax.Array = eqx.field(converter=floats)
    centrifugal_stiffness: jax.Array = eqx.field(converter=floats)
    coupling: jax.Array = eqx.field(converter=floats)
    coupling1: jax.Array = eqx.field(converter=floats)
    modal_mass: jax.Array = eqx.field(converter=floats)
    stiffness: jax.Array = eqx.field(converter=floats)
    damping: jax.Array = eqx.field(converter=floats)
    positions: jax.Array = eqx.field(converter=floats)
    orientations: jax.Array = eqx.field(converter=floats)
    modes: jax.Array = eqx.field(converter=floats)
    rotation_modes: jax.Array = eqx.field(converter=floats)
    second_modes: jax.Array = eqx.field(converter=floats)
    mode_names: tuple[str, ...] = eqx.field(static=True)
    frame_names: tuple[str, ...] = eqx.field(static=True)

    def __check_init__(self) -> None:
        for name, shape in shapes(len(self.mode_names), len(self.frame_names)).items():
            value = getattr(self, name)
            if callable(value) or isinstance(value, str | bytes | list | tuple | dict):
                raise InputError(
                    f"ModalBody({name}=...): got {shown(value)}, expected numbers of shape {shape}"
                )
            if not hasattr(value, "shape"):
                continue  # a leaf that a transformation of JAX has replaced
            if value.shape != shape:
                raise InputError(
                    f"ModalBody({name}=...): got the shape {value.shape}, expected {shape} for "
                    f"{len(self.mode_names)} modes and {len(self.frame_names)} frames"
                )
            check_numbers(f"ModalBody({name}=...)", value, infinite=False)

    def check_inertia(self, where: str) -> None:
        """Raise InputError if the mass is not positive, or the kinetic energy at q = 0 is negative
        for some velocities."""
        mass, first, inertia, coupling, modal, by_modes = (
            np.asarray(getattr(self, name), float)
            for name in ("mass", "first_moment", "inertia", "coupling", "modal_mass",
                         "first_moment1")
        )  # fmt: skip
        real_number(where, "the mass", mass, above=0.0)
        c = np.cross(np.eye(3), first)
        M = np.block([
            [mass * np.eye(3), -c, by_modes],
            [c, inertia, coupling],
            [by_modes.T, coupling.T, modal],
        ])  # fmt: skip
        size = np.sqrt(np.abs(np.diag(M)))
        size[size == 0] = 1.0
        least = np.linalg.eigvalsh(M / size / size[:, None])[0]
        if least < -1e-6:
            raise InputError(
                f"{where}: the inertia at q = 0 (mass, moments, modal masses) gives negative "
                f"kinetic energy: the scaled mass matrix has the eigenvalue {least:.3g}, expected "
                "at least zero; correct the numbers"
            )

    def fields(self) -> dict[str, Any]:
        """Return all fields by name."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}

    def replace(self, **changes: Any) -> ModalBody:
        """Return a copy with the given fields changed. Arrays must keep their shapes.

        Arrays of NumPy keep their precision, whatever JAX has.
        """
        fields = self.fields()
        for name in changes:
            if name not in fields:
                raise UnknownName("field of ModalBody", name, fields)
        return type(self)(**(fields | changes))

    @property
    def mode_count(self) -> int:
        """The number of modes m."""
        return len(self.mode_names)

    @property
    def frequencies(self) -> np.ndarray:
        """Natural frequencies (m,) with the floating frame at rest, rad/s, ascending."""
        values, _ = generalized_modes(np.asarray(self.stiffness), np.asarray(self.modal_mass))
        return np.sqrt(np.maximum(values, 0.0))

    def frame(self, name: str) -> int:
        """Return the index of a frame.

        Raises:
            UnknownName: no frame has this name.
        """
        if name not in self.frame_names:
            raise UnknownName("frame", name, self.frame_names)
        return self.frame_names.index(name)

    def with_modes(self, keep: Sequence[int]) -> ModalBody:
        """Return the body with some of its modes, by index.

        Raises:
            InputError: an index does not exist or is repeated.
        """
        kept = [int(k) for k in keep]
        if len(set(kept)) != len(kept) or any(not 0 <= k < self.mode_count for k in kept):
            raise InputError(
                f"with_modes: got {list(keep)}, expected different indices from 0 to "
                f"{self.mode_count - 1}"
            )
        return self.transformed(
            np.eye(self.mode_count)[:, kept], [self.mode_names[k] for k in kept]
        )

    def with_frames(self, names: Sequence[str]) -> ModalBody:
        """Return the body with some of its frames, in the given order.

        Raises:
            UnknownName: no frame has this name. InputError: a name is repeated.
        """
        kept = [self.frame(name) for name in names]
        if len(set(kept)) != len(kept):
            raise InputError(f"with_frames: got {list(names)}, expected different names")
        fields = self.fields()
        for name in FRAME_FIELDS:
            fields[name] = fields[name][np.array(kept, int)]
        return type(self)(**(fields | {"frame_names": tuple(names)}))

    def with_damping(self, ratio: float | Sequence[float]) -> ModalBody:
        """Return the body with modal damping: D = M Phi diag(2 zeta omega) Phi^T M.

        Args:
            ratio: damping ratio zeta of all modes, or of each natural mode (m,), at least 0.

        Raises:
            InputError: a ratio is negative, or their number is not m.
        """
        zeta = (
            np.broadcast_to(np.asarray(ratio, float), (self.mode_count,))
            if (np.ndim(ratio) == 0 or len(np.atleast_1d(ratio)) == self.mode_count)
            else None
        )
        if zeta is None or not (zeta >= 0).all():
            raise InputError(
                f"with_damping: got {ratio}, expected a ratio of at least 0, or {self.mode_count} "
                "of them"
            )
        mass = np.asarray(self.modal_mass)
        values, shapes_ = generalized_modes(np.asarray(self.stiffness), mass)
        rates = 2 * zeta * np.sqrt(np.maximum(values, 0.0))
        scaled = mass @ shapes_
        return self.replace(damping=(scaled * rates) @ scaled.T)

    def transformed(self, basis: np.ndarray, names: Sequence[str]) -> ModalBody:
        """Return the body with the modes U B, with q = B r and a basis B (m, r) of coordinates."""
        fields = self.fields()
        xp = array_module([*fields.values(), basis])
        B = xp.asarray(basis)
        for name, axes in MODE_AXES.items():
            x = fields[name]
            for axis in axes:
                x = xp.moveaxis(xp.tensordot(x, B, axes=(axis, 0)), -1, axis)
            fields[name] = x
        fields["mode_names"] = tuple(names)
        return type(self)(**fields)

    def kinetic_energy(
        self, w: jax.Array, v: jax.Array, q: jax.Array, qd: jax.Array, second_order: bool = False
    ) -> jax.Array:
        """Compute T from the twist (w, v) of the floating frame in its axes, q (m,) and q' (m,).

        With `second_order` it includes all terms of the displacements of second order.
        """
        h1, h2, c1, J2 = self.first_moment1, self.first_moment2 @ q, self.coupling1, self.inertia2
        if second_order:
            l, h = h1 + h2, self.first_moment + (h1 + h2 / 2) @ q
            J2 = J2 - self.centrifugal_stiffness
        else:
            l, h, c1 = h1, self.first_moment + h1 @ q, (c1 - c1.swapaxes(1, 2)) / 2
        J = self.inertia + jnp.tensordot(q, self.inertia1 + jnp.tensordot(q, J2, 1), 1)
        rigid = w @ J @ w + 2 * jnp.cross(w, h) @ v + self.mass * (v @ v)
        coupled = w @ (self.coupling + c1 @ q) + v @ l
        return rigid / 2 + coupled @ qd + qd @ self.modal_mass @ qd / 2


FRAME_FIELDS = ("positions", "orientations", "modes", "rotation_modes", "second_modes")
#: the axes of each field that count modes
MODE_AXES = {
    "first_moment1": (1,),
    "first_moment2": (1, 2),
    "inertia1": (0,),
    "inertia2": (0, 1),
    "centrifugal_stiffness": (0, 1),
    "coupling": (1,),
    "coupling1": (1, 2),
    "modal_mass": (0, 1),
    "stiffness": (0, 1),
    "damping": (0, 1),
    "modes": (2,),
    "rotation_modes": (2,),
    "second_modes": (2, 3),
}


def array_module(values: Iterable[Any]) -> Any:
    """Return `jax.numpy` if a value is an array of JAX, else `numpy`, which does not compile."""
    return jnp if any(isinstance(x, jax.Array) for x in values) else np


def shapes(m: int, P: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of a `ModalBody` of m modes and P frames."""
    return {
        "mass": (),
        "first_moment": (3,),
        "first_moment1": (3, m),
        "first_moment2": (3, m, m),
        "inertia": (3, 3),
        "inertia1": (m, 3, 3),
        "inertia2": (m, m, 3, 3),
        "centrifugal_stiffness": (m, m, 3, 3),
        "coupling": (3, m),
        "coupling1": (3, m, m),
        "modal_mass": (m, m),
        "stiffness": (m, m),
        "damping": (m, m),
        "positions": (P, 3),
        "orientations": (P, 3, 3),
        "modes": (P, 3, m),
        "rotation_modes": (P, 3, m),
        "second_modes": (P, 3, m, m),
    }


def generalized_modes(K: np.ndarray, M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the eigenvalues (m,) and eigenvectors (m, m) of K x = s M x with X^T M X = 1."""
    from scipy.linalg import LinAlgError, eigh

    try:
        return eigh((K + K.T) / 2, (M + M.T) / 2)
    except LinAlgError as error:
        raise InputError(
            "the modal mass matrix is not positive definite: a mode has no mass, or modes are "
            "linearly dependent; remove them with `with_modes`, and give BeamSection(rotary=...) "
            "for the torsion of a beam"
        ) from error
