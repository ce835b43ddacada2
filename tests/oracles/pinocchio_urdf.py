"""A URDF as Pinocchio reads it, asked in our coordinates.

Its joints come in an order of its own; a continuous joint is (cos, sin) there; a floating or planar
joint's velocity is in the moved frame there, and a planar joint is one body with three of ours.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

import rbjax as rb

Array = np.ndarray


class Peer:
    """Mass matrix, bias forces and forward dynamics by Pinocchio, for a model of ours."""

    def __init__(self, source: str | Path, model: rb.Model, *, floating_base: bool = False) -> None:
        import pinocchio as pin

        self.pin, self.ours = pin, model
        text = isinstance(source, str) and source.lstrip().startswith("<")
        build = pin.buildModelFromXML if text else pin.buildModelFromUrdf
        root = (pin.JointModelFreeFlyer(), "floating_base") if floating_base else ()
        self.model = build(str(source), *root)
        self.model.gravity.linear = np.asarray(model.gravity)
        self.data = self.model.createData()

    def _there(self, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Pinocchio's q; L with v_there = L v; dL/dt v."""
        out, L = np.zeros(self.model.nq), np.zeros((self.model.nv, self.model.nv))
        drift = np.zeros(self.model.nv)
        at, of, top = 0, 0, self.ours.topology
        for name, kind in zip(self.ours.joint_names, top.joint_kinds, strict=True):
            stem, _, part = name.rpartition("_")
            plane = part in ("TX", "TY", "RZ") and self.model.existJointName(stem)
            j = self.model.getJointId(stem if plane else name)
            qi, vi = self.model.idx_qs[j], self.model.idx_vs[j]
            if kind == "free":
                turn = np.empty(9)
                mujoco.mju_quat2Mat(turn, q[at + 3 : at + 7])
                back, spin = turn.reshape(3, 3).T, v[of + 3 : of + 6]
                out[qi : qi + 7] = q[[at, at + 1, at + 2, at + 4, at + 5, at + 6, at + 3]]
                L[vi : vi + 3, of : of + 3], L[vi + 3 : vi + 6, of + 3 : of + 6] = back, np.eye(3)
                drift[vi : vi + 3] = -np.cross(spin, back @ v[of : of + 3])
                at, of = at + 7, of + 6
                continue
            if plane and part == "RZ":  # x, y came just before
                c, s = np.cos(q[at]), np.sin(q[at])
                back, (x, y) = np.array([[c, s], [-s, c]]), v[of - 2 : of]
                out[qi : qi + 4] = q[at - 2], q[at - 1], c, s
                L[vi : vi + 2, of - 2 : of], L[vi + 2, of] = back, 1.0
                drift[vi : vi + 2] = v[of] * np.array([[-s, c], [-c, -s]]) @ [x, y]
            elif not plane:
                turns = self.model.nqs[j] == 2
                out[qi : qi + self.model.nqs[j]] = (
                    (np.cos(q[at]), np.sin(q[at])) if turns else q[at]
                )
                L[vi, of] = 1.0
            at, of = at + 1, of + 1
        return out, L, drift

    def mass_matrix(self, q: Array) -> Array:
        there, L, _ = self._there(q, np.zeros(self.model.nv))
        upper = np.triu(self.pin.crba(self.model, self.data, there))
        return L.T @ (upper + np.triu(upper, 1).T) @ L

    def bias_forces(self, q: Array, v: Array) -> Array:
        there, L, drift = self._there(q, v)
        return L.T @ self.pin.rnea(self.model, self.data, there, L @ v, drift)

    def forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        there, L, drift = self._there(q, v)
        forces = np.linalg.solve(L.T, tau)
        a = self.pin.aba(self.model, self.data, there, L @ v, forces)
        return np.linalg.solve(L, a - drift)
