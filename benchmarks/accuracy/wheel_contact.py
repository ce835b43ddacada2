"""Rolling as the limit of contact: MuJoCo's wheels, and our slipping tyres, against our rolling.

`python -m benchmarks.accuracy.wheel_contact [ROBOT ...] [--small] [--parts sweeps mjx laws]`

A manoeuvre of 4 s is run with wheels that roll (`wheeled.at(robot, "reduced")`, adaptive,
1e-12); as a file of `wheeled.write_mjcf` in MuJoCo C, with other friction, stiffness (1 / T^2 of
solref), impratio and timestep; at some points in MJX; under rbjax's contact laws, with other shapes
of wheels (the differential drive); and at our fidelity "slipping", with other
friction and stiffness of tyres. A distance is the largest of the chassis' origin on the way. All in
f64; times are of one core, and rough where others use the machine. Results go to
results/wheel-contact-<device>.json and docs/guides/figures/wheel_contact.png; a run of some robots
or parts keeps the others.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # isort: skip  # noqa: F401

import argparse
import os
from collections.abc import Iterator
from typing import Any

import jax
import mujoco
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import rbjax as rb
from benchmarks.accuracy.wheel_contact_chart import draw
from benchmarks.accuracy.wheel_runs import (
    SECONDS,
    Manoeuvre,
    Rolling,
    Run,
    Slipping,
    Touching,
    manoeuvres,
    mjx_poses,
    touching_law,
)
from benchmarks.shared.timing import others, save

NAME, PARTS = "wheel-contact", ("sweeps", "mjx", "laws")
FRICTIONS = np.geomspace(0.02, 2.0, 13)
TIME_CONSTANTS = (0.04, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)
IMPRATIOS = (0.01, 1.0, 100.0)
TYRES, FIRM = np.geomspace(3.0, 3e4, 9), 1000.0  # slip stiffness; FIRM where friction varies
TIMESTEPS = (0.01, 0.005, 0.002, 0.001, 0.0005, 0.0002)
STIFF = {"time_constant": 0.002, "impratio": 100.0}
PER_TIME_CONSTANT = 4  # steps of RK4: a contact's fastest rate is 2 / T
MJX_DT = 0.001
#: wheels of geoms under the laws of rbjax: robots; shape, width / radius; steps
OF_GEOMS = ("differential_drive",)
SHAPES = (("ellipsoid", 0.25), ("capsule", 0.01))
LAW_STEPS = (0.002, 0.001)
MJX_POINTS = ((0.02, 1.0, 10.0), (0.02, 0.05, 10.0), (0.005, 1.0, 1.0), (0.005, 1.0, 100.0))


def sweeps(
    rolling: Rolling, slipping: Slipping, small: bool
) -> Iterator[tuple[dict[str, Any], Run | None]]:
    """What is run, and its motion."""
    touching, few = Touching(rolling), slice(None, None, 4 if small else 1)

    def contact(
        sweep: str, time_constant: float, impratio: float, dt: float | None = None,
        integrator: str = "RK4", friction: float = 1.0, clocked: int = 1,
    ) -> tuple[dict[str, Any], Run]:  # fmt: skip
        dt = min(0.001, time_constant / PER_TIME_CONSTANT) if dt is None else dt
        given = {"impratio": impratio, "integrator": integrator, "friction": friction}
        m = touching.model(time_constant, dt, **given)
        row = {"engine": "MuJoCo C", "sweep": sweep, "dt": dt, "time_constant": time_constant}
        return row | given, touching(m, clocked)

    for friction in FRICTIONS[few]:
        yield contact("friction", **STIFF, friction=friction)
        row = {"engine": "rbjax slipping", "sweep": "friction", "friction": friction}
        yield row | {"tyre": FIRM}, slipping(FIRM, friction)
    for impratio in IMPRATIOS[few]:
        for time_constant in TIME_CONSTANTS[few]:
            yield contact("stiffness", time_constant, impratio)
    for tyre in TYRES[few]:
        row = {"engine": "rbjax slipping", "sweep": "stiffness", "tyre": tyre, "friction": 1.0}
        yield row, slipping(tyre, 1.0)
    for dt in TIMESTEPS[few]:
        for integrator in ("implicitfast", "RK4"):
            for sweep, time_constant in (("dt, T = 20 ms", 0.02), ("dt, T = 2.5 dt", 2.5 * dt)):
                if time_constant >= 2 * dt:
                    yield contact(sweep, time_constant, 100.0, dt, integrator, clocked=5)
    for method in ("rk4", "semi_implicit_euler"):
        for dt in (0.02, *TIMESTEPS)[few]:
            row = {"engine": "rbjax rolling", "sweep": "dt", "dt": dt, "integrator": method}
            yield row, rolling.steps(dt, method)


def sweep_rows(name: str, of: Manoeuvre, small: bool) -> list[dict[str, Any]]:
    rolling, slipping = Rolling(of), Slipping(of)
    about = {"robot": name, "title": of.title}
    found = [
        about | {"sweep": "reference", "bound": rolling.bound, "way": rolling.way(),
                 "demand": rolling.demand(), "load": os.getloadavg()[0]}
    ]  # fmt: skip
    for row, run in track(sweeps(rolling, slipping, small), total=None, description=name):
        found.append(about | row | measured(rolling, run))
    return found


def measured(rolling: Rolling, run: Run | None) -> dict[str, Any]:
    if run is None or not np.isfinite(run.poses).all():
        return {"distance": None}
    off = run.poses - rolling.poses
    return {"distance": float(np.hypot(*off[:, :2].T).max()),
            "turned": float(np.abs(off[:, 2]).max()),
            "sliding": run.sliding, "seconds": run.seconds}  # fmt: skip


def mjx_rows(name: str, of: Manoeuvre, small: bool) -> list[dict[str, Any]]:
    """MJX against MuJoCo C with the same numbers, at the end, and against rolling."""
    points = MJX_POINTS[:1] if small else MJX_POINTS
    rolling = Rolling(of)
    touching, found = Touching(rolling), []
    models = [
        touching.model(T, MJX_DT, friction=mu, impratio=ratio, integrator="implicitfast")
        for T, mu, ratio in points
    ]
    ends, times = mjx_poses(touching, models)
    for m, point, q in zip(models, points, ends, strict=True):
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:] = touching.settled(m), touching.v
        for u in of.controls((np.arange(round(SECONDS / MJX_DT)) + 0.5) * MJX_DT, np):
            d.ctrl[:] = u
            mujoco.mj_step(m, d)
        row = {"robot": name, "title": of.title, "engine": "MJX", "sweep": "MJX", "dt": MJX_DT}
        row |= dict(zip(("time_constant", "friction", "impratio"), point, strict=True))
        apart = float(np.abs(q - d.qpos).max())
        distance = float(np.hypot(*(q[:2] - rolling.poses[-1, :2])))
        found.append(row | {"from_mujoco": apart, "at_the_end": distance} | times)
    return found


def law_rows(name: str, of: Manoeuvre, small: bool) -> list[dict[str, Any]]:
    """The contact laws of rbjax, for wheels of several shapes and two steps."""
    if name not in OF_GEOMS:
        return []
    rolling, found = Rolling(of), []
    for law in rb.contact.laws():
        for shape, width in SHAPES[:1] if small else SHAPES:
            for dt in LAW_STEPS[:1] if small else LAW_STEPS:
                row = {"robot": name, "title": of.title, "engine": f"rbjax {law}", "sweep": "laws",
                       "dt": dt, "shape": shape, "width": width}  # fmt: skip
                run = touching_law(rolling, law, shape, width, dt)
                found.append(row | measured(rolling, run))
    return found


def slope(x: list[float], y: list[float]) -> float:
    """Of log y by log x, of a line through the points."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def table(rows: list[dict[str, Any]]) -> Table:
    """Each sweep's best, and the slope of its stiffer half."""
    out = Table(title="Distance from rolling, m, at the stiffest; order by its last four points")
    for column in ("robot", "engine", "sweep", "lines of", "distance", "order", "us/s of motion"):
        out.add_column(column)
    lines: dict[tuple, list[dict[str, Any]]] = {}
    for row in rows:
        if row.get("distance") and row["sweep"] != "laws":
            which = row.get("impratio") if row["sweep"] == "stiffness" else row.get("integrator")
            lines.setdefault((row["title"], row["engine"], row["sweep"], which), []).append(row)
    for key, line in lines.items():
        x = next(k for k in AXES[key[2].split(",")[0]] if k in line[0])
        tail = sorted(line, key=lambda r: r["distance"])[:4]
        order = slope([r[x] for r in tail], [r["distance"] for r in tail]) if len(tail) > 1 else 0
        best = tail[0]
        out.add_row(*map(str, key), f"{best['distance']:.1e}", f"{order:.2f} in {x}",
                    f"{1e6 * best['seconds']:.0f}")  # fmt: skip
    for row in rows:
        if row["sweep"] == "laws":
            what = f"{row['shape']}, width {row['width']}, dt {row['dt']}"
            out.add_row(row["title"], row["engine"], what, "", f"{row['distance']:.1e}", "",
                        f"{1e6 * row['seconds']:.0f}")  # fmt: skip
        if row["sweep"] == "MJX":
            what = f"T {row['time_constant']}, mu {row['friction']}, impratio {row['impratio']}"
            gap = f"{row['from_mujoco']:.1e} from C"
            out.add_row(row["title"], "MJX", what, "", gap, "", f"{1e6 * row['seconds']:.0f}")
    return out


