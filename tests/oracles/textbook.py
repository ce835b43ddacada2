"""Published dynamics cases as MJCF text, to ask the figures in the .json files of any loader.

A case that scales its coordinates says so: with q the book's coordinates and `scale` s, the file's
are s*q, s*v, s*a and tau/s, and the book's mass matrix is diag(s) M diag(s). Only Modern Robotics'
three-link needs it: its first screw has |omega| = sqrt(2), so the axis turns sqrt(2) times as fast
as the book's coordinate. Every other scale is one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from tests.oracles import load

Array = np.ndarray
POINT_INERTIA = 1e-14  # MuJoCo refuses a moving body with a moment of inertia below 1e-15


@dataclass(frozen=True)
class Case:
    """MJCF text, the coordinate scale (nv,), and the oracle's entry with inputs and results."""

    xml: str
    scale: Array
    data: dict[str, Any]

    def model(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(self.xml)


def _text(values: object) -> str:
    return " ".join(repr(float(x)) for x in np.atleast_1d(values))


def _quat(matrix: Array) -> Array:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(matrix, dtype=float).ravel())
    return quat


def _document(name: str, gravity: object, bodies: str) -> str:
    option = f'<option timestep="0.001" gravity="{_text(gravity)}" integrator="RK4"/>'
    compiler = '<compiler angle="radian"/>'
    return f'<mujoco model="{name}">{compiler}{option}<worldbody>{bodies}</worldbody></mujoco>\n'


def modern_robotics(name: str) -> Case:
    """'three_link' or 'UR5'; body frames are the space frame at home: screws go in as printed."""
    data = load("modern_robotics")[name]
    pose, scale, opening, closing = np.eye(4), [], "", ""
    links = zip(data["frames"], data["G_diag"], data["screws"], strict=False)  # the tip is last
    for i, (frame, inertia, screw) in enumerate(links):
        pose = pose @ np.array(frame)
        omega, velocity = np.array(screw[:3]), np.array(screw[3:])
        anchor = np.cross(omega, velocity) / (omega @ omega)  # nearest the origin
        scale.append(np.linalg.norm(omega))
        opening += (
            f'<body name="link{i + 1}">'
            f'<joint name="joint{i + 1}" pos="{_text(anchor)}" axis="{_text(omega / scale[-1])}"/>'
            f'<inertial pos="{_text(pose[:3, 3])}" quat="{_text(_quat(pose[:3, :3]))}"'
            f' mass="{_text(inertia[3])}" diaginertia="{_text(inertia[:3])}"/>'
        )
        closing += "</body>"
    pose = pose @ np.array(data["frames"][-1])
    tip = f'<site name="tip" pos="{_text(pose[:3, 3])}" quat="{_text(_quat(pose[:3, :3]))}"/>'
    return Case(_document(name, data["g"], opening + tip + closing), np.array(scale), data)


def tip_forces(case: Case, data: mujoco.MjData) -> Array:
    """J' F of the tip wrench (moment, force; in tip axes; by the robot), in the file's terms."""
    model, jacp, jacr = data.model, np.zeros((3, data.model.nv)), np.zeros((3, data.model.nv))
    mujoco.mj_jacSite(model, data, jacp, jacr, model.site("tip").id)
    world_from_tip, wrench = data.site("tip").xmat.reshape(3, 3), np.array(case.data["tip_wrench"])
    return jacr.T @ world_from_tip @ wrench[:3] + jacp.T @ world_from_tip @ wrench[3:]


def _point_chain(
    name: str, lengths: list[float], masses: list[float], along: Array, axis: Array, gravity: Array
) -> str:
    """Point masses at the ends of links that lie along `along` at q = 0 and turn about `axis`."""
    opening, inertia = "", _text([POINT_INERTIA] * 3)
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        opening += (
            f'<body name="link{i + 1}" pos="{_text(along * (lengths[i - 1] if i else 0.0))}">'
            f'<joint name="joint{i + 1}" axis="{_text(axis)}"/>'
            f'<inertial pos="{_text(along * length)}" mass="{mass!r}" diaginertia="{inertia}"/>'
        )
    return _document(name, gravity, opening + "</body>" * len(lengths))


def planar_2r() -> Case:
    """Modern Robotics (8.9)-(8.11): two point masses, angles from +x, gravity along -y."""
    data = load("modern_robotics")["planar_2R"]
    lengths, masses = [data["L1"], data["L2"]], [data["m1"], data["m2"]]
    x, y, z = np.eye(3)
    return Case(_point_chain("planar_2r", lengths, masses, x, z, -data["g"] * y), np.ones(2), data)


def two_link(m2: float) -> Case:
    """Cai Zixing, table 4.1, with load m2: angles from the downward vertical, as in the scene."""
    data = load("two_link_table41")
    _, y, z = np.eye(3)
    xml = _point_chain("two_link", [1.0, 1.0], [2.0, m2], -z, -y, -9.81 * z)
    return Case(xml, np.ones(2), data)


def rbdl(name: str) -> Case:
    """One of RBDL's cases; massless links, which MuJoCo refuses, share a body with the next."""
    data = load("rbdl_cases")["cases"][name]
    children: dict[int, list[int]] = {}
    for i, joint in enumerate(data["joints"]):
        children.setdefault(joint["parent"], []).append(i + 1)

    def body(i: int) -> str:
        offset, joints = data["joints"][i - 1]["offset"], ""
        while True:
            link = data["joints"][i - 1]
            kind, axis = link.get("type", "hinge"), _text(link["axis"])
            joints += f'<joint name="joint{i}" type="{kind}" axis="{axis}"/>'
            if link["mass"]:
                break
            (i,) = children[i]
            assert not any(data["joints"][i - 1]["offset"]), "a massless link has length here"
        inertial = f'<inertial pos="{_text(link["com"])}" mass="{_text(link["mass"])}"'
        inertial += f' diaginertia="{_text(link["I_com_diag"])}"/>'
        nested = "".join(body(child) for child in children.get(i, []))
        return f'<body name="link{i}" pos="{_text(offset)}">{joints}{inertial}{nested}</body>'

    xml = _document(name, data["gravity"], "".join(body(root) for root in children[0]))
    return Case(xml, np.ones(len(data["joints"])), data)
