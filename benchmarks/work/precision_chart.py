"""Tables and pictures of the speed-accuracy benchmarks.

`python -m benchmarks.work.precision_chart [folders]` reads work-*.json from benchmarks/results (and
other folders) and writes docs/benchmarks/work-precision.md with
docs/benchmarks/figures/work-precision-<what>.png.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import rbjax as rb
from benchmarks.shared.charts import PAGE, save_chart
from benchmarks.shared.timing import RESULTS, markdown_table
from benchmarks.work.lines import CPU, DOCS, FIGURES, GPU, WANTED, Rows, at, lines, read, visible
from benchmarks.work.scenes import SCENES
from benchmarks.work.solvers_chart import gaps, solver_pictures, solver_tables
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, PURPLE, RED, STYLE, TEAL


def table(rows: Rows) -> Rows:
    """The fastest method of MJX and rbjax for an error of 1e-6, a row for a scene and platform."""
    out = []
    for scene in SCENES:
        for platform in (CPU, GPU):
            best: dict[str, Any] = {}
            for key, (_, error, us, _) in lines(rows, scene, platform).items():
                engine = "rbjax" if key[0] == "simulate" else key[0]
                cost, further = at(error, us)
                name = f"{key[1]} {key[2]}" + (", prolonged" if further else "")
                if cost < best.get(engine, (np.inf,))[0]:
                    best[engine] = cost, name
            row: dict[str, Any] = {"scene": SCENES[scene].title, "on": platform}
            for engine in ("mjx", "mujoco", "rbjax"):
                if engine in best:
                    row[engine] = "{:.3g} us ({})".format(*best[engine])
            for engine in ("mjx", "mujoco"):
                if engine in best and "rbjax" in best:
                    row[f"{engine}/rbjax"] = best[engine][0] / best["rbjax"][0]
            out.append(row)
    return out


LOOK = {
    ("rbjax", "dopri8"): (INK, "D", "-", "rbjax Dopri8"),
    ("rbjax", "dop853"): (INK, "d", "--", "rbjax DOP853"),
    ("rbjax", "tsit5"): (PURPLE, "^", "-", "rbjax Tsit5"),
    ("rbjax", "rk4"): (BLUE, "s", "-", "rbjax RK4"),
    ("rbjax", "semi_implicit_euler"): (TEAL, "o", "-", "rbjax semi-implicit Euler"),
    ("mjx", "RK4"): (RED, "s", "--", "MJX RK4"),
    ("mjx", "implicitfast"): (ORANGE, "v", "--", "MJX implicitfast"),
    ("mjx", "Euler"): (ORANGE, "o", "--", "MJX Euler"),
    ("mujoco", "RK4"): (GREEN, "s", ":", "MuJoCo C RK4"),
    ("mujoco", "implicitfast"): (GREEN, "v", ":", "MuJoCo C implicitfast"),
    ("mujoco", "implicit"): (GREEN, "x", ":", "MuJoCo C implicit"),
    ("mujoco", "Euler"): (GREEN, "o", ":", "MuJoCo C Euler"),
}
OTHERS = (INK, PURPLE, BLUE, TEAL, RED, ORANGE, GREEN)


def picture(rows: Rows, platform: str, name: str, cost: int, scenes: tuple[str, ...]) -> None:
    """A grid of scenes; cost is 2 for time, 3 for force evaluations."""
    columns = min(2, len(scenes))
    high = -(-len(scenes) // columns)
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            high, columns, figsize=(PAGE, 2.9 * high + 1.6), layout="constrained",
            squeeze=False, sharey=True,
        )  # fmt: skip
        shown: dict[str, Any] = {}
        for ax, scene in zip(axes.flat, scenes, strict=False):
            for key, line in lines(rows, scene, platform).items():
                if key[:2] not in LOOK:
                    continue
                color, marker, style, label = LOOK[key[:2]]
                error = visible(line[1])
                faint = key[2] == "f32"
                (drawn,) = ax.loglog(
                    line[cost], error, color=color, marker=marker, ls=style, ms=3, lw=1.3,
                    alpha=0.35 if faint else 1.0,
                )  # fmt: skip
                shown.setdefault(label + (", f32" if faint else ""), drawn)
            ax.axhline(WANTED, color=INK, lw=0.7, alpha=0.5)
            ax.set(title=SCENES[scene].title, ylim=(1e-12, 2))
        for ax in axes.flat[len(scenes) :]:
            ax.set_visible(False)
        what = "us per robot and simulated second" if cost == 2 else "force evaluations a second"
        for ax in axes[-1]:
            ax.set_xlabel(what)
        for ax in axes[:, 0]:
            ax.set_ylabel("error")
        if cost == 2:
            figure.suptitle(f"Error of the final state against computing time, {platform}")
        order = [label for *_, label in LOOK.values()]
        labels = sorted(shown, key=lambda s: (order.index(s.removesuffix(", f32")), "f32" in s))
        handles = [shown[label] for label in labels]
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        save_chart(figure, FIGURES / f"work-precision-{name}.png")


def stiffness(rows: Rows) -> None:
    """Time for an error of 1e-4 by the stiffness of the springs."""
    by_method: dict[str, Rows] = defaultdict(list)
    for row in rows:
        if row["what"] == "stiff" and "us" in row:
            by_method[row["method"]].append(row)
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(PAGE, 4.2), layout="constrained")
        for n, (method, points) in enumerate(by_method.items()):
            style = "--" if points[0]["implicit"] else "-"
            k = [p["stiffness"] for p in points]
            for ax, what in ((left, "us"), (right, "steps")):
                ax.loglog(k, [p[what] for p in points], ls=style, marker="o", ms=3,
                          color=OTHERS[n % 7], label=method)  # fmt: skip
        left.set(title="Time for an error of 1e-4", ylabel="us per robot and simulated second")
        right.set(title="Steps for it", ylabel="steps a second")
        for ax in (left, right):
            ax.set_xlabel("stiffness of the springs [N m/rad]")
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        save_chart(figure, FIGURES / "work-precision-stiffness.png")


def crossover(rows: Rows) -> str:
    """A sentence: the stiffness above which an implicit method is faster than any explicit one."""
    best: dict[bool, dict[float, Any]] = {False: {}, True: {}}
    for row in rows:
        if row["what"] == "stiff" and "us" in row:
            by_k = best[row["implicit"]]
            if row["us"] < by_k.get(row["stiffness"], {"us": np.inf})["us"]:
                by_k[row["stiffness"]] = row
    both = sorted(best[False].keys() & best[True].keys())
    ratio = np.log([best[False][k]["us"] / best[True][k]["us"] for k in both])
    at_k = np.exp(np.interp(0.0, ratio, np.log(both)))
    there = [r for r in rows if r["what"] == "stiff" and "us" in r]
    methods = {r["method"] for r in there}
    last = max(k for k in both if methods == {r["method"] for r in there if r["stiffness"] == k})
    there = [r for r in there if r["stiffness"] == last]
    fewest = min(r["steps"] for r in there if not r["implicit"])
    explicit, implicit = best[False][last], best[True][last]
    return (
        f"An implicit method takes less time from {at_k:.0f} N m/rad on. At {last:,.0f} the best "
        f"explicit methods take {fewest:,} steps (in time {explicit['method']}, "
        f"{explicit['us']:,.0f} us), {implicit['method']} {implicit['steps']} "
        f"({implicit['us']:,.0f} us)."
    )


TEXT = """# Speed against accuracy

