"""A page for each task of `rb.envs.tasks`: its terms, its clip and the curves of its trainings."""

from __future__ import annotations

import functools
import inspect
import io
import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from docs.generate import measured
from docs.generate.plain_text import escaped
from rbjax.envs.control_step import ControlStep

ALGORITHMS = {"ppo": "PPO (Brax)", "shac": "SHAC"}


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
    parts += ["## Definition", "```text\n" + definition(make) + "\n```"]
    parts += ["## Numbers", table(("", ""), numbers(task))]
    if inspect.signature(make).parameters:
        parts += ["## Options", table(("option", "default", ""), options(make))]
    head = "group", "term", "size", "noise", ""
    parts += ["## Observations", table(head, observations(task, sizes))]
    rows = [(f"`{r.name}`", f"{r.weight:g}", described(r.read)) for r in task.rewards]
    parts += ["## Rewards", table(("term", "weight", ""), rows)]
    parts += [f"Reward of a step: {described(task.total_reward)}"]
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


def definition(make: Callable) -> str:
    """The docstring of the file of a task."""
    return inspect.getdoc(sys.modules[make.__module__]) or ""


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
    return [
        ("control step", f"{1e3 * dt:g} ms, {task.decimation} physics steps"),
        ("episode", f"{task.episode} control steps, {task.episode * dt:g} s"),
        ("robot", f"{task.model.nv} degrees of freedom, {task.model.nu} actuators"),
        ("action", f"{step.action_size} numbers, `rb.envs.{kind}`: {described(type(task.action))}"),
        ("contact law", "none" if law is None else f"`{law}`"),
    ]


def observations(task: Any, sizes: dict[int, int]) -> list[tuple[str, ...]]:
    """The observation terms of each group."""
    out: list[tuple[str, ...]] = []
    seen: set[int] = set()
    for group, terms in task.observations.items():
        for term in terms:
            text = "as above" if id(term) in seen else described(term.read)
            noise = f"± {np.max(term.noise):g}" if np.any(term.noise) else ""
            out.append((group, f"`{term.name}`", str(sizes[id(term)]), noise, text))
            seen.add(id(term))
    return out


def shapes(task: Any) -> tuple[dict[int, int], dict[str, tuple[int, ...]]]:
    """The size of each observation term, by the identity of the term, and the shapes of the
    variables."""
    step = ControlStep(task)
    values = {n: jnp.asarray(x, step.dtype) for n, x in task.values.items()}
    weights = {r.name: jnp.asarray(r.weight, step.dtype) for r in task.rewards}
    default = rb.envs.Params(task.model, weights, jnp.ones((), step.dtype), values)

    def read() -> tuple:
        state = step.begin(jax.random.key(0), default)
        transition = step.transition(state, state, step.with_drawn(default, state.drawn))
        terms = [jnp.atleast_1d(term(transition)) for _, _, term in step.unique_terms]
        return terms, state.variables

    terms, variables = jax.eval_shape(read)
    sizes = {id(t): s.shape[0] for (_, t, _), s in zip(step.unique_terms, terms, strict=True)}
    return sizes, {name: x.shape for name, x in variables.items()}


def events(task: Any, variables: dict[str, tuple[int, ...]]) -> list[str]:
    """The variables, terminations and events of a task."""
    out = []
    if task.variables:
        rows = [(f"`{v.name}`", f"`{variables[v.name]}`", changes(v)) for v in task.variables]
        out += ["## Variables and commands", table(("name", "shape", "changes"), rows)]
    rows = [(f"`{n}`", described(f)) for n, f in task.terminations.items()]
    rows.append(("not finite", "the state, the action or the reward is not finite"))
    out += ["## Terminations", table(("name", ""), rows)]
    if task.events:
        rows = [(f"`{e.name}`", described(e.apply)) for e in task.events]
        out += ["## Events", table(("name", ""), rows)]
    return out


def changes(variable: Any) -> str:
    """When a variable changes after the reset."""
    found = [("before the rewards", variable.measure), ("after the rewards", variable.update)]
    return ", ".join(text for text, f in found if f is not None) or "at a reset only"


def randomised_variant(make: Callable) -> Sequence[Any]:
    """The randomisation of the task with the option `randomise`."""
    if "randomise" not in inspect.signature(make).parameters:
        return ()
    return make(randomise=True).randomise


