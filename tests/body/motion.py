"""One compiled integrator for every formulation of one body."""

from __future__ import annotations

import functools

import diffrax
import jax
import numpy as np

from rbjax.body import Formulation, Situation, formulations
from rbjax.solvers import Compensated
from tests.robots import QUICK

# What holds for every attitude, and three of the minimal ones; the others take minutes to compile.
ATTITUDE_FREE = tuple(n for n in formulations() if not n.startswith("lagrange"))
MINIMAL = ("lagrange_zyz", "lagrange_mrp")
SLOW = tuple(n for n in formulations() if n not in ATTITUDE_FREE + MINIMAL)


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def _solve(f: Formulation, situation: Situation, T, V, ts, tolerance, longest):
    solution = diffrax.diffeqsolve(
        f.term(),
        Compensated(diffrax.Dopri8()),
        ts[0],
        ts[-1],
        None,
        f.initial(situation.body, T, V),
        situation,
        saveat=diffrax.SaveAt(ts=ts),
        stepsize_controller=diffrax.ClipStepSizeController(  # between steps is less accurate
            diffrax.PIDController(rtol=tolerance, atol=tolerance, dtmax=longest), step_ts=ts
        ),
        max_steps=100_000,
        # nothing is differentiated here; a loop without checkpoints compiles faster
        adjoint=diffrax.ForwardMode(),
    )

    def seen(y):
        return (
            f.pose(situation.body, y),
            f.twist(situation.body, y),
            f.singularity_distance(y),
        )

    return jax.vmap(seen)(solution.ys)


def motion(
    f: Formulation, situation: Situation, T, V, ts,
    tolerance: float = 1e-15, longest: float = np.inf,
):  # fmt: skip
    """Poses (t, 4, 4), body twists (t, 6) and distances to the singularity (t,) at the times.

    No step takes longer than `longest` (s).
    """
    T, V, ts = np.asarray(T), np.asarray(V), np.asarray(ts, float)
    out = _solve(f, situation, T, V, ts, tolerance, longest)
    return tuple(np.asarray(x) for x in out)
