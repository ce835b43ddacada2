"""Pictures and tables of all solvers through `simulate`, by family, for `precision_chart`."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

from benchmarks.shared.charts import PAGE, save_chart
from benchmarks.shared.timing import markdown_table
from benchmarks.work.lines import CPU, FIGURES, GPU, WANTED, Rows, at, lines, visible
from benchmarks.work.scenes import SCENES
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, PURPLE, RED, STYLE, TEAL

#: family -> colour and the beginnings of its solvers' names
FAMILIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "explicit RK": (BLUE, ("euler", "heun", "rk4", "diffrax")),
    "implicit RK": (RED, ("implicit_midpoint", "trapezoid", "gauss", "lobatto", "radau")),
    "SDIRK, Rosenbrock": (ORANGE, ("sdirk", "kvaerno", "ros2", "ros34")),
    "multistep": (GREEN, ("adams", "pece", "bdf")),
    "second order": (
        TEAL, ("newmark", "hht", "generalized_alpha", "central_differences", "semi_implicit"),
    ),
    "geometric": (INK, ("symplectic", "stoermer", "yoshida", "variational")),
    "Lie group": (PURPLE, ("rkmk", "crouch", "commutator", "lie_", "rigid_body")),
}  # fmt: skip
TIME, EVALUATIONS = 2, 3  # columns of a line
COARSE = 1e-4  # the error that f32 reaches


def family(method: str) -> str:
    return next(name for name, (_, starts) in FAMILIES.items() if method.startswith(starts))


def by_family(
    rows: Rows, scene: str, platform: str, precision: str
) -> dict[str, list[tuple[str, Any]]]:
    """family -> (method, line) of each of its solvers."""
    out: dict[str, list[tuple[str, Any]]] = {name: [] for name in FAMILIES}
    for (engine, method, kind), line in lines(rows, scene, platform).items():
        if engine == "simulate" and kind == precision:
            out[family(method)].append((method, line))
    return out


def cost_of(line: Any, column: int, wanted: float, precision: str) -> tuple[float, bool]:
    """The cost of an error, and whether the line was extrapolated to it, which happens only in f64
    and over less than a decade."""
    cost, further = at(line[1], line[column], wanted)
    if further and (precision == "f32" or np.nanmin(line[1]) > 10 * wanted):
        return np.inf, False
    return cost, further


def best(methods: list[tuple[str, Any]], column: int, wanted: float, precision: str) -> Any:
    """(cost, extrapolated, method, line) of the cheapest, if any reaches the error."""
    costs = [(*cost_of(line, column, wanted, precision), name, line) for name, line in methods]
    costs = [c for c in costs if np.isfinite(c[0])]
    return min(costs, key=lambda c: c[0]) if costs else None


def picture(rows: Rows, platform: str, precision: str, column: int, name: str) -> None:
    """A panel for each scene; the best of each family is bold and named, the cheapest first."""
    wanted = WANTED if precision == "f64" else COARSE
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(4, 2, figsize=(PAGE, 15), layout="constrained", sharey=True)
        for ax, scene in zip(axes.flat, SCENES, strict=True):
            winners = []
            for kind, methods in by_family(rows, scene, platform, precision).items():
                color = FAMILIES[kind][0]
                first = best(methods, column, wanted, precision)
                for _, line in methods:
                    ax.loglog(line[column], visible(line[1]), color=color, lw=0.7, alpha=0.45)
                if first:
                    cost, _, method, line = first
                    (drawn,) = ax.loglog(
                        line[column], visible(line[1]), color=color, lw=2, marker="o", ms=3
                    )
                    winners.append((cost, drawn, method))
            ax.axhline(wanted, color=INK, lw=0.7, alpha=0.5)
            ax.set_xscale("log")
            ax.xaxis.set_minor_formatter(NullFormatter())
            ax.set(title=SCENES[scene].title, ylim=(1e-12 if precision == "f64" else 1e-8, 2))
            winners.sort(key=lambda w: w[0])
            ax.legend([w[1] for w in winners], [w[2] for w in winners], loc="best",
                      fontsize=8, handlelength=1.2, labelspacing=0.25, frameon=True,
                      framealpha=0.8, edgecolor="none")  # fmt: skip
        of_time = column == TIME
        for ax in axes[-1]:
            ax.set_xlabel(
                "us per robot and simulated second" if of_time else "force evaluations a second"
            )
        for ax in axes[:, 0]:
            ax.set_ylabel("error")
        against = f"computing time, {platform}" if of_time else "force evaluations"
        figure.suptitle(f"Solvers through simulate: error against {against}, {precision}")
        handles = [plt.Line2D([], [], color=color, lw=2) for color, _ in FAMILIES.values()]
        figure.legend(handles, list(FAMILIES), loc="outside lower center", ncols=4)
        save_chart(figure, FIGURES / f"work-precision-solvers-{name}.png")


def solver_pictures(rows: Rows) -> None:
    """Time on both platforms in both precisions, and evaluations."""
    for platform, short in ((CPU, "cpu"), (GPU, "h200")):
        for precision in ("f64", "f32"):
            picture(rows, platform, precision, TIME, f"{short}-{precision}")
    picture(rows, CPU, "f64", EVALUATIONS, "evaluations")


def solver_tables(rows: Rows) -> str:
    """The fastest of each family for an error of 1e-6 (in brackets: 1e-4), a table for each
    platform and precision."""
    out = []
    for platform in (CPU, GPU):
        for precision in ("f64", "f32"):
            table = []
            for scene in SCENES:
                row: dict[str, Any] = {"scene": SCENES[scene].title}
                for kind, methods in by_family(rows, scene, platform, precision).items():
                    if first := best(methods, TIME, WANTED, precision):
                        cost, further, method, _ = first
                        row[kind] = f"{'~' * further}{cost:.3g} {method}"
                    elif first := best(methods, TIME, COARSE, precision):
                        row[kind] = f"({first[0]:.3g} {first[2]})"
                table.append(row)
            out += [
                f"{platform}, {precision}:",
                "",
                markdown_table(table, ["scene", *FAMILIES]),
                "",
            ]
    return "\n".join(out).rstrip()


def gaps(rows: Rows) -> str:
    """The tasks left out or failed, a line for each platform, scene and precision."""
    done: dict[tuple, list[str]] = defaultdict(list)
    missed: dict[tuple, list[str]] = defaultdict(list)
    for row in rows:
        if row.get("engine") == "simulate":
            of = row["platform"], row["scene"], row["precision"]
            if row["what"] == "done":
                done[of].append(row["method"])
            elif row["what"] in ("left out", "failed"):
                missed[of].append(row["method"])
    out = []
    for of, methods in sorted(missed.items()):
        which = f"all but {', '.join(done[of])}" if len(methods) > len(done[of]) else ""
        out.append(f"- Left out for time: {' '.join(of)}: {which or ', '.join(methods)}.")
    return "\n".join(out) or "- None was left out."