def changed(randomisation: Any) -> str:
    """The range of a randomisation of `random_scale` or `random_offset`, if it is one."""
    closure = inspect.getclosurevars(randomisation.draw).nonlocals
    if "low" not in closure or "high" not in closure:
        return described(randomisation.draw)
    text = inspect.getsource(randomisation.apply)
    kind = "factor" if "x * value" in text else "offset" if "x + value" in text else "value"
    low, high = np.min(closure["low"]), np.max(closure["high"])
    each = ", independent for each entry" if closure.get("each") else ""
    return f"{kind} {low:g} to {high:g}{each}"


def described(read: Any) -> str:
    """The first sentence of the docstring of a term, or of the function that returned it; with the
    formula after it if the sentence announces one."""
    if isinstance(read, str):
        return f"sensor `{read}`"
    if isinstance(read, functools.partial):
        read = read.func
    if not hasattr(read, "__qualname__"):
        read = type(read)
    if read.__name__ == "<lambda>" and "<locals>.<lambda>" not in read.__qualname__:
        return source(read)
    if read.__name__ == "<lambda>" and not read.__module__.startswith("rbjax.envs.terms"):
        return source(read)
    owner: Any = sys.modules[read.__module__]
    for part in read.__qualname__.split(".<locals>")[0].split("."):
        owner = getattr(owner, part, None)
    doc = inspect.getdoc(read) or inspect.getdoc(owner) or ""
    first, *rest = doc.split("\n\n")
    sentence = re.split(r"(?<=\.)\s", " ".join(first.split()))[0]
    if sentence.endswith(":") and rest and rest[0].startswith(" "):
        return f"{escaped(sentence)} `{' '.join(rest[0].split())}`"
    return escaped(sentence.rstrip(":"))


def source(read: Any) -> str:
    """The expression of a lambda."""
    try:
        text = " ".join(inspect.getsource(read).split())
        found = re.search(r"lambda [\w, ]+: (.*)", text)
    except OSError:
        return ""
    if found is None:
        return ""
    text, depth = "", 0
    for c in found[1]:
        depth += (c in "([{") - (c in ")]}")
        if depth < 0 or (c == "," and depth == 0):
            break
        text += c
    return f"`{text.strip()}`"


def trainings(name: str) -> dict[str, Any]:
    """The measured trainings of a task: (algorithm, device) -> row."""
    out = {}
    for file in measured.names():
        for algorithm in ALGORITHMS:
            if file.startswith(f"training-{name.replace('_', '-')}-{algorithm}-"):
                out[algorithm, measured.subject(file)[1]] = measured.read(file)["rows"][0]
    return out


def results(curves: dict[str, Any]) -> Iterable[tuple[str, ...]]:
    """The last report of each training, and the evaluation after it."""
    for (algorithm, device), row in curves.items():
        last = row["curve"][-1]
        reward = row.get("evaluation", {}).get("return", last["reward"])
        figures = f"{last['steps'] / 1e6:.3g} M", f"{last['seconds']:.0f}", f"{reward:.4g}"
        yield ALGORITHMS[algorithm], device, *figures


def chart(curves: dict[str, Any]) -> bytes:
    """The reward of an episode over the steps of each training."""
    import matplotlib
    from matplotlib.figure import Figure

    from rbjax.style import STYLE

    with matplotlib.rc_context({**STYLE, "svg.hashsalt": "tasks"}):
        figure = Figure(figsize=(7, 2.8), layout="constrained")
        ax = figure.subplots()
        for (algorithm, device), row in curves.items():
            points = [(p["steps"] / 1e6, p["reward"]) for p in row["curve"] if p["reward"]]
            x, y = np.array([p for p in points if np.isfinite(p[1])]).T
            ax.plot(x, y, marker="o", ms=3, label=f"{ALGORITHMS[algorithm]}, {device}")
        ax.set(xlabel="million steps of the robot", ylabel="reward of an episode")
        ax.set_xlim(left=0)
        ax.legend(loc="lower right")
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None}, facecolor="white")
    return file.getvalue()


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(x.replace("|", "\\|") for x in row) + " |" for row in rows]
    return "\n".join(lines)
