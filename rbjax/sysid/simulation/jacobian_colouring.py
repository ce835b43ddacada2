"""Colouring of the Jacobian of a simulation error: fewer directional derivatives than unknowns.

Kinematic trees that begin at the world move independently if no element couples them. An unknown of
one such part, such as a leg of a robot with a fixed base, changes only the readings of that part.
Therefore one direction may contain an unknown of each part (Curtis, Powell & Reid, IMA J. Appl.
Math. 13, 1974).

Inertial parameters and armatures change a motion only through the base parameters:

    tau = Y(q, v, a) p,   Y_dropped = Y_kept K   so   J_dropped = J_kept K

Derivatives along the kept parameters are sufficient (Gautier & Khalil, IEEE Trans. Robotics and
Automation 6(3), 1990).
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.linalg

from rbjax.compiling import inside_jit
from rbjax.forces import JointFriction, JointLimits
from rbjax.model import WORLD
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.parameters.unknowns import Inertia, Unknown
from rbjax.sysid.simulation.setup import PD, Setup
from rbjax.sysid.statistics.rank import combinations
from rbjax.sysid.torque.motions import random_motions
from rbjax.sysid.torque.regressors import regressor

#: force elements that act on each joint as a function of its own q and v
BY_JOINT = (JointFriction, JointLimits)
#: sensors with a column for each joint
OF_JOINTS = frozenset("qv")
#: part index of an unknown that acts on all parts
ALL = -1
#: least number of unknown bodies for which the regressor saves time
BODIES = 4
#: leaves of a model that do not change the regressor
DYNAMIC = ("bodies.mass", "bodies.com", "bodies.inertia", "joints.armature", "joints.damping")
#: fields of a set-up whose leaves do not change the regressor
FIELDS = ("sensors", "controller", "delay", "readings", "actuators", "forces")


class Colouring(NamedTuple):
    """Directions of a Jacobian J (rows, n), each along several unknowns.

    In a row of some part, J = (J seeds^T) weights for the unknowns of that part and of all parts.

    Fields:
        seeds: (K, n) directions.
        weights: (K, n) weights.
        part_of_unknown: (n,) part of each unknown, `ALL` if it acts on all parts.
        part_of_column: sensor -> part of each column; None if the robot is one part.
    """

    seeds: np.ndarray
    weights: np.ndarray
    part_of_unknown: np.ndarray
    part_of_column: dict[str, np.ndarray] | None

    def blocks(self, times: dict[str, int]) -> list[tuple[Any, np.ndarray]]:
        """Return the row indices and unknown indices of each part.

        `times` is the number of samples of each sensor.
        """
        columns = self.part_of_column
        if columns is None:
            return [(slice(None), np.arange(len(self.part_of_unknown)))]
        part_of_row = np.concatenate([np.tile(columns[s], times[s]) for s in sorted(times)])
        found = []
        for part in sorted({int(k) for s in times for k in columns[s]}):
            own = (self.part_of_unknown == part) | (self.part_of_unknown == ALL)
            found.append((np.flatnonzero(part_of_row == part), np.flatnonzero(own)))
        return found

    def basis(self, part: int) -> np.ndarray:
        """Return the weights (K, n), with zeros for unknowns that do not act on a part. `ALL`: no
        zeros."""
        if part == ALL:
            return self.weights
        return self.weights * np.isin(self.part_of_unknown, (part, ALL))

    def expand(self, J: np.ndarray, times: dict[str, int]) -> np.ndarray:
        """Expand the derivatives (..., rows, K) along the seeds to J (..., rows, n)."""
        found = np.zeros((*J.shape[:-1], len(self.part_of_unknown)))
        for rows, which in self.blocks(times):
            own = np.zeros(len(self.part_of_unknown))
            own[which] = 1.0
            found[..., rows, :] = J[..., rows, :] @ (self.weights * own)
        return found


def colour_jacobian(
    setup: Setup, unknowns: Unknowns, own: int, sensors: Collection[str]
) -> Colouring | None:
    """Colour the Jacobian by the unknowns and by `own` corrections of an initial state.

    Return None if every unknown needs its own direction.
    """
    parts = independent_parts(setup) if set(sensors) <= OF_JOINTS else None
    base = base_unknowns(setup, unknowns) if not set(sensors) & set(setup.readings) else None
    if parts is None and base is None:
        return None
    n = sum(unknowns.sizes)
    part_of_unknown = np.zeros(n + own, int)
    if parts is not None:
        with compile_time_constants():
            part_of_unknown[:n] = _parts_of_unknowns(setup, unknowns, parts) if n else ALL
        part_of_unknown[n:] = np.tile(parts, 2)[:own]
    kept, B = (np.arange(n), np.eye(n)) if base is None else base
    kept = np.append(kept, np.arange(n, n + own))
    part_of_kept, direction = part_of_unknown[kept], np.zeros(len(kept), int)
    for part in {*part_of_kept} - {ALL}:
        mine = part_of_kept == part
        direction[mine] = np.arange(mine.sum())
    shared = part_of_kept == ALL
    first = int(direction.max()) + 1 if not shared.all() else 0
    direction[shared] = first + np.arange(shared.sum())
    chosen = (np.arange(direction.max() + 1)[:, None] == direction).astype(float)
    weights = chosen @ scipy.linalg.block_diag(B, np.eye(own))
    columns = None if parts is None else dict.fromkeys(OF_JOINTS, parts)
    return Colouring(chosen @ np.eye(n + own)[kept], weights, part_of_unknown, columns)


def compile_time_constants() -> Any:
    """Create a context in which arrays are compile-time constants during a trace.

    Outside of a trace the context does nothing, since it would compile each operation separately.
    """
    return jax.ensure_compile_time_eval() if inside_jit() else contextlib.nullcontext()


def independent_parts(setup: Setup) -> np.ndarray | None:
    """Find the part of each joint, or None unless several parts are known to move independently."""
    model, top = setup.model, setup.model.topology
    single = model.nq == model.nv == len(top.joint_kinds)
    servo = setup.controller is None or (
        isinstance(setup.controller, PD) and tuple(model.actuators.joints) == (*range(model.nv),)
    )
    at_joints = all(site == -1 for site in model.actuators.sites)
    if not (single and servo and at_joints and _has_only_joint_elements(setup)):
        return None
    roots = [chain[0] for chain in top.ancestors]
    return np.unique(roots, return_inverse=True)[1] if len(set(roots)) > 1 else None


def _has_only_joint_elements(setup: Setup) -> bool:
    """Check for constant values, no constraints, and only single-joint force elements."""
    model = setup.model
    traced = any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(setup))
    by_joint = all(isinstance(e, BY_JOINT) for e in model.forces)
    return by_joint and not (model.constraints or model.nx or traced)


def _parts_of_unknowns(setup: Setup, unknowns: Unknowns, parts: np.ndarray) -> np.ndarray:
    """Find the part of each unknown, from the entries of the set-up that depend on it."""

    def write(p: jax.Array) -> list[Any]:
        leaves = jax.tree.leaves(unknowns.write(setup, p))
        return [x for x in leaves if np.issubdtype(x.dtype, np.floating)]

    paths = jax.tree_util.tree_flatten_with_path(setup)[0]
    owners = [
        _parts_of_rows(setup, jax.tree_util.keystr(path, simple=True, separator="."), x, parts)
        for path, x in paths if np.issubdtype(np.asarray(x).dtype, np.floating)
    ]  # fmt: skip
    guess, rng = np.asarray(unknowns.read(setup)), np.random.default_rng(0)
    n, size = guess.size, 0.01 * (np.abs(guess) + 0.01)
    # a derivative may be zero at one point by chance
    points = guess + np.outer(np.arange(3), np.ones(n)) * size * rng.normal(size=(3, n))
    touched: list[set[int]] = [set() for _ in range(n)]
    for slopes, at in zip(jax.jit(jax.vmap(jax.jacfwd(write)))(points), owners, strict=True):
        depends = (np.asarray(slopes) != 0).reshape(3, len(at), -1, n).any((0, 2))
        for row, j in np.argwhere(depends):
            touched[j].add(int(at[row]))
    return np.array([only.pop() if len(only) == 1 else ALL for only in touched])


def _parts_of_rows(setup: Setup, path: str, leaf: Any, parts: np.ndarray) -> np.ndarray:
    """Return the part of each row of a leaf of the set-up."""
    model = setup.model
    size = max(np.shape(leaf)[0] if np.ndim(leaf) else 1, 1)
    field, _, rest = path.removeprefix("model.").partition(".")
    found: list[int] = []
    if field == "bodies":
        found = [parts[i] if i != WORLD else ALL for i in model.topology.body_links]
    elif field in ("joints", "controller") or path.startswith(("sensors.q.", "sensors.v.")):
        found = list(parts)
    elif field == "actuators":
        found = [parts[j] if j >= 0 else ALL for j in model.actuators.joints]
    elif field == "forces":
        element = model.forces[int(rest.partition(".")[0])]
        found = [parts[model.joint(j)] for j in element.joints]
    return np.array(found) if len(found) == size and np.ndim(leaf) else np.full(size, ALL)


def base_unknowns(setup: Setup, unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the unknowns (r,) that need derivatives, and B (r, n) with J = J[:, kept] B.

    Return None if some unknown may act on more than the dynamics.
    """
    bodies = [u for u in unknowns.members.values() if isinstance(u, Inertia)]
    leaves = [_leaf(one) for u in unknowns.members.values() for one in getattr(u, "members", (u,))]
    known = all(leaf in DYNAMIC or leaf.partition(".")[0] in FIELDS for leaf in leaves)
    if len(bodies) < BODIES or not (known and _has_only_joint_elements(setup)):
        return None
    model, n = setup.model, sum(unknowns.sizes)
    samples = 20 + 2 * n // min(model.nv, 6)
    drawn: Any = random_motions(model, samples)
    with compile_time_constants():
        Y = np.asarray(regressor(model, *drawn))
    Y = Y.reshape(samples * model.nv, -1)
    of_armatures = (drawn[2][:, :, None] * np.eye(model.nv)).reshape(len(Y), -1)
    columns: list[np.ndarray] = []
    places: list[int] = []
    end = 0
    for u, size in zip(unknowns.members.values(), unknowns.sizes, strict=True):
        own = None
        if isinstance(u, Inertia):
            k = u.body if isinstance(u.body, int) else model.body_names.index(u.body)
            own = Y[:, 10 * k : 10 * k + 10]
        elif isinstance(u, Unknown) and _leaf(u) == "joints.armature":
            own = of_armatures[:, np.arange(model.nv)[u.index].reshape(-1)]
        if own is not None:
            columns.append(own)
            places += range(end, end + size)
        end += size
    found = combinations(np.concatenate(columns, 1), [unknowns.names[j] for j in places])
    at = np.array(places)
    dropped = at[list(found.dropped)]
    kept = np.setdiff1d(np.arange(n), dropped)
    B = np.eye(n)[kept]
    B[np.ix_(np.searchsorted(kept, at[list(found.kept)]), dropped)] = found.K
    return kept, B


def _leaf(u: Any) -> str:
    """Return the name of the leaf that an unknown changes, or "" if it changes several."""
    name = "bodies.inertia" if isinstance(u, Inertia) else getattr(u, "leaf", "")
    return name.removeprefix("model.") if isinstance(u, (Inertia, Unknown)) else ""
