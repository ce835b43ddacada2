"""The inertials of a URDF, unchanged.

MuJoCo's compiler rejects inertials that other readers accept: zeros as placeholders, rounded or
guessed inertias that are physically impossible, massless moving links. So MuJoCo compiles a
placeholder for every link, and then the file's numbers are written into the compiled model.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from rbjax.errors import ModelError, listed
from rbjax.loading.checks import data_of, joints_that_cancel, mass_matrix
from rbjax.loading.mjcf.fields import matrix_of, quaternion_of
from rbjax.loading.urdf.tree import origin, read_numbers

#: relative excess of a moment over the sum of the other two that counts as rounding in the file
ROUNDING = 1e-6
# At an angle and off the link's origin, so that MuJoCo does not simplify the frame.
_TURNED = (0.7, 0.1, 0.5, 0.5)


@dataclass(frozen=True)
class Inertial:
    """The inertial of a link in its axes: mass kg, com (3,) m, inertia (3, 3) kg m^2 about com."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray

    def oddity(self, *, jointed: bool) -> str:
        """Describe why the inertial is physically impossible; empty if it is possible.

        A point mass is reported on a joint of its own, but not if it is welded to other mass.
        """
        moments = np.linalg.eigvalsh(self.inertia)
        excess = max(-moments[0], moments[2] - moments[0] - moments[1])
        if self.mass < 0:
            return "negative mass"
        if self.mass == 0 and moments.any():
            return "inertia without mass"
        if self.mass > 0 and jointed and not moments.any():
            return "mass without inertia"
        if excess > ROUNDING * abs(moments).max():
            return "a principal moment below zero or above the sum of the other two"
        return ""


def add_placeholder(body: Any) -> None:
    """Give a body of a spec an inertial that MuJoCo accepts."""
    body.mass, body.ipos, body.inertia = 1.0, (1.0, 2.0, 3.0), (1.0, 1.1, 1.2)
    body.iquat, body.explicitinertial = _TURNED, True


def write_inertials(m: mujoco.MjModel, inertials: dict[str, Inertial], name: str) -> str:
    """Replace the placeholders of the compiled model by the links' inertials.

    Return a text that lists moving links with physically impossible inertials.
    """
    odd: dict[str, list[str]] = {}
    for i in range(1, m.nbody):
        own = inertials[m.body(i).name]
        m.body_mass[i], m.body_ipos[i] = own.mass, own.com
        m.body_inertia[i], turn = _principal(own.inertia)
        m.body_iquat[i] = quaternion_of(turn)
        oddity = own.oddity(jointed=m.body_jntnum[i] > 0)
        if oddity and m.body_weldid[i]:
            odd.setdefault(oddity, []).append(m.body(i).name)
    _refuse_massless_motion(m, name)
    mujoco.mj_setConst(m, data_of(m))
    return "; ".join(f"{kind}: {listed(links)}" for kind, links in odd.items())


def _principal(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the principal moments, and the rotation from the principal axes."""
    if not (inertia - np.diag(np.diag(inertia))).any():
        return np.diag(inertia), np.eye(3)
    moments, turn = np.linalg.eigh(inertia)
    return moments, turn * np.linalg.det(turn).round()


def _refuse_massless_motion(m: mujoco.MjModel, name: str) -> None:
    """Raise ModelError if a joint, or a combination of joints, moves no mass."""
    M = mass_matrix(m)
    moved = np.abs(np.diag(M))
    still = np.flatnonzero(moved <= 1e-15 * moved.max(initial=0.0))
    if len(still):
        joints = dict.fromkeys(int(m.dof_jntid[i]) for i in still)
        words = [f"{m.joint(j).name} (link {m.body(m.jnt_bodyid[j]).name})" for j in joints]
        raise ModelError(
            f"{name}: joints that move no mass: {listed(words)}; the mass matrix is "
            f"singular and their accelerations are undefined, expected mass on each moving link or "
            f"on one that it carries; give the links an <inertial>, or their joints type='fixed'"
        )
    undone = joints_that_cancel(m, M)
    if undone:
        raise ModelError(
            f"{name}: joints that together move no mass: {listed(undone)}; one undoes what "
            f"the others do, the mass matrix is singular and their accelerations are undefined, "
            f"expected mass on the links between them; give these an <inertial>, or one of the "
            f"joints type='fixed'"
        )


def read_inertial(link: ET.Element, where: str) -> Inertial:
    """Read the inertial of a link. An absent element is read as zeros; an existing element must
    have all its numbers."""
    inertial = link.find("inertial")
    inertial = ET.Element("inertial") if inertial is None else inertial
    mass = read_numbers(inertial.find("mass"), "value", 1, where)
    com, quat = origin(inertial, where)
    element = inertial.find("inertia")
    xx, yy, zz, xy, xz, yz = (
        read_numbers(element, key, 1, where)[0]
        for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if quat[0] != 1:
        turn = matrix_of(quat)
        inertia = turn @ inertia @ turn.T
    return Inertial(float(mass[0]), com, inertia)
