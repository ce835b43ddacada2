"""The map of contact laws: each law and step size on scenes built to show its errors.

`python -m benchmarks.maps.contact_map [--only stack,spin]`. A cell is the largest deviation from
the motion of rigid bodies in m. The step is an argument of a program, so each law compiles once for
a scene. "compliant" is a force element (Hunt-Crossley, pressed in by 0.5 mm at rest) with rk4.
Results go to results/, docs/guides/figures/contact-map.png and
docs/guides/figures/contact-work-precision.png.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import NullFormatter

import rbjax as rb
from benchmarks.cases.contact_scenes import SCENES, Scene
from benchmarks.shared.charts import PAGE, save_chart
from benchmarks.shared.timing import RESULTS, save
from rbjax.plotting import INK, STYLE

FIGURES = Path(__file__).parents[2] / "docs" / "guides" / "figures"
NAME = "contact-map"
STEPS = (8e-3, 4e-3, 2e-3, 1e-3, 5e-4)
LAWS = (*rb.contact.laws(), "compliant")
PRESSED = 5e-4  # m
BEST, WORST = -6, -1  # log10 of the errors that the colours tell apart
LOST = "#22303c"
EXACT = 1e-12  # m
LONG = 0.1  # s


def program(scene: Scene, law: str) -> Any:
    """Compile the motion of a scene: (dt, number of steps) -> error, unconverged steps."""
    model, how = scene.model(), {"contact": law}
    if law == "compliant":
        model, how = model.replace(contact=None), {"integrator": "rk4"}
        k = scene.weight / PRESSED**1.5
        model = model.with_forces(
            rb.contact.CompliantContact.of(model, stiffness=k, dissipation=10)
        )
    else:
        how |= {"integrator": "semi_implicit_euler"}
        found = rb.contact.laws()[law](model)
        memory = found.initial_memory(model) if hasattr(found, "initial_memory") else None
    q, v = (jnp.asarray(x, float) for x in scene.start)
    start = rb.State(
        q, v, model.start(q.dtype), None if law == "compliant" else memory, jnp.zeros(2)
    )

    def run(dt: jax.Array, steps: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        def once(i: jax.Array, at: tuple) -> tuple:
            state, worst = at
            state = rb.step(model, state, None, dt, **how)
            error = scene.error((i + 1) * dt, state.q, state.v)
            return state, error if scene.at_end else jnp.maximum(worst, error)

        state, error = jax.lax.fori_loop(0, steps, once, (start, jnp.zeros(())))
        return error, state.report[0], state.q

    return jax.jit(run)


def seconds(run: Callable[[], Any]) -> float:
    """The fastest of some runs, s; of long ones, of two."""
    begin = time.perf_counter()
    run()
    once = time.perf_counter() - begin
    rounds = 1 if once > LONG else 20
    taken = [once, *(timeit.timeit(run, number=1) for _ in range(rounds))]
    return min(taken)


def cells(name: str, law: str) -> list[dict[str, Any]]:
    """All step sizes of a law on a scene."""
    scene = SCENES[name]
    run, rows = program(scene, law), []
    for dt in STEPS:
        steps = round(scene.time / dt)
        error, left, q = (np.asarray(x) for x in run(dt, steps))
        finite = bool(np.isfinite(error) and np.isfinite(q).all() and abs(q).max() < 1e3)
        us = 1e6 * seconds(lambda dt=dt, n=steps: jax.block_until_ready(run(dt, n))) / scene.time
        rows.append({
            "scene": name, "law": law, "dt": dt, "error": float(error) if finite else None,
            "unconverged": int(left), "us_per_second": us,
        })  # fmt: skip
    return rows


def text(row: dict[str, Any]) -> str:
    if row["error"] is None:
        return "X"
    size = f"{np.log10(row['error']):.1f}" if row["error"] > EXACT else "< -12"
    return size + ("*" if row["unconverged"] else "")


def draw_map(found: dict[tuple, dict[str, Any]], path: Path) -> None:
    colours, scale = plt.get_cmap("YlGn_r"), Normalize(BEST, WORST + 1)
    lines = [(law, dt) for law in LAWS for dt in STEPS]
    with plt.rc_context(STYLE):
        figure, axis = plt.subplots(figsize=(8.6, 7.4), layout="constrained")
        for y, (law, dt) in enumerate(lines):
            if y and y % len(STEPS) == 0:
                axis.axhline(y - 0.5, color=INK, lw=1.2, zorder=3)
            for x, name in enumerate(SCENES):
                row = found[name, law, dt]
                fill, ink = LOST, "white"
                if row["error"] is not None:
                    fill = colours(scale(np.log10(max(row["error"], 1e-16))))
                    ink = "white" if np.mean(fill[:3]) < 0.45 else INK
                axis.add_patch(
                    Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=fill, edgecolor="white", lw=0.8)
                )
                axis.text(x, y, text(row), ha="center", va="center", fontsize=9, color=ink)
        axis.set(xlim=(-0.5, len(SCENES) - 0.5), ylim=(len(lines) - 0.5, -0.5))
        axis.xaxis.tick_top()
        axis.set_xticks(range(len(SCENES)), [s.title for s in SCENES.values()], rotation=25,
                        ha="left", fontsize=9)  # fmt: skip
        axis.set_yticks(
            range(len(lines)), [f"{law}  {1e3 * dt:g} ms" for law, dt in lines], fontsize=9
        )
        axis.tick_params(length=0)
        axis.grid(False)
        for side in axis.spines.values():
            side.set_visible(False)
        handles = [
            Patch(facecolor=colours(scale(p)), label=f"1e{p} m") for p in (-6, -4, -3, -2, -1)
        ]
        handles.append(Patch(facecolor=LOST, label="X  not finite, or away"))
        figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=8.5)
        figure.suptitle(
            "Contact laws: log10 of the largest error [m]; * steps of the solver did not converge",
            x=0.01, ha="left", fontweight="bold", fontsize=11,
        )  # fmt: skip
        save_chart(figure, path)


def draw_work(found: dict[tuple, dict[str, Any]], path: Path) -> None:
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(3, 2, figsize=(PAGE, 8.4), layout="constrained", sharey=True)
        for axis, (name, scene) in zip(axes.flat, SCENES.items(), strict=True):
            for law, mark in zip(LAWS, "osD^", strict=True):
                rows = [found[name, law, dt] for dt in STEPS]
                rows = [r for r in rows if r["error"] is not None]
                times = [r["us_per_second"] for r in rows]
                errors = [max(r["error"], 1e-9) for r in rows]
                axis.plot(times, errors, marker=mark, ms=4, label=law)
            axis.set(xscale="log", yscale="log", title=scene.title, ylim=(5e-10, 3))
            axis.xaxis.set_minor_formatter(NullFormatter())
            if axis.get_xlim()[1] < 1e4:
                axis.set_xlim(90, 1.1e4)
        for axis in axes[-1]:
            axis.set_xlabel("computing time [µs per second of motion]")
        for axis in axes[:, 0]:
            axis.set_ylabel("largest error [m]")
        figure.legend(
            *axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=4
        )
        save_chart(figure, path)


def last_rows() -> list[dict[str, Any]]:
    paths = sorted(RESULTS.glob(f"{NAME}-*.json"))
    return [row for path in paths for row in json.loads(path.read_text())["rows"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="names of scenes, by commas")
    parser.add_argument("--draw", action="store_true", help="only draw the saved results again")
    given = parser.parse_args()
    names = [name for name in given.only.split(",") if name] or list(SCENES)
    if unknown := set(names) - SCENES.keys():
        parser.error(f"no such scene: {', '.join(sorted(unknown))}; there are {', '.join(SCENES)}")
    found = {(r["scene"], r["law"], r["dt"]): r for r in last_rows()}
    for name in [] if given.draw else names:
        for law in LAWS:
            rows = cells(name, law)
            found |= {(r["scene"], r["law"], r["dt"]): r for r in rows}
            print(f"{name:12s}{law:10s}", *(text(row) for row in rows), flush=True)
    keys = [(name, law, dt) for name in SCENES for law in LAWS for dt in STEPS]
    if not given.draw:
        save(NAME, [found[key] for key in keys if key in found])
    if all(key in found for key in keys):
        draw_map(found, FIGURES / "contact-map.png")
        draw_work(found, FIGURES / "contact-work-precision.png")


if __name__ == "__main__":
    main()
