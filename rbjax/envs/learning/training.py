"""`train`: a policy for a named task, with its settings, progress, table, chart and checkpoint."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from rbjax.arguments import choice, flag, instance, integer, real_number, shown
from rbjax.envs.environment import Environment
from rbjax.envs.learning.checkpoint import save_policy
from rbjax.envs.learning.proximal import ppo
from rbjax.envs.learning.report import Monitor
from rbjax.envs.learning.short_horizon import shac
from rbjax.envs.learning.task_settings import ALGORITHMS, settings
from rbjax.envs.learning.trained import Trained
from rbjax.envs.registry import make
from rbjax.errors import InputError, UnknownName


def train(
    task: str | Environment,
    algorithm: str = "ppo",
    *,
    steps: int | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    devices: int | None = None,
    seconds: float | None = None,
    options: Mapping[str, Any] | None = None,
    progress: bool = True,
    **changes: Any,
) -> Trained:
    """Train a policy for a task.

    Use it for a task of the registry with its settings. The learners themselves are `ppo` and
    `shac`.

    Args:
        task: name of a task (`rb.envs.tasks`), or an `Environment`; one of `rb.envs.make` if `out`
            is given.
        algorithm: "ppo" (Brax) or "shac" (gradients through the environment).
        steps: steps of the robot in the training; None for the setting of the task.
        out: folder of the checkpoint and "table.csv", written after each report, and of
            "chart.png", written at the end; None for none.
        seed: of the random numbers.
        devices: number of devices that share the samples; None for one.
        seconds: limit of time, after which the training ends with the next report; None for none.
        options: options of the named task, over those of `task_settings.OPTIONS`; those of an
            `Environment` are its own.
        progress: whether the progress is printed.
        changes: settings that replace those of `rb.envs.learning.settings`.

    Returns:
        `Trained`.

    Raises:
        UnknownName: no such task or algorithm.
        InputError: settings out of range, a missing package, or `out` for a task that is not
            registered.

    Example:
        >>> import rbjax as rb
        >>> trained = rb.envs.learning.train(
        ...     "cart_pole_balance", "shac", steps=64, progress=False, batch=4, horizon=4,
        ...     hidden=(4,), reports=1)
        >>> trained.rewards.shape
        (4,)
    """
    if algorithm not in ALGORITHMS:
        raise UnknownName("algorithm", algorithm, ALGORITHMS)
    flag("train", "progress", progress)
    integer("train", "seed", seed, least=0)
    if steps is not None:
        integer("train", "steps", steps, least=1)
    if seconds is not None:
        real_number("train", "seconds", seconds, above=0.0)
    if options is not None and not isinstance(options, Mapping):
        raise InputError(f"train: options is {shown(options)}, expected a dict of options")
    if out is not None:
        instance("train", "out", out, str | Path, "a path of a folder")
    if isinstance(task, Environment) and options:
        raise InputError("train: options need the name of a task, got an Environment")
    env = task if isinstance(task, Environment) else make(task, **(options or {}))
    name = env.task.name if env.name is None else env.name
    if out is not None and env.name is None:
        raise InputError(
            f"train: out is {str(out)!r} but the environment of {name!r} was not made by "
            "rb.envs.make, so that load_policy could not make it again; register the task with "
            "rb.envs.register and pass its name, or leave out and save the result"
        )
    chosen = settings(env.name, algorithm)
    chosen = chosen | ({} if steps is None else {"steps": steps}) | changes
    record = {"algorithm": algorithm, "seed": seed, "devices": devices, **chosen}
    folder = None if out is None else Path(out)

    arguments, total = chosen, chosen["steps"]
    if algorithm == "shac":
        arguments = shac_arguments(chosen)
        total = arguments["iterations"] * arguments["batch"] * arguments["horizon"]

    with Monitor(f"{name} by {algorithm}", total, folder, progress) as monitor:

        def report(done: int, figures: Mapping[str, float], policy: Any) -> None:
            monitor(done, figures)
            if folder is not None and policy is not None:
                save_policy(folder, policy, name, env.options, record)

        more: dict[str, Any] = {"devices": devices, "seconds": seconds, "report": report}
        key = jax.random.key(seed)
        if algorithm == "ppo":
            trained = ppo(env, key, **arguments, **more)
        else:
            trained = shac(env, key, **arguments, **more)
    return trained


#: arguments of `shac` that `train` sets; `iterations` follows from `steps`
SET_BY_TRAIN = ("env", "key", "iterations", "devices", "report", "seconds")


def shac_arguments(chosen: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `shac`: iterations from the number of steps, rounded to reports of
    equal length."""
    found = dict(chosen)
    known = ["steps", *(x for x in inspect.signature(shac).parameters if x not in SET_BY_TRAIN)]
    for name in found:
        choice("setting of SHAC", name, known)
    batch, horizon, reports = (
        integer("train", name, found.get(name, default), least=1)
        for name, default in (("batch", 256), ("horizon", 32), ("reports", 1))
    )
    per_iteration = batch * horizon
    iterations = max(1, round(found.pop("steps") / per_iteration))
    if iterations > reports:
        iterations = reports * round(iterations / reports)
    return found | {"iterations": iterations, "batch": batch, "horizon": horizon}
