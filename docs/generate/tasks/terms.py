"""The terms of a task as rows of tables: observations, variables, terminations, events."""

from __future__ import annotations

import functools
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from docs.generate.markdown.plain_text import escaped
from docs.generate.markdown.table import table
from rbjax.envs.control_step import ControlStep

#: the beginning of a docstring, which a table of terms does not need
VERB = re.compile(
    r"^(Return the term that observes |Return the term: |Return the termination: |"
    r"Return the function of |(Return|Measure|Observe|Compute|Check) )"
)


def observations(task: Any, sizes: dict[int, int]) -> list[tuple[str, ...]]:
    """The observation terms of each group."""
    out: list[tuple[str, ...]] = []
    groups: dict[str, set[int]] = {}
    for group, terms in task.observations.items():
        here = {id(term) for term in terms}
        inside = [name for name, other in groups.items() if other <= here]
        seen: set[int] = set().union(*(groups[name] for name in inside))
        if inside:
            size = sum(sizes[one] for one in seen)
            out.append((group, f"all of {' and '.join(inside)}", str(size), "", ""))
        for term in (t for t in terms if id(t) not in seen):
            noise = f"± {np.max(term.noise):g}" if np.any(term.noise) else ""
            out.append((group, f"`{term.name}`", str(sizes[id(term)]), noise, described(term.read)))
        groups[group] = here
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
    sentence = VERB.sub("", sentence)
    sentence = sentence[:1].upper() + sentence[1:]
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
