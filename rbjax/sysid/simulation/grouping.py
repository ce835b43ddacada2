"""Numbers of bodies that motions show only together, so that slopes along all but some are known.

    tau = Y(q, v, a) p,   Y_dropped = Y_kept K   so   J_dropped = J_kept K
Of inertial parameters and armatures a motion depends on the base parameters only, whatever their
values: Y has geometry and gravity in it and none of p. An arm of 55 such numbers has 32 base
parameters; its Jacobian needs the slopes along 32 of the numbers, and the others follow.

Source: Gautier & Khalil, IEEE Trans. Robotics and Automation 6(3), 1990.
"""

from __future__ import annotations

import contextlib
from typing import Any, NamedTuple

import jax
import numpy as np

from rbjax.compiling import inside_jit
from rbjax.forces import JointFriction, JointLimits
from rbjax.sysid.parameters.unknowns import Inertia, Unknown, Unknowns
from rbjax.sysid.simulation.setup import Setup
from rbjax.sysid.statistics.rank import combinations
from rbjax.sysid.torque.base_combinations import random_motions
from rbjax.sysid.torque.regressors import observation_matrix

#: elements that act on each of their joints by its own q and v
BY_JOINT = (JointFriction, JointLimits)
#: with fewer bodies to find, slopes along all numbers take less time than to compile the regressor
BODIES = 4
#: leaves of a model that change neither its geometry nor gravity
DYNAMIC = ("bodies.mass", "bodies.com", "bodies.inertia", "joints.armature", "joints.damping")
#: rooms of a set-up of which the same is true
ROOMS = ("sensors", "controller", "delay", "readings", "actuators", "forces")


class Grouped(NamedTuple):
    """kept, the numbers (r,) along which slopes are needed; B (r, n) with J = J[:, kept] B."""

    kept: np.ndarray
    B: np.ndarray


def grouped(setup: Setup, unknowns: Unknowns) -> Grouped | None:
    """How the numbers of a set-up group; None where they are not known to."""
    bodies = [u for u in unknowns.members.values() if isinstance(u, Inertia)]
    if len(bodies) < BODIES or not _plain(setup, unknowns):
        return None
    model = setup.model
    samples = 20 + 2 * sum(unknowns.sizes) // min(model.nv, 6)
    drawn: Any = random_motions(model, samples)
    with no_part_of_a_program():
        Y = np.asarray(observation_matrix(model, *drawn))
    Y = Y.reshape(samples * model.nv, -1)
    coordinates = (drawn[2][:, :, None] * np.eye(model.nv)).reshape(len(Y), -1)  # of armatures
    columns: list[np.ndarray] = []
    places: list[int] = []
    end = 0
    for u, size in zip(unknowns.members.values(), unknowns.sizes, strict=True):
        own = None
        if isinstance(u, Inertia):
            k = u.body if isinstance(u.body, int) else model.body_names.index(u.body)
            own = Y[:, 10 * k : 10 * k + 10]
        elif isinstance(u, Unknown) and _leaf(u) == "joints.armature":
            own = coordinates[:, np.arange(model.nv)[u.index].reshape(-1)]
        if own is not None:
            columns.append(own)
            places += range(end, end + size)
        end += size
    found = combinations(np.concatenate(columns, 1), [unknowns.names[j] for j in places])
    at, n = np.array(places), sum(unknowns.sizes)
    dropped = at[list(found.dropped)]
    kept = np.setdiff1d(np.arange(n), dropped)
    B = np.eye(n)[kept]
    B[np.ix_(np.searchsorted(kept, at[list(found.kept)]), dropped)] = found.K
    return Grouped(kept, B)


def no_part_of_a_program() -> Any:
    """A context of numbers that are computed while a program is traced. Outside of a trace it is
    none: within it each operation on known numbers would be compiled by itself."""
    return jax.ensure_compile_time_eval() if inside_jit() else contextlib.nullcontext()


def _plain(setup: Setup, unknowns: Unknowns) -> bool:
    """Whether numbers of bodies act by nothing but the dynamics, and no other unknown changes Y."""
    model = setup.model
    by_joint = all(isinstance(e, BY_JOINT) for e in model.forces)
    leaves = [_leaf(one) for u in unknowns.members.values() for one in getattr(u, "members", (u,))]
    known = all(leaf in DYNAMIC or leaf.partition(".")[0] in ROOMS for leaf in leaves)
    traced = any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(setup))
    return by_joint and known and not (model.constraints or model.nx or traced)


def _leaf(u: Any) -> str:
    """The leaf that an unknown is, "" where it is not one."""
    name = "bodies.inertia" if isinstance(u, Inertia) else getattr(u, "leaf", "")
    return name.removeprefix("model.") if isinstance(u, (Inertia, Unknown)) else ""
