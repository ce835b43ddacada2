"""Base parameters: the combinations of inertial and joint parameters that torques depend on.

They follow from the regressor only, at motions that reach all of the robot's states: the rank of
the observation matrix of random motions is structural, that of one motion says what it excites.
Gautier & Khalil, IEEE Trans. Robotics and Automation 6(3), 1990; Gautier, J. Robotic Systems 8(4),
1991. With a free base the base's six equations find all of it (Ayusawa, Venture & Nakamura, IJRR
33(3), 2014).
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.dynamics.arguments import check_model, check_moves
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.sysid.statistics.rank import Combinations, combinations
from rbjax.sysid.torque.regressors import observation_matrix, parameter_names


def base_parameters(
    model: Model,
    q: jax.Array | None = None,
    v: jax.Array | None = None,
    a: jax.Array | None = None,
    *,
    rows: Sequence[int | str] | slice | None = None,
    joint_terms: Sequence[str] = (),
    first: Sequence[str] = (),
    samples: int | None = None,
    seed: int = 0,
    tolerance: float | None = None,
    smoothing: float = 0.0,
) -> Combinations:
    """The base parameters of a robot, at a motion or at random ones.

        tau = Y pi = Y_kept beta,   beta = pi_kept + K pi_dropped

    Args:
        model: the robot; gravity matters, masses do not.
        q: (n, nq) configurations; None for random motions.
        v: (n, nv) velocities.
        a: (n, nv) accelerations.
        rows: the torques that are measured, as joint names or places in v; None for all. The first
            six of a free base are its wrench.
        joint_terms: of "armature", "viscous", "coulomb", "bias".
        first: names to keep before others, such as "joint1.armature" before "link1.Izz".
        samples: of random motions; None for enough.
        seed: of random motions.
        tolerance: of singular values, as for `combinations`.
        smoothing: of Coulomb friction, as for `regressor`.

    Returns:
        `Combinations`: rank, names kept and dropped, K, and `words()`.

    Raises:
        InputError: a model without joints; q, v and a not all given; wrong shapes.

    Source: Gautier 1991.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid.torque import base_parameters
        >>> base = base_parameters(rb.load("double_pendulum"), joint_terms=["armature"])
        >>> base.rank
        7
        >>> base.terms()[2]
        'upper.Iyy + lower.m + shoulder.armature'
    """
    where = "base_parameters"
    check_model(where, model)
    check_moves(where, model)
    names = parameter_names(model, joint_terms)
    if q is None and v is None and a is None:
        if samples is None:  # twice as many equations as columns, from the fewest rows
            samples = 20 + 2 * len(names) // min(model.nv, 6)
        q, v, a = map(jnp.asarray, random_motions(model, samples, seed=seed))
    if q is None or v is None or a is None:
        raise InputError(f"{where}: expected all of q, v and a, or none for random motions")
    W = observation_matrix(model, q, v, a, rows=rows, joint_terms=joint_terms, smoothing=smoothing)
    return combinations(W, names, tolerance=tolerance, first=first)


def random_motions(
    model: Model, samples: int, *, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q (samples, nq), v and a (samples, nv) of random states.

    Coordinates are uniform within 3 (rad, m) of the default, attitudes uniform, velocities and
    accelerations normal with standard deviation 2.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid.torque import random_motions
        >>> q, v, a = random_motions(rb.load("free_body"), 5)
        >>> q.shape, a.shape
        ((5, 7), (5, 6))
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
