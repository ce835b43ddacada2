"""The display of an optimal control problem: sizes, costs, constraints, bounds."""

from __future__ import annotations

from typing import Any

from rbjax.display import Display, array_text, plural, value_text


def problem_display(problem: Any) -> Display:
    """Return the display of a `Problem`: its sizes, costs, constraints and bounds."""
    dt, system = value_text(problem.dt), problem.system
    steps = f"{plural(problem.horizon, 'step')} of {dt} s"
    title = f"Problem: {steps}, {plural(system.n, 'tangent coordinate')}, "
    title += plural(system.nu, "control")
    rows = [
        (name, f"{x.term.label}, weight {value_text(x.weight)}")
        for name in ("running", "terminal")
        for x in getattr(problem, name)
    ]
    rows += [("constraint", x.name) for x in problem.constraints]
    if problem.bounded:
        rows.append(("bounds", f"{value_text(problem.low)} to {value_text(problem.high)}"))
    if problem.design is not None:
        rows.append(("design", value_text(problem.design.start)))
    if problem.times is not None:
        rows.append(("free time", f"within {array_text(problem.times)} s"))
    if any(problem.free):
        rows.append(("free start", f"{sum(problem.free)} of {len(problem.free)} coordinates"))
    return Display(title, rows)
