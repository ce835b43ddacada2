"""Random motions, at which the rank of a regressor is structural."""

from __future__ import annotations

import numpy as np

from rbjax.arguments import integer
from rbjax.dynamics.arguments import check_model
from rbjax.model import Model


def random_motions(
    model: Model, samples: int, *, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw random q (samples, nq), v and a (samples, nv).

    Coordinates are uniform within 3 (rad, m) of the default, and attitudes are uniform. Velocities
    and accelerations are normal with standard deviation 2.
    """
    check_model("random_motions", model)
    integer("random_motions", "samples", samples, least=1)
    rng = np.random.default_rng(seed)
    q = np.asarray(model.joints.reference) + rng.uniform(-3.0, 3.0, (samples, model.nq))
    for start in model.topology.quaternion_starts:
        turn = rng.normal(size=(samples, 4))
        q[:, start : start + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    v, a = rng.normal(scale=2.0, size=(2, samples, model.nv))
    return q, v, a