Microseconds of computing per robot and simulated second for an error of {wanted:g}, each engine at
its fastest batch, precision and integrator; one core of the CPU, and the H200. The scenes, the
distance of two states and the references (closed forms or runs whose own error is bounded below
1e-11) are in `benchmarks/work/scenes.py`; `make bench-work-precision` measures and draws.

{table}

![H200](figures/work-precision-h200.png)
![CPU](figures/work-precision-cpu.png)
![Force evaluations](figures/work-precision-evaluations.png)

- Every engine runs the same MjModel with only smooth dynamics; contacts, limits, friction are off.
  Contacts have their own map and chart in
  [contacts.md](../guides/contacts.md#errors-by-law-and-step).
- MJX: steps for the error times its fastest step. Its errors are measured on a small batch on a
  CPU; on attitudes its RK4 is of second order, where MuJoCo C's and ours are of fourth. On the
  chain of hinges, where both are one method, the errors are MuJoCo C's. In f32 MJX ends above 1e-6
  but on the pendulum (1.1e-6 on the humanoid; on the chain it was not run that far).
- On the CPU MJX and rbjax run with whichever of the compiler's options make each fastest on a
  scene. MJX: without XLA's fusion emitters. rbjax: `rb.compiler_options()`, or only their wide
  vectors; without options it takes {options} ("options" in the data).
- CPU: AMD EPYC, jax 0.10, one machine for all engines. Errors of MJX are from several machines.
- "prolonged": the last points did not reach the error, and the line goes on with their slope.

## Solvers of `rb.solvers` through `simulate`

The {count}<!-- = count.solvers --> solvers of rbjax, and diffrax' Tsit5 and Dopri8, with constant
steps: the fastest of each family to an error of {wanted:g}, in microseconds per robot and simulated
second. In brackets: none reaches that, and this is for 1e-4; "-": nor that. "~": the line ends
above it, by less than ten times, and is prolonged (f64).

{solvers}

![One core, f64](figures/work-precision-solvers-cpu-f64.png)
![One core, f32](figures/work-precision-solvers-cpu-f32.png)
![H200, f64](figures/work-precision-solvers-h200-f64.png)
![H200, f32](figures/work-precision-solvers-h200-f32.png)
![Force evaluations](figures/work-precision-solvers-evaluations.png)

- Thin: every solver; bold and named, the fastest first: the best of its family to {wanted:g} (f32:
  to 1e-4).
- Batches: CPU 128 (humanoid, chain 32), H200 16,384 (arm, chain 4,096, humanoid 2,048). The cores
  of the CPU were all busy, one solver each: times compare with each other, less with those above.
- On the CPU explicit solvers run on the unrolled driver, implicit ones on "auto".
- Evaluations are counted for one robot: each stage one, a Jacobian one, dense output's too.
- `rigid_body_splitting` takes single rigid bodies: the free body and the top.
{gaps}

## Stiffness

A hanging rod of six links, its springs ever stiffer, their dampers with them; error 1e-4 after 1 s.
{crossover}

![Stiffness](figures/work-precision-stiffness.png)
"""


def without_options(rows: Rows) -> str:
    """How many times as long ours takes under the compiler's default options."""
    times = [r["seconds"] for r in rows if (r["what"], r.get("engine")) == ("options", "rbjax")]
    ratios = [seconds["none"] / min(seconds.values()) for seconds in times]
    return f"{min(ratios):.2f} to {max(ratios):.2f} times as long" if ratios else "longer"


def main() -> None:
    rows, stiff = read([RESULTS, *map(Path, sys.argv[1:])])
    columns = ("scene", "on", "mjx", "mujoco", "rbjax", "mjx/rbjax", "mujoco/rbjax")
    found = markdown_table(table(rows), columns)
    scenes = tuple(SCENES)
    picture(rows, GPU, "h200", 2, scenes)
    picture(rows, CPU, "cpu", 2, scenes)
    picture(rows, CPU, "evaluations", 3, scenes)
    solver_pictures(rows)
    stiffness(stiff)
    text = TEXT.format(
        wanted=WANTED, table=found, crossover=crossover(stiff), solvers=solver_tables(rows),
        gaps=gaps(rows), count=len(rb.solvers.all()), options=without_options(rows),
    )  # fmt: skip
    (DOCS / "work-precision.md").write_text(text)
    print(found, crossover(stiff), sep="\n")


if __name__ == "__main__":
    main()
