"""Chains of joints from tables of placements, as models of ours and of Pinocchio."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

import rbjax as rb
from tests.robots import load_quietly

UNIT = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


def chain(joints: list[dict[str, Any]], gravity=(0.0, 0.0, -9.81)) -> rb.Model:
    """Bodies link1, link2, ... on joints joint1, ...; each joint has `xyz` and `R` in the link
    before, an `axis` (x, y, z, or three numbers), and perhaps a `type` (hinge), `mass`, `com`,
    `inertia` about the com (six numbers: xx, yy, zz, xy, xz, yz)."""
    text = ""
    for i, joint in enumerate(joints, 1):
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.ravel(np.array(joint["R"], float)))
        axis = UNIT[joint["axis"]] if isinstance(joint["axis"], str) else joint["axis"]
        full = joint.get("inertia", (0.02, 0.03, 0.025, 0, 0, 0))
        text += (
            f'<body name="link{i}" pos="{_text(joint["xyz"])}" quat="{_text(quat)}">'
            f'<joint name="joint{i}" type="{joint.get("type", "hinge")}" axis="{_text(axis)}"/>'
            f'<inertial pos="{_text(joint.get("com", (0, 0, 0)))}" mass="{joint.get("mass", 1.0)}"'
            f' fullinertia="{_text(full)}"/>'
        )
    text += "</body>" * len(joints)
    return load_quietly(
        f'<mujoco><compiler angle="radian"/><option gravity="{_text(gravity)}"/>'
        f"<worldbody>{text}</worldbody></mujoco>"
    )


def _text(values: Any) -> str:
    return " ".join(repr(float(x)) for x in values)


def gravity_of(name: str) -> tuple[float, float, float]:
    """What the oracle's names of gravity mean."""
    return {
        "none": (0.0, 0.0, 0.0),
        "in_plane": (0.0, -9.81, 0.0),
        "along_axes": (0.0, 0.0, -9.81),
        "along_first_axis": (0.0, 0.0, -9.81),
        "tilted": (3.0, -4.0, -8.0),
    }[name]


def planar_2R(oracle: dict[str, Any]) -> rb.Model:
    """The arm of the Fourier excitation, with the true masses: link lengths 1, gravity along -y."""
    joints = [
        {
            "xyz": (float(k), 0.0, 0.0), "R": np.eye(3), "axis": "z", "mass": link["m"],
            "com": (*link["com"], 0.0), "inertia": (*[link["I_about_com"]] * 3, 0, 0, 0),
        }
        for k, link in enumerate((oracle["truth"]["link_1"], oracle["truth"]["link_2"]))
    ]  # fmt: skip
    return chain(joints, (0.0, -9.81, 0.0))


def fourier(oracle: dict[str, Any], t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, v, a (n, 2) of the oracle's excitation (Swevers 1997)."""
    w = 2 * np.pi / oracle["T"]
    a, b = (np.array(oracle[k]) for k in "ab")
    k = w * np.arange(1, a.shape[1] + 1)
    sin, cos = np.sin(np.outer(t, k)), np.cos(np.outer(t, k))
    q = np.array(oracle["q0"]) + sin @ (a / k).T - cos @ (b / k).T
    return q, cos @ a.T + sin @ b.T, -sin @ (a * k).T + cos @ (b * k).T
