"""Trajectories in files: an .npz with the times, the states, and the robot as MJCF text."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import existing_file, file_path, instance, real_array
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError, RbjaxError
from rbjax.loading.loader import load
from rbjax.loading.sources import read_text
from rbjax.loading.write.mjcf import write_mjcf
from rbjax.model import Model
from rbjax.motion.trajectory import Trajectory


class SavedTrajectory(NamedTuple):
    """A trajectory of a file, and its robot.

    model: the robot.
    trajectory: times and states; of a batch if it was one.
    source: the robot's file if it still exists, otherwise the MJCF text: for the shapes to draw.
    """

    model: Model
    trajectory: Trajectory
    source: str


def save_trajectory(
    path: str | Path, model: Model, trajectory: Trajectory, *, source: Any = None
) -> Path:
    """Write a trajectory with its robot to an .npz file, for `load_trajectory` and `rbjax view`.

    The file has the arrays ts, q, v and x of the trajectory, and the model as MJCF text. Meshes are
    not in the text; they are drawn from `source` while that file exists.

    Args:
        path: the file, which ends in .npz.
        model: the robot that moved.
        trajectory: of `rollout` or `simulate`, of one sample or a batch.
        source: the path, scene name or XML text from which the model was loaded; None if it was
            not.

    Returns:
        The path.

    Raises:
        InputError: another suffix, no such folder, a trajectory of another model, or a model that
            MJCF cannot express, without a source from which it can be loaded.

    Example:
        >>> import pathlib, tempfile
        >>> import jax.numpy as jnp, rbjax as rb
        >>> model = rb.load("pendulum")
        >>> run = rb.rollout(model, rb.State(jnp.ones(1), jnp.zeros(1)), None, 0.01, steps=20)
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "swing.npz"
        >>> rb.loading.save_trajectory(file, model, run).name
        'swing.npz'
        >>> rb.loading.load_trajectory(file).trajectory.q.shape
        (21, 1)
    """
    path = file_path("save_trajectory", path)
    check_model("save_trajectory", model)
    instance("save_trajectory", "trajectory", trajectory, Trajectory, "rb.Trajectory")
    if path.suffix != ".npz" or path.is_dir() or not path.absolute().parent.is_dir():
        raise InputError(
            f"save_trajectory: path is {str(path)!r}, expected a name that ends in .npz, in a "
            "folder that exists"
        )
    if trajectory.q.shape[-1] != model.nq or trajectory.v.shape[-1] != model.nv:
        raise InputError(
            f"save_trajectory: q has {trajectory.q.shape[-1]} and v {trajectory.v.shape[-1]} "
            f"entries, expected {model.nq} and {model.nv} for this model: give the model that made "
            "the trajectory"
        )
    if source is not None:
        instance("save_trajectory", "source", source, str | Path, "a path, a scene or XML text")
    given = "" if source is None else str(source)
    if given and not given.lstrip().startswith("<"):
        file = read_text(source)[1]
        given = given if file is None or not Path(given).exists() else str(file.absolute())
    text = _text(model)
    if _size(text) != (model.nq, model.nv):
        text = ""
        if _size(given) != (model.nq, model.nv):
            raise InputError(
                "save_trajectory: MJCF cannot express this model, such as its flexible links, and "
                "source does not load it either; draw the motion in the program that made it: "
                "rb.viewer.view(model, trajectory) or rb.plotting.animate(model, trajectory, path)"
            )
    arrays: dict[str, Any] = {
        name: np.asarray(getattr(trajectory, name)) for name in ("ts", "q", "v", "success")
    }
    if trajectory.x is not None:
        arrays["x"] = np.asarray(trajectory.x)
    np.savez_compressed(path, **arrays, mjcf=np.array(text), source=np.array(given))
    return path


def load_trajectory(path: str | Path) -> SavedTrajectory:
    """Read a file of `save_trajectory`.

    Args:
        path: the file.

    Returns:
        `SavedTrajectory`: the model, the trajectory, and the source of its shapes.

    Raises:
        InputError: no such file, or a file without a trajectory and its robot.

    Example:
        >>> import pathlib, tempfile
        >>> import jax.numpy as jnp, rbjax as rb
        >>> model = rb.load("pendulum")
        >>> run = rb.rollout(model, rb.State(jnp.ones(1), jnp.zeros(1)), None, 0.01, steps=5)
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "swing.npz"
        >>> saved = rb.loading.load_trajectory(rb.loading.save_trajectory(file, model, run))
        >>> saved.model.joint_names, len(saved.trajectory)
        (('hinge',), 6)
    """
    path = existing_file("load_trajectory", path)
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except Exception as error:  # a damaged archive may raise anything
        raise InputError(f"load_trajectory: {path} is not an .npz file of arrays") from error
    missing = {"ts", "q", "v", "mjcf", "source"} - found.keys()
    if missing:
        raise InputError(
            f"load_trajectory: {path} has no {', '.join(sorted(missing))}, expected a file of "
            "rb.loading.save_trajectory"
        )
    text, source = (_text_of(path, name, found[name]) for name in ("mjcf", "source"))
    model = _quiet(text or source)
    trajectory = _trajectory_of(path, found)
    if (trajectory.q.shape[-1], trajectory.v.shape[-1]) != (model.nq, model.nv):
        raise InputError(
            f"load_trajectory: {path} has q with {trajectory.q.shape[-1]} and v with "
            f"{trajectory.v.shape[-1]} entries, and its robot {model.nq} and {model.nv}: the "
            "robot's file has changed since then"
        )
    drawn = source if source and _size(source) == (model.nq, model.nv) else text
    return SavedTrajectory(model, trajectory, drawn)


def _text_of(path: Path, name: str, x: np.ndarray) -> str:
    if x.dtype.kind != "U" or x.ndim:
        raise InputError(
            f"load_trajectory: {name} of {path} has dtype {x.dtype} and shape {x.shape}, expected "
            "one text"
        )
    return str(x)


def _trajectory_of(path: Path, found: dict[str, np.ndarray]) -> Trajectory:
    """Return the trajectory of the arrays of a file; no `success` if a state is not finite."""
    where, x = f"load_trajectory: {path}", found.get("x")
    ts = real_array(where, "ts", found["ts"], "times (T,)", ndim=1)
    q, v = (real_array(where, name, found[name], finite=False) for name in ("q", "v"))
    lead = q.shape[:-2]
    name = "success" if "success" in found else "ok"  # files of earlier versions have `ok`
    success = np.asarray(found.get(name, np.ones(lead, bool)))
    parts = {"q": q, "v": v} | ({} if x is None else {"x": real_array(where, "x", x, finite=False)})
    for name, part in parts.items():
        if part.ndim < 2 or part.ndim > 3 or part.shape[:-1] != (*lead, len(ts)):
            raise InputError(
                f"{where}: {name} has shape {part.shape}, expected ({len(ts)}, n), or "
                f"(B, {len(ts)}, n) for a batch, as q and ts have it"
            )
        if success.dtype != bool or success.shape != lead:
            raise InputError(
                f"{where}: success is {success.dtype} of shape {success.shape}, expected bool of "
                f"shape {lead}"
            )
        success = success & np.isfinite(part).all((-2, -1))
    if (np.diff(ts) < 0).any():
        raise InputError(f"{where}: ts decreases, expected increasing times")
    arrays = {name: jnp.asarray(part) for name, part in parts.items()}
    return Trajectory(
        jnp.asarray(ts), arrays["q"], arrays["v"], jnp.asarray(success), x=arrays.get("x")
    )


def _text(model: Model) -> str:
    """Return a model as MJCF; an empty text if it cannot be written."""
    with warnings.catch_warnings(action="ignore"):
        try:
            return write_mjcf(model)
        except RbjaxError:
            return ""


def _size(source: str) -> tuple[int, int] | None:
    """Return nq and nv of a source; None if it cannot be loaded."""
    if not source:
        return None
    try:
        model = _quiet(source)
    except RbjaxError:
        return None
    return model.nq, model.nv


def _quiet(source: str) -> Model:
    with warnings.catch_warnings(action="ignore"):
        return load(source)
