"""Samples at other times: cubic splines of columns, slerp of attitudes."""

from __future__ import annotations

import numpy as np
from scipy import interpolate
from scipy.spatial.transform import Rotation, Slerp

from rbjax.model import Model

#: tolerance of the length of a quaternion; least change of an entry of a quaternion that turns
UNIT, MOVES = 1e-3, 0.1


def quaternion_columns(sensor: str, values: np.ndarray, model: Model | None) -> tuple[int, ...]:
    """The first columns of the quaternions (w, x, y, z) of a sensor. Without a model, a quaternion
    of q is any four neighbouring columns that move and have length 1 at every sample."""
    if sensor.startswith("pose:"):
        return (3,)
    if sensor != "q":
        return ()
    if model is not None:
        return model.topology.quaternion_starts
    found: list[int] = []
    k = 0
    while k + 4 <= values.shape[1]:
        four = values[:, k : k + 4]
        four = four[~np.isnan(four).any(1)]
        unit = len(four) > 1 and (np.abs(np.linalg.norm(four, axis=1) - 1) < UNIT).all()
        if unit and np.ptp(four, axis=0).max() > MOVES:
            found.append(k)
            k += 4
        else:
            k += 1
    return tuple(found)


def interpolated(
    clock: np.ndarray, values: np.ndarray, t: np.ndarray, step: float, gap: float | None,
    turns: tuple[int, ...],
) -> np.ndarray:  # fmt: skip
    """Values (samples, columns) at times t; nan if samples are too far apart
    (`Recording.on_clock`). turns: the first columns of quaternions."""
    there = ~np.isnan(values)
    out = np.full((len(t), values.shape[1]), np.nan)
    longest = 3 * step if gap is None else gap
    for j, arrived in enumerate(there.T):
        times = clock[arrived]
        if len(times) < 2:
            continue
        after = np.clip(np.searchsorted(times, t, side="left"), 1, len(times) - 1)
        before = after - 1
        known = (times[after] - times[before] <= longest) | np.isin(t, times)
        if gap is None:  # a sample that was dropped in between
            places = np.flatnonzero(arrived)
            known &= (places[after] - places[before] == 1) | np.isin(t, times)
        known &= (times[0] <= t) & (t <= times[-1])
        out[known, j] = interpolate.CubicSpline(times, values[arrived, j])(t[known])
    for k in turns:
        four = slice(k, k + 4)
        arrived, known = there[:, four].all(1), ~np.isnan(out[:, four]).any(1)
        out[:, four] = np.nan
        if arrived.sum() < 2:
            continue
        samples = Rotation.from_quat(values[arrived, four], scalar_first=True)
        at = np.clip(t[known], *clock[arrived][[0, -1]])
        out[known, four] = Slerp(clock[arrived], samples)(at).as_quat(scalar_first=True)
    return out
