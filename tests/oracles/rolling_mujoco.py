"""A file's own multibody model on rolling wheels, by MuJoCo's matrices only.

    M a = tau - c + A^T l,    A a = b - A' v
M, c and tau are MuJoCo's, of the whole file on its free joint. A has a row for each velocity that
rolling wheels, level ground and held joints do not allow, from Jacobians of the points that touch;
A' v is its numerical derivative along the motion, of fourth order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np

UP = np.array([0.0, 0.0, 1.0])
STEP = 1e-3  # s, of the derivative: its error is STEP^4 times fifth derivatives, and 1e-16 / STEP


@dataclass(frozen=True)
class Touch:
    """A wheel: its hinge, the body whose origin is its centre, its radius, how it may slide."""

    joint: str
    centre: str
    radius: float
    skids: bool = False
    roller: float | None = None


@dataclass
class RollingFile:
    """moves: the joints that move beside the base and the wheels. skidding: the x, in the base's
    frame, of an axis that does not move sideways."""

    m: mujoco.MjModel
    wheels: list[Touch]
    moves: tuple[str, ...] = ()
    steers: tuple[str, ...] = ()
    skidding: float | None = None
    d: mujoco.MjData = field(init=False)

    def __post_init__(self) -> None:
        self.m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
        self.d = mujoco.MjData(self.m)

    def rows(self, q: np.ndarray) -> np.ndarray:
        """A (n, nv); the last rows are those of steerings."""
        m, d = self.m, self.d
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        turn = d.xmat[1].reshape(3, 3)
        rows = []
        level = np.zeros((3, m.nv))
        level[0, 2] = 1.0
        level[1:, 3:6] = turn[:2]  # the world's x and y of the angular velocity
        rows += list(level)
        free = {m.joint(n).id for n in (*self.moves, *(w.joint for w in self.wheels))}
        rows += [np.eye(m.nv)[m.jnt_dofadr[j]] for j in range(1, m.njnt) if j not in free]
        for wheel in self.wheels:
            joint, body = m.joint(wheel.joint).id, m.body(wheel.centre).id
            ahead = np.cross(d.xaxis[joint], UP)
            left = np.cross(UP, ahead)
            jac = self._point(d.xpos[body] - wheel.radius * UP, body)
            if wheel.roller is not None:
                rows.append((np.cos(wheel.roller) * ahead + np.sin(wheel.roller) * left) @ jac)
            else:
                rows.append(ahead @ jac)
                if not wheel.skids:
                    rows.append(left @ jac)
        if self.skidding is not None:
            rows.append(turn[:, 1] @ self._point(d.xpos[1] + self.skidding * turn[:, 0], 1))
        rows += [np.eye(m.nv)[m.jnt_dofadr[m.joint(n).id]] for n in self.steers]
        return np.array(rows)

    def _point(self, point: np.ndarray, body: int) -> np.ndarray:
        jac = np.zeros((3, self.m.nv))
        mujoco.mj_jac(self.m, self.d, jac, None, point, body)
        return jac

    def acceleration(self, q, v, ctrl, torques, steering) -> np.ndarray:
        """a (nv,): ctrl of the file's actuators, torques by joint beside them, and at what the
        rates of steerings change."""
        m, d = self.m, self.d

        def moved(t: float) -> np.ndarray:
            there = q.copy()
            mujoco.mj_integratePos(m, there, v, t)
            return self.rows(there) @ v

        rate = _derivative(moved)
        A = self.rows(q)
        b = -rate
        b[len(b) - len(self.steers) :] += steering
        d.qpos[:], d.qvel[:], d.ctrl[:] = q, v, ctrl
        d.qfrc_applied[:] = 0
        mujoco.mj_forward(m, d)
        M = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, d, M)
        due = d.qfrc_actuator + d.qfrc_passive - d.qfrc_bias
        for name, torque in torques.items():
            due[m.jnt_dofadr[m.joint(name).id]] += torque
        n = len(A)
        whole = np.block([[M, -A.T], [A, np.zeros((n, n))]])
        return np.linalg.lstsq(whole, np.concatenate([due, b]), rcond=1e-13)[0][: m.nv]


def _derivative(f: Callable[[float], np.ndarray]) -> np.ndarray:
    h = STEP
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


def ackermann(b: float, rate: float, length: float, y: float) -> tuple[float, float, float]:
    """The angle, its rate and its acceleration at b'' = 0 of a wheel at the left y of the middle:
    tan(angle) = L sin b / (L cos b - y sin b)."""
    s, c = np.sin(b), np.cos(b)
    D = (length * s) ** 2 + (length * c - y * s) ** 2
    slope = 2 * length**2 * s * c - 2 * (length * c - y * s) * (length * s + y * c)
    first = length**2 / D
    angle = np.arctan2(length * s, length * c - y * s)
    return angle, first * rate, -(length**2) * slope / D**2 * rate**2
