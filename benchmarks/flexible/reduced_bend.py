"""Error of the 45-degree bend in a reduced basis, by the number of coordinates.

`python -m benchmarks.flexible.reduced_bend` prints the rows and writes them to
results/flexible-reduced-bend-<machine>.json. Errors are distances of the tip over the radius, to
the beam of 41 Legendre coefficients from which the snapshots are. Snapshots are static solutions
under F / 8 to 9 F / 8 in the direction of the force F, without F itself, or in three directions at
30 degrees to F too. Errors are those under F, and the largest of twenty forces of the size of F in
random directions within 30 degrees of F.

The equations of the reduced beam are those of the beam projected by T
(`tests/flexible/test_reduced_basis.py`), so that one compiled program serves all bases.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.timing import save
from rbjax.flexible.strain import stiffness_matrix

DEGREES = {"k_x": 6, "k_y": 7, "k_z": 7, "e_x": 5, "g_y": 5, "g_z": 5}
SLENDERNESS = (1e1, 1e2, 1e3, 1e4)
PARTS = (1 / 8, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 3 / 4, 7 / 8, 9 / 8)
COUNTS = {"one direction": (2, 4, 6, 8), "four directions": (8, 12, 16)}


class Arc:
    """The arc of radius 100 with a square section of G = E / 2 and GJ = EI."""

    def __init__(self) -> None:
        self.joint = self.beam(1.0).joint()

        def tip(q: jax.Array) -> tuple[jax.Array, ...]:
            params = [25 * np.pi, 1.0, 0.0, 0.0, 0.0, 1 / 100]
            at = self.joint.frames(list(q), [0.0] * len(q), params)[self.joint.tip]
            arrays = ([*at.at], [*at.J], [x for S in at.axes for x in S.lin])
            return tuple(jnp.stack([jnp.asarray(x, q.dtype) for x in y]) for y in arrays)

        self._tips = jax.jit(jax.vmap(tip), compiler_options=rb.compiler_options())

    def beam(self, slenderness: float) -> rb.flexible.Beam:
        side, E = 100.0 / slenderness, 1e7
        A, EI = side**2, E * side**4 / 12
        C = [EI, EI, EI, E * A, E * A / 2, E * A / 2]
        return rb.flexible.beam(25 * np.pi, C, DEGREES, mass=1.0, natural={"k_z": [1 / 100]})

    def work(self, q: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute S^T f (batch, n) and the tip (batch, 3)."""
        r, R, S = map(np.asarray, self._tips(q))
        own = np.einsum("bij,i->bj", R.reshape(-1, 3, 3), force)
        return np.einsum("bni,bi->bn", S.reshape(len(q), -1, 3), own), r

    def solve(self, K: np.ndarray, T: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Compute q = T x at equilibrium under a dead force at the tip, in steps of the load."""
        x, scale = np.zeros(T.shape[1]), 1e-8 / abs(T).max(0)
        for part in np.arange(1, 9) / 8:
            for _ in range(30):
                near = x + np.concatenate([np.zeros((1, len(x))), np.diag(scale)])
                pull = self.work(near @ T.T, part * force)[0] @ T
                slope = T.T @ K @ T - ((pull[1:] - pull[0]) / scale[:, None]).T
                change = np.linalg.solve(slope, T.T @ K @ T @ x - pull[0])
                x = x - change
                if abs(change / scale).max() < 1e-3:
                    break
            else:
                raise RuntimeError(f"no equilibrium under {force}")
        return T @ x


def direction(angle: float, azimuth: float) -> np.ndarray:
    """Return a unit vector at an angle to z, in degrees."""
    a, b = np.radians([angle, azimuth])
    return np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


def rows() -> list[dict[str, Any]]:
    """Solve all cases."""
    arc, out = Arc(), []
    n = arc.joint.coordinates
    for slenderness in SLENDERNESS:
        beam, size = arc.beam(slenderness), 600.0 * (100.0 / slenderness) ** 4
        C = np.diagonal(beam.section.stiffness).tolist()
        K = np.array(stiffness_matrix(arc.joint, C, 25 * np.pi))
        rng = np.random.default_rng(0)
        around = [(30.0, 120.0 * k) for k in range(3)]
        random = np.stack([rng.uniform(0, 30, 20), rng.uniform(0, 360, 20)], 1)
        F = size * direction(0.0, 0.0)
        others, tests = (size * np.array([direction(*x) for x in y]) for y in (around, random))
        tests = [F, *tests]

        def tip(T: np.ndarray, force: np.ndarray, K: np.ndarray = K) -> np.ndarray:
            q = arc.solve(K, T, force)
            return arc.work(q[None], force)[1][0]

        exact = np.array([tip(np.eye(n), f) for f in tests])
        for name, counts in COUNTS.items():
            loads = [F] if name == "one direction" else [F, *others]
            snapshots = [arc.solve(K, np.eye(n), part * f) for f in loads for part in PARTS]
            for count in counts:
                T = np.array(beam.reduced(snapshots, count).basis)
                off = np.array([tip(T, f) for f in tests]) - exact
                errors = np.linalg.norm(off, axis=1) / 100
                out.append(
                    {"slenderness": slenderness, "snapshots": name, "coordinates": count,
                     "error": float(errors[0]), "within 30 degrees": float(errors[1:].max())}
                )  # fmt: skip
                print(out[-1], flush=True)
    return out


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    found = rows()
    save("flexible-reduced-bend", found)
