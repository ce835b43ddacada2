"""The picture of `wheel_contact`: how far contact is from rolling, a column for each robot.

`python -m benchmarks.accuracy.wheel_contact_chart` draws it again from the results.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.shared.charts import PAGE, save_chart, saved
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, PURPLE, RED, STYLE, TEAL

PICTURE = Path(__file__).parents[2] / "docs" / "guides" / "figures" / "wheel_contact.png"
CONTACTS = {0.01: (TEAL, "v"), 1.0: (BLUE, "s"), 100.0: (PURPLE, "^")}  # impratio -> looks
STEPS = {  # sweep, integrator -> label, looks
    ("dt, T = 20 ms", "implicitfast"): ("MuJoCo implicitfast, T = 20 ms", TEAL, "v", "--"),
    ("dt, T = 20 ms", "RK4"): ("MuJoCo RK4, T = 20 ms", BLUE, "s", "--"),
    ("dt, T = 2.5 dt", "implicitfast"): ("MuJoCo implicitfast, T = 2.5 dt", TEAL, "v", "-"),
    ("dt, T = 2.5 dt", "RK4"): ("MuJoCo RK4, T = 2.5 dt", BLUE, "s", "-"),
    ("dt", "semi_implicit_euler"): ("rbjax rolling, semi-implicit Euler", RED, "D", "-"),
    ("dt", "rk4"): ("rbjax rolling, RK4", GREEN, "o", "-"),
}
SLIPS = "rbjax slipping"


def draw(rows: list[dict[str, Any]], path: Path = PICTURE) -> Path:
    """A column a robot; rows of panels: friction, stiffness, sliding speed, timestep."""
    robots = {row["robot"]: row["title"] for row in rows if row["sweep"] == "reference"}
    with plt.rc_context(STYLE | {"font.size": 9, "axes.titlesize": 10}):
        figure = plt.figure(figsize=(PAGE, 15.5), layout="constrained")
        parts = figure.subfigures(4, 1, height_ratios=[1, 1.2, 1.05, 1.15])
        panels = [part.subplots(1, len(robots), squeeze=False, sharey=True)[0] for part in parts]
        for k, (name, title) in enumerate(robots.items()):
            mine = [row for row in rows if row["robot"] == name]
            about = next(row for row in mine if row["sweep"] == "reference")
            friction(panels[0][k], mine, about)
            stiffness(panels[1][k], mine)
            sliding(panels[2][k], mine)
            timestep(panels[3][k], mine, about)
            panels[0][k].set_title(f"{title}: {about['way']:.0f} m in 4 s")
        for part, row in zip(parts, panels, strict=True):
            row[0].set_ylabel("distance from rolling [m]")
            handles, labels = row[0].get_legend_handles_labels()
            part.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
        figure.suptitle(f"Contact becomes rolling (f64){of_mjx(rows)}", x=0.01, ha="left")
        save_chart(figure, path)
    return path


def points(rows: list[dict[str, Any]], x: Any, **given: Any) -> tuple[list, list]:
    """x(row) and the distance, of rows that have these values and did not fail."""
    some = [r for r in rows if r.get("distance") and all(r.get(k) == v for k, v in given.items())]
    return [x(r) for r in some], [r["distance"] for r in some]


def line(
    axis: Any, at: tuple[list, list], label: str, colour: str, marker: str, way: str = "-"
) -> None:
    axis.loglog(*at, color=colour, marker=marker, ls=way, ms=4, lw=1.2, label=label)


def of_mjx(rows: list[dict[str, Any]]) -> str:
    """How far MJX is from MuJoCo C at its points, sticking and sliding."""
    gaps = {
        name: [r["from_mujoco"] for r in rows if r["sweep"] == "MJX" and (r["friction"] < 0.1) == x]
        for name, x in (("wheels stick", False), ("wheels slide", True))
    }
    said = [f"{max(x):.0e} m where {name}" for name, x in gaps.items() if x]
    return f"\nMJX ends within {', '.join(said)}, of MuJoCo C" if said else ""


def orders(axis: Any, at: tuple[list, list]) -> None:
    """The order in T of the first and of the last two steps of a line."""
    x, y = np.log(at[0]), np.log(at[1])
    for k in (1, len(x) - 2):
        order = -2 * (y[k + 1] - y[k - 1]) / (x[k + 1] - x[k - 1])
        place = (4, 5) if order > 1.5 else (-8, -14)
        axis.annotate(f"T$^{{{order:.1f}}}$", (at[0][k], at[1][k]), place, fontsize=9,
                      textcoords="offset points")  # fmt: skip


def friction(axis: Any, rows: list[dict[str, Any]], about: dict[str, Any]) -> None:
    for engine, colour, marker, label in (
        ("MuJoCo C", PURPLE, "^", "MuJoCo C, T = 2 ms, impratio 100"),
        (SLIPS, ORANGE, "o", "rbjax slipping, C = 1000"),
    ):
        at = points(rows, lambda r: r["friction"], sweep="friction", engine=engine)
        line(axis, at, label, colour, marker)
    axis.axvline(about["demand"], color=INK, lw=0.8, ls="--")
    axis.text(about["demand"], 0.98, " rolling takes this", fontsize=7.5, va="top",
              transform=axis.get_xaxis_transform())  # fmt: skip
    axis.set_xlabel("friction coefficient")


def stiffness(axis: Any, rows: list[dict[str, Any]]) -> None:
    for ratio, (colour, marker) in CONTACTS.items():
        at = points(rows, lambda r: r["time_constant"] ** -2, sweep="stiffness", impratio=ratio)
        line(axis, at, f"MuJoCo C, impratio {ratio:g}", colour, marker)
        if ratio == max(CONTACTS):
            orders(axis, at)
    axis.set_xlabel("contact stiffness 1 / T² [1/s²]")
    top = axis.twiny()
    top.grid(False)
    at = points(rows, lambda r: r["tyre"], sweep="stiffness", engine=SLIPS)
    line(top, at, "", ORANGE, "o")
    axis.plot([], [], color=ORANGE, marker="o", ms=4, lw=1.2, label="rbjax slipping (top scale)")
    top.tick_params(axis="x", colors=ORANGE, labelsize=8)
    top.set_xlabel("slip stiffness of tyres C", color=ORANGE, fontsize=8)


def sliding(axis: Any, rows: list[dict[str, Any]]) -> None:
    for ratio, (colour, marker) in CONTACTS.items():
        at = points(rows, lambda r: r["sliding"], sweep="stiffness", impratio=ratio)
        line(axis, at, f"MuJoCo C, impratio {ratio:g}", colour, marker)
    at = points(rows, lambda r: r["sliding"], sweep="stiffness", engine=SLIPS)
    line(axis, at, "rbjax slipping", ORANGE, "o")
    axis.set_xlabel("sliding speed of contacts, rms [m/s]")


def timestep(axis: Any, rows: list[dict[str, Any]], about: dict[str, Any]) -> None:
    for (sweep, integrator), (label, colour, marker, way) in STEPS.items():
        at = points(rows, lambda r: 1e3 * r["dt"], sweep=sweep, integrator=integrator)
        line(axis, at, label, colour, marker, way)
    axis.axhline(max(about["bound"], 1e-13), color=INK, lw=0.8, ls="--",
                 label="bound of the reference's error")  # fmt: skip
    axis.set_xlabel("timestep [ms]")


if __name__ == "__main__":
    print(draw(saved("wheel-contact-*.json")))