def with_others(rows: list[dict[str, Any]], order: list[str]) -> list[dict[str, Any]]:
    """With what an older run has of other robots and parts."""

    def part(row: dict[str, Any]) -> tuple[str, str]:
        return row["robot"], {"MJX": "mjx", "laws": "laws"}.get(row["sweep"], "sweeps")

    run = set(map(part, rows))
    older = [row for row in others(NAME, rows, ("robot", "sweep")) if part(row) not in run]
    return sorted(older + rows, key=lambda row: order.index(row["robot"]))


AXES = {"friction": ("friction",), "stiffness": ("time_constant", "tyre"), "dt": ("dt",)}


def main() -> None:
    every = manoeuvres()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robots", nargs="*", default=[], help=", ".join(every))
    parser.add_argument("--small", action="store_true", help="a smoke test; nothing is saved")
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=PARTS)
    given = parser.parse_args()
    unknown = set(given.robots) - every.keys()
    if unknown:
        parser.error(f"no such robot: {', '.join(sorted(unknown))}")
    rows: list[dict[str, Any]] = []
    for name in given.robots or every:
        for part in given.parts:
            rows += {"sweeps": sweep_rows, "mjx": mjx_rows, "laws": law_rows}[part](
                name, every[name], given.small
            )
            jax.clear_caches()
            if not given.small:
                save(NAME, with_others(rows, [*every]))
    if not given.small:
        rows = with_others(rows, [*every])
        print(draw(rows))
    Console(width=150).print(table(rows))


if __name__ == "__main__":
    main()
