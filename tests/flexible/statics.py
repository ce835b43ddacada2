"""Static solutions of beams in strain coordinates, for tests: Newton's method on K q = S^T f."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.flexible.strain import StrainBeam, stiffness_matrix

STEP = 1e-7  # of differences, relative to the size of the coordinates


class Cantilever:
    """Equal beams in series, clamped at the base, with a dead force and moment at the tip.

    The slope of the residual is a difference, which costs Newton's method some steps and no
    accuracy, and saves most of the time of compilation.
    """

    def __init__(self, beam: StrainBeam, links: int = 1):
        self.beam, self.links = beam, links
        n = beam.coordinates

        def tip(q, params):
            at = beam.frames(list(q), [0.0] * n, list(params))[beam.tip]
            lanes = [*at.J, *at.at, *(x for S in at.axes for x in S)]
            return jnp.stack([jnp.broadcast_to(x, ()) for x in lanes])

        over = jax.vmap(jax.vmap(tip, (0, None)), (0, None))
        self._tips = jax.jit(over, compiler_options=rb.compiler_options())

    def _work(self, q: np.ndarray, force, moment, params) -> tuple[np.ndarray, np.ndarray]:
        """Compute S^T f (..., links, n) and the position of the tip (..., 3), for a batch of q."""
        tips = np.asarray(self._tips(q, params))
        own = tips[..., :9].reshape(*q.shape[:2], 3, 3), tips[..., 9:12]
        axes = tips[..., 12:].reshape(*q.shape[:2], -1, 6)
        R, r, ends = np.eye(3), np.zeros(3), []
        for k in range(self.links):
            r = r + (R @ own[1][:, k, :, None])[..., 0]
            R = R @ own[0][:, k]
            ends.append((R, r))
        works = []
        for k, (R, at) in enumerate(ends):
            wrench = np.concatenate([moment + np.cross(r - at, force), 0 * r + force], -1)
            wrench = (wrench.reshape(-1, 2, 3) @ R).reshape(-1, 6)  # in the axes of the end
            works.append((axes[:, k] @ wrench[..., None])[..., 0])
        return np.stack(works, 1), r

    def solve(
        self,
        C: Sequence[float],
        params: Sequence[float],
        force: Sequence[float] = (0.0, 0.0, 0.0),
        moment: Sequence[float] = (0.0, 0.0, 0.0),
        steps: int = 4,
    ) -> np.ndarray:
        """Compute the coordinates (links, n) at equilibrium, in steps of the load."""
        K = stiffness_matrix(self.beam, C, params[0])
        K = np.kron(np.eye(self.links), [[float(x) for x in row] for row in K])
        shape = self.links, self.beam.coordinates
        params, force, moment = (np.asarray(x, float) for x in (params, force, moment))
        q = np.zeros(len(K))
        for part in np.arange(1, steps + 1) / steps:
            for _ in range(30):
                h = STEP * (np.abs(q) + 1e-3 / params[0])
                near = q + np.concatenate([np.zeros((1, len(q))), np.diag(h)])
                at = self._work(near.reshape(-1, *shape), part * force, part * moment, params)[0]
                at = at.reshape(-1, len(q))
                slope = K - ((at[1:] - at[0]) / h[:, None]).T
                change = np.linalg.solve(slope, K @ q - at[0])
                q = q - change
                if np.abs(change).max() <= 1e-13 * np.abs(q).max():
                    break
        assert np.abs(change).max() <= 1e-11 * np.abs(q).max(), "no convergence"
        return q.reshape(shape)

    def tip(self, C: Sequence[float], params: Sequence[float], **load) -> np.ndarray:
        """Compute the position of the tip (3,) at equilibrium."""
        q, none = self.solve(C, params, **load), np.zeros(3)
        return self._work(q[None], none, none, np.asarray(params, float))[1][0]
