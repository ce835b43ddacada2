"""Parts of a set-up that do not act on each other, such as the legs of a robot whose base is held.

Links whose chains begin at the world share no motion: with no element between them each moves by
itself. A number of one part (an *island*) then moves only what that part's sensors read. So one
direction of a Jacobian may hold a number of each island, and its rows are taken apart afterwards:
J e_1 and J e_2 have no row in common, where J (e_1 + e_2) shows both. 49 numbers of a quadruped, of
which one acts on all legs, take 13 directions. Numbers that motions show only together with others
take none (`grouping`).

Source: Curtis, Powell & Reid, *On the estimation of sparse Jacobian matrices*, IMA J. Appl. Math.
13, 1974.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.linalg

from rbjax.model import WORLD, Model
from rbjax.sysid.parameters.unknowns import Unknowns
from rbjax.sysid.simulation.grouping import BY_JOINT, grouped, no_part_of_a_program
from rbjax.sysid.simulation.setup import PD, Setup

#: sensors whose columns are the joints'
OF_JOINTS = frozenset("qv")
#: the island of what acts on all
ALL = -1
#: a number that differs by less than this share of itself was not changed but rounded
SAME = 1e-12


class Directions(NamedTuple):
    """Directions that show several numbers each.

    seeds (K, n), of n numbers, and weights (K, n): J = (J seeds^T) weights, where a row has only
    the numbers of its island. of_numbers (n,), the island of each, `ALL` for what acts on all;
    of_columns, by sensor the island of each column, None where all is one.
    """

    seeds: np.ndarray
    weights: np.ndarray
    of_numbers: np.ndarray
    of_columns: dict[str, np.ndarray] | None

    def parts(self, times: dict[str, int]) -> list[tuple[Any, np.ndarray]]:
        """For each island, which rows of a residual with so many times of each sensor show which
        numbers."""
        columns = self.of_columns
        if columns is None:
            return [(slice(None), np.arange(len(self.of_numbers)))]
        at = np.concatenate([np.tile(columns[s], times[s]) for s in sorted(times)])
        found = []
        for k in sorted({int(k) for s in times for k in columns[s]}):
            mine = (self.of_numbers == k) | (self.of_numbers == ALL)
            found.append((np.flatnonzero(at == k), np.flatnonzero(mine)))
        return found

    def whole(self, J: np.ndarray, times: dict[str, int]) -> np.ndarray:
        """J (..., rows, n) of J (..., rows, K) along the seeds."""
        found = np.zeros((*J.shape[:-1], len(self.of_numbers)))
        for rows, which in self.parts(times):
            own = np.zeros(len(self.of_numbers))
            own[which] = 1.0
            found[..., rows, :] = J[..., rows, :] @ (self.weights * own)
        return found


def directions(
    setup: Setup, unknowns: Unknowns, own: int, sensors: Collection[str]
) -> Directions | None:
    """The directions of the unknowns and of `own` corrections of a start; None where the set-up is
    one part, or not known to be several, and its numbers do not group."""
    islands = islands_of(setup) if set(sensors) <= OF_JOINTS else None
    group = grouped(setup, unknowns) if not set(sensors) & set(setup.readings) else None
    if islands is None and group is None:
        return None
    n = sum(unknowns.sizes)
    of_numbers = np.zeros(n + own, int)
    if islands is not None:
        with no_part_of_a_program():
            of_numbers[:n] = _owners(setup, unknowns, islands)
        of_numbers[n:] = np.tile(islands, 2)[:own]
    kept, B = (np.arange(n), np.eye(n)) if group is None else group
    kept = np.append(kept, np.arange(n, n + own))
    of_kept, place = of_numbers[kept], np.zeros(len(kept), int)
    for island in {*of_kept} - {ALL}:
        mine = of_kept == island
        place[mine] = np.arange(mine.sum())
    shared = of_kept == ALL
    first = int(place.max()) + 1 if not shared.all() else 0
    place[shared] = first + np.arange(shared.sum())
    chosen = (np.arange(place.max() + 1)[:, None] == place).astype(float)
    weights = chosen @ scipy.linalg.block_diag(B, np.eye(own))
    of_columns = None if islands is None else dict.fromkeys(OF_JOINTS, islands)
    return Directions(chosen @ np.eye(n + own)[kept], weights, of_numbers, of_columns)


def islands_of(setup: Setup) -> np.ndarray | None:
    """The island of each joint; None where these are not known to be several."""
    model, top = setup.model, setup.model.topology
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(setup)):
        return None
    plain = model.nq == model.nv == len(top.joint_kinds) and not (model.constraints or model.nx)
    by_joint = all(isinstance(e, BY_JOINT) for e in model.forces)
    servo = setup.controller is None or (
        isinstance(setup.controller, PD) and tuple(model.actuators.joints) == (*range(model.nv),)
    )
    at_joints = all(site == -1 for site in model.actuators.sites)
    if not (plain and by_joint and servo and at_joints):
        return None
    roots = [chain[0] for chain in top.ancestors]
    return np.unique(roots, return_inverse=True)[1] if len(set(roots)) > 1 else None


def _owners(setup: Setup, unknowns: Unknowns, islands: np.ndarray) -> np.ndarray:
    """The island of each unknown number: that of all entries of the set-up that it moves."""

    def written(p: jax.Array) -> list[Any]:
        leaves = jax.tree.leaves(unknowns.write(setup, p))
        return [x for x in leaves if np.issubdtype(x.dtype, np.floating)]

    paths = jax.tree_util.tree_flatten_with_path(setup)[0]
    owners = [
        _of_entries(setup, jax.tree_util.keystr(path, simple=True, separator="."), x, islands)
        for path, x in paths if np.issubdtype(np.asarray(x).dtype, np.floating)
    ]  # fmt: skip
    guess, rng = np.asarray(unknowns.read(setup)), np.random.default_rng(0)
    n, size = guess.size, 0.01 * (np.abs(guess) + 0.01)
    # what is zero at one point by chance is not at another
    points = guess + np.outer(np.arange(3), np.ones(n)) * size * rng.normal(size=(3, n))
    steps = np.concatenate([np.zeros((1, n)), np.diag(size)])
    found = jax.jit(jax.vmap(written))((points[:, None] + steps).reshape(-1, n))
    touched: list[set[int]] = [set() for _ in range(n)]
    for leaf, at in zip(map(np.asarray, found), owners, strict=True):
        rows = leaf.reshape(3, n + 1, len(at), -1)
        before, after = rows[:, :1], rows[:, 1:]
        with np.errstate(invalid="ignore"):  # limits may be infinite
            moved = (after != before) & (np.abs(after - before) > SAME * np.abs(before))
        for j, k in np.argwhere(moved.any((0, 3))):
            touched[j].add(int(at[k]))
    return np.array([only.pop() if len(only) == 1 else ALL for only in touched])


def _of_entries(setup: Setup, path: str, leaf: Any, islands: np.ndarray) -> np.ndarray:
    """The island of each row of a leaf."""
    model: Model = setup.model
    top, size = model.topology, max(np.shape(leaf)[0] if np.ndim(leaf) else 1, 1)
    everywhere = np.full(size, ALL)
    room, _, rest = path.partition(".")
    if room == "model":
        room, _, rest = rest.partition(".")
    if room == "bodies":
        at = [islands[i] if i != WORLD else ALL for i in top.body_links]
    elif room in ("joints", "controller") or path.startswith(("sensors.q.", "sensors.v.")):
        at = list(islands)
    elif room == "actuators":
        at = [islands[j] if j >= 0 else ALL for j in model.actuators.joints]
    elif room == "forces":
        element = model.forces[int(rest.partition(".")[0])]
        at = [islands[model.joint(j)] for j in element.joints]
    else:
        return everywhere
    return np.array(at) if len(at) == size and np.ndim(leaf) else everywhere
