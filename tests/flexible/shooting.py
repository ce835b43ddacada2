"""Static beams by shooting: the strong form of a beam under a dead tip force, an oracle.

    n = F,  m(s) = M + (r_L - r(s)) x F,  Gamma = C_n^-1 R^T n + e_1,  k = C_m^-1 R^T m + k_0
    r' = R Gamma,  R' = R [k]

Newton's method finds r_L, so that the integration from the clamp ends there. It shares no code with
rbjax.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def tip(stiffness, length, force, moment=(0.0, 0.0, 0.0), curvature=(0.0, 0.0, 0.0), steps=4):
    """Compute the tip (3,) of a beam that is clamped at the origin along x, in base axes.

    stiffness: GJ, EI_y, EI_z, EA, GA_y, GA_z; inf for an absent strain.
    curvature: natural curvature, constant along the beam.
    """
    c = 1 / np.asarray(stiffness, float)
    r, full, couple = np.array([length, 0.0, 0.0]), np.asarray(force, float), np.asarray(moment)

    def integrate(end: np.ndarray, F: np.ndarray, M: np.ndarray) -> np.ndarray:
        def rate(s, y):
            R = y[3:].reshape(3, 3)
            strain = np.array([1.0, 0.0, 0.0]) + c[3:] * (R.T @ F)
            k = c[:3] * (R.T @ (M + np.cross(end - y[:3], F))) + curvature
            return np.concatenate([R @ strain, (R @ skew(k)).ravel()])

        start = np.concatenate([np.zeros(3), np.eye(3).ravel()])
        return solve_ivp(rate, (0, length), start, "DOP853", rtol=1e-13, atol=1e-14 * length).y[
            :3, -1
        ]

    r = integrate(r, 0 * full, 0 * full)
    for part in np.arange(1, steps + 1) / steps:

        def miss(x: np.ndarray, part: float = part) -> np.ndarray:
            return (integrate(x, part * full, part * couple) - x) / length

        r = root(miss, r, tol=1e-12).x
    assert np.abs(miss(r)).max() < 1e-11, "no convergence"
    return r
