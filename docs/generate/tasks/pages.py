"""A page for each task: its definition, its terms, its clip and the curves of its trainings."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import rbjax as rb
from docs.generate.markdown.plain_text import escaped
from docs.generate.markdown.table import table
from docs.generate.tasks.definition import definition
from docs.generate.tasks.terms import (
    changed,
    described,
    events,
    observations,
    randomised_variant,
    shapes,
)
from docs.generate.tasks.training import chart, results, trainings
from rbjax.envs.control_step import ControlStep


def pages(root: Path) -> dict[str, str | bytes]:
    """The page and the chart of each task, and the list of tasks."""
    clips = json.loads((root / "docs" / "tasks" / "clips" / "clips.json").read_text())
    out: dict[str, str | bytes] = {"tasks/index.md": contents()}
    for name, make in rb.envs.tasks().items():
        curves = trainings(name)
        if curves:
            out[f"tasks/figures/{name}.svg"] = chart(curves)
        out[f"tasks/{name}.md"] = page(name, make, clips.get(name), curves)
    return out


def contents() -> str:
    """The list of tasks."""
    rows = [(f"[`{n}`]({n}.md)", summary(make)) for n, make in rb.envs.tasks().items()]
    return (
        "# Tasks\n\n`rb.envs.make(name)` makes the environment of a task, and `rbjax train NAME` "
        "trains a policy for it. [Environments](../guides/environments.md) has the interface.\n\n"
        + table(("task", "goal"), rows)
    )


def page(name: str, make: Callable, clip: Any, curves: dict[str, Any]) -> str:
    """The page of a task."""
    task = make()
    sizes, variables = shapes(task)
    parts = [f"# {name}", summary(make)]
    if clip is not None:
        parts += [f"![{name}](clips/{name}.webp)", f"*{clip['caption']}*"]
    parts += [f'```python\nimport rbjax as rb\n\nenv = rb.envs.make("{name}")\n```']
    parts += [*definition(make), "## Sizes and times", table(("", ""), numbers(task))]
    if inspect.signature(make).parameters:
        parts += ["## Options", table(("option", "default", ""), options(make))]
    head = "group", "term", "size", "noise", ""
    parts += ["## Observations", table(head, observations(task, sizes))]
    rows = [(f"`{r.name}`", f"{r.weight:g}", described(r.read)) for r in task.rewards]
    parts += ["## Rewards", table(("term", "weight", ""), rows)]
    total = described(task.total_reward).partition(": ")[2]
    parts += [f"The reward of a step is {total or described(task.total_reward)}"]
    parts += events(task, variables)
    randomised = task.randomise or randomised_variant(make)
    if randomised:
        rows = [(f"`{r.name}`", changed(r)) for r in randomised]
        head = "Randomisation" if task.randomise else "Randomisation (option `randomise=True`)"
        parts += [f"## {head}", table(("drawn at each reset", ""), rows)]
    if task.values:
        rows = [(f"`{n}`", f"`{np.asarray(x).tolist()}`") for n, x in task.values.items()]
        parts += ["## Values", "`params.values`, which change without compiling again:"]
        parts += [table(("name", "value"), rows)]
    if curves:
        parts += ["## Training", f"![Reward of an episode](figures/{name}.svg)"]
        parts += [table(("learner", "device", "steps", "s", "reward"), results(curves))]
        parts += [f"Command: `python -m benchmarks.envs.training --task {name}`."]
    return "\n\n".join(parts) + "\n"


def summary(make: Callable) -> str:
    """The first paragraph of the docstring of a task."""
    return escaped(" ".join((inspect.getdoc(make) or "").split("\n\n")[0].split()))


def options(make: Callable) -> list[tuple[str, ...]]:
    """The options of a task, with their defaults and the text of the docstring."""
    doc = " ".join((inspect.getdoc(make) or "").split())
    out = []
    for name, parameter in inspect.signature(make).parameters.items():
        end = r"(?= \w+(?:, \w+)*: | Example: | Source: |$)"
        found = re.search(rf"(?<![\w`]){name}(?:, \w+)*: (.*?){end}", doc)
        text = escaped(found[1].rstrip(".;")) if found else ""
        out.append((f"`{name}`", f"`{parameter.default}`", text))
    return out


def numbers(task: Any) -> list[tuple[str, str]]:
    """The sizes and the times of a task."""
    step = ControlStep(task)
    dt = step.step * task.decimation
    law = task.contact if task.contact is not None else task.model.contact
    kind = type(task.action).__name__
    size = counted(step.action_size, "number")
    return [
        ("control step", f"{1e3 * dt:g} ms, {counted(task.decimation, 'physics step')}"),
        ("episode", f"{task.episode} control steps, {task.episode * dt:g} s"),
        ("robot", f"{task.model.nv} degrees of freedom, {counted(task.model.nu, 'actuator')}"),
        ("action", f"{size}, `rb.envs.{kind}`: {described(type(task.action))}"),
        ("contact law", "none" if law is None else f"`{law}`"),
    ]


def counted(count: int, noun: str) -> str:
    """A number and its noun.

    >>> counted(1, "actuator"), counted(12, "actuator")
    ('1 actuator', '12 actuators')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
