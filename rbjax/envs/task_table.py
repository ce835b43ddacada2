"""The displays of a `Task`, an `Environment` and a `Monitor`, for `rbjax.display`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rbjax.display import Display, host, number, plural, value_text


def task_display(task: Any) -> Display:
    """Return the display of a `Task`: its time steps, its model, and the names of its terms."""
    return Display(f"Task {_steps(task.name, task)}", _rows(task))


def environment_display(env: Any) -> Display:
    """Return the display of an `Environment`: the sizes of actions and observations, its options
    and its task."""
    sizes = env.observation_size
    sizes = sizes if isinstance(sizes, dict) else {"": sizes}
    each = ", ".join(f"{group} ({n},)".strip() for group, n in sizes.items())
    rows = [("sizes", f"action ({env.action_size},), observation {each}")]
    rows += [("options", value_text(env.options))] if env.options else []
    return Display(
        f"Environment {_steps(env.name or env.task.name, env.task)}", rows + _rows(env.task)
    )


def monitor_display(monitor: Any) -> Display:
    """Return the display of a `Monitor`: the figures of its last report."""
    last = monitor.rows[-1] if monitor.rows else {}
    done = f"{last.get('steps', 0)} of {monitor.steps} steps"
    title = f"Monitor {monitor.label!r}: {done}, {plural(len(monitor.rows), 'report')}"
    return Display(title, [(name, number(x)) for name, x in last.items() if name != "steps"])


def _steps(name: str, task: Any) -> str:
    dt = host(task.model.timestep if task.dt is None else task.dt)
    size = "" if dt is None or dt.ndim else f" of {number(dt.item() * task.decimation)} s"
    physics = plural(task.decimation, "physics step")
    return f"{name!r}: {plural(task.episode, 'control step')}{size}, {physics} in each"


def _rows(task: Any) -> list[tuple[str, str]]:
    """Return a row for each part of a task that is not empty or None."""
    action = value_text(task.action)
    if task.action_delay != (0, 0):
        action += f", delay {value_text(task.action_delay)} control steps"
    groups = task.observations
    if isinstance(groups, Mapping):
        groups = "; ".join(f"{group}: {_names(terms)}" for group, terms in groups.items())
    rows = {
        "model": value_text(task.model), "observations": groups, "rewards": _names(task.rewards),
        "action": action, "variables": _names(task.variables), "events": _names(task.events),
        "terminations": _names(task.terminations), "randomised": _names(task.randomise),
        "values": value_text(task.values) if task.values else "",
    }  # fmt: skip
    rows |= {
        name: value_text(x)
        for name in ("integrator", "contact")
        if (x := getattr(task, name)) is not None
    }
    return [(name, str(x)) for name, x in rows.items() if x]


def _names(terms: Any) -> str:
    """Return the names of terms: keys of a mapping, or names of its entries."""
    if not isinstance(terms, Sequence | Mapping) or isinstance(terms, str):
        return value_text(terms)
    return ", ".join(x if isinstance(x, str) else str(getattr(x, "name", x)) for x in terms)
