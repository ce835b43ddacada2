"""A robot on three omnidirectional wheels that slips on four floors: data, fit, figures.

Runs at 72 headings were recorded: angles of wheels, and the pose by a camera above. Headings of
0, 10, 20, ... degrees are fitted, 5, 15, 25, ... are not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rbjax import wheeled
from rbjax.sysid import Channel, Recording
from rbjax.sysid.statistics.comparisons import Comparison
from rbjax.sysid.torque import select
from rbjax.wheeled import HeadingSlip, Robot
from rbjax.wheeled.robot.catalogue import omnidirectional

DATA = Path(__file__).parents[3] / "shared" / "data" / "robotino_omni_slip"
FLOORS = ("table", "brown", "gray", "green")
TICK = 2 * np.pi / 2000 / 16  # rad of a wheel
PIXEL = 1.83716e-3, 1.84046e-3  # m, down and right in the picture
ARM, STEPS = 0.125, 36  # m; of each run


class Run(NamedTuple):
    """heading in degrees and speed in m/s as commanded; t, angles, poses on one clock."""

    heading: int
    speed: float
    t: np.ndarray
    angles: np.ndarray
    poses: np.ndarray

    @property
    def held_out(self) -> bool:
        return self.heading % 10 == 5

    @property
    def seen(self) -> float:
        """The distance between the first and the last place, by the camera."""
        return float(np.hypot(*(self.poses[-1] - self.poses[0])[:2]))


class Floor(NamedTuple):
    """What runs on a floor say: the model that they need, its name and the comparisons."""

    slip: HeadingSlip
    name: str
    comparisons: tuple[Comparison, ...]


def robotino() -> Robot:
    """Nominal geometry."""
    places = [float(x) for x in np.deg2rad([60.0, 180.0, 300.0])]
    return omnidirectional(places, arm=ARM, radius=0.04)


def load(floor: str) -> list[Run]:
    """All runs on a floor, with as many steps each."""
    path = DATA / f"for_research_movement_direction__one_surface_type__{floor}_surface.npz"
    with np.load(path) as file:
        columns = [str(c) for c in file["columns"]]
        tables = [file[k] for k in sorted(file.files) if k.startswith("exp")]
    return [_run(f"{floor} {i}", dict(zip(columns, x.T, strict=True)))
            for i, x in enumerate(tables)]  # fmt: skip


def _run(name: str, c: dict[str, np.ndarray]) -> Run:
    t = c["t"] / 1000
    yaw = np.unwrap(np.deg2rad(c["ang"]))
    poses = np.stack([-PIXEL[0] * c["ypos"], -PIXEL[1] * c["xpos"], yaw], 1)
    angles = TICK * np.stack([c[f"m{i}pos"] for i in (1, 2, 3)], 1)
    both = {"other:wheels": Channel(t, angles), "other:camera": Channel(t, poses)}
    even = np.linspace(t[0], t[-1], STEPS + 1)
    on = Recording(name, both).on_clock(even, gap=1.0)
    vx, vy = c["xsetspeed"][-1], c["ysetspeed"][-1]
    heading = 5 * round(np.rad2deg(np.arctan2(vy, vx)) / 5) % 360
    angles, poses = on["other:wheels"].values, on["other:camera"].values
    return Run(heading, round(float(np.hypot(vx, vy)), 1), even, angles, poses)


def shapes(runs: list[Run]) -> dict[str, HeadingSlip]:
    """Models to choose from, by the number of harmonics, the smallest first."""
    out = {f"up to harmonic {K}": HeadingSlip.none(ARM, K) for K in (1, 2, 3, 5)}
    if len({run.speed for run in runs}) == 1:
        return out | {"up to harmonic 7": HeadingSlip.none(ARM, 7)}
    for K, J in ((5, 0), (5, 1), (5, 3), (7, 3)):
        out[f"up to harmonic {K}, {J} with speed"] = HeadingSlip.none(ARM, K, J)
    return out


def fit(robot: Robot, runs: list[Run]) -> Floor:
    """The slip of a floor, with no more harmonics than the runs need.

    A run is one equation, the mean over all its steps, as errors within a run are alike. It is
    divided by the speed of the run, so that each counts by its relative error.
    """
    models = shapes(runs)
    size = np.array([1.0, 1.0, ARM])
    rates = np.stack([np.diff(run.angles, axis=0) / np.diff(run.t)[:, None] for run in runs])
    rolled = np.asarray(wheeled.rolled_twists(robot, rates))
    seen = np.stack([np.asarray(wheeled.mean_twists(run.t, run.poses)) for run in runs])
    per = np.array([(run.t[-1] - run.t[0]) / run.seen for run in runs])[:, None]

    def equation(W: Any) -> np.ndarray:
        return np.asarray(W).mean(1) * per[..., None]

    candidates: dict[str, Any] = {"one radius": (equation((size * rolled)[..., None]), ["radius"])}
    for name, model in models.items():
        names = [str(i) for i in range(model.coefficients.size)]
        candidates[name] = equation(model.columns(rolled)), names
    found = select(candidates, (size * seen).mean(1) * per)
    if found.name == "one radius":
        none = HeadingSlip.none(ARM)
        return Floor(
            none.replace(coefficients=found.regression.beta * none.coefficients), found.name,
            found.comparisons,
        )  # fmt: skip
    model = models[found.name]
    C = found.regression.parameters(np.zeros(model.coefficients.size))
    slip = model.replace(coefficients=jnp.asarray(C).reshape(model.coefficients.shape))
    return Floor(slip, found.name, found.comparisons)


def path_errors(robot: Robot, runs: list[Run], slip: HeadingSlip | None) -> np.ndarray:
    """1 - camera / wheels of the distance between the ends of each run."""
    out = []
    for run in runs:
        path = np.asarray(wheeled.odometry(robot, run.t, run.angles, slip))
        out.append(1 - run.seen / np.hypot(*path[-1, :2]))
    return np.array(out)


def repeatability(runs: list[Run]) -> float:
    """The standard deviation of camera / encoders of a run, over its mean, from the difference of a
    heading and the mean of the headings 5 degrees beside it, which no smooth model explains."""
    robot, off = robotino(), []
    for speed in sorted({run.speed for run in runs}):
        at = {run.heading: run for run in runs if run.speed == speed}
        ordered = [at[h] for h in sorted(at)]
        x = 1 - path_errors(robot, ordered, None)
        off.append(2 * x / (np.roll(x, 1) + np.roll(x, -1)) - 1)
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2) / 1.5))
