"""A fit from a small file: which robot, which recordings, what is sought, where results go.

    model = "robot.xml"
    [recordings]      fit, held_out: files; time, time_unit, rate: their clock
    [columns]         name in the files -> sensor, joint, unit, sign, scale, noise
    [unknowns]        name -> leaf, index (places or names), positive, bounds; or inertia = a body
    [controller]      kp, kd of joints that follow commanded positions; delay
    [options]         of `identify`: starts, pieces, loss, steps, substeps
    [output]          folder
Paths are relative to the file.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnknownName, UnsupportedFeature, listed
from rbjax.loading import load, scenes, write_back, write_mjcf
from rbjax.model import Model
from rbjax.sysid.comparison import HeldOut
from rbjax.sysid.diagnosis import Diagnosis, diagnose
from rbjax.sysid.identified import Identified
from rbjax.sysid.identify import identify
from rbjax.sysid.readers import Column, read_csv, read_npz
from rbjax.sysid.recording import Recording
from rbjax.sysid.report import report
from rbjax.sysid.simulation import PD, Grid, Setup
from rbjax.sysid.unknowns import Inertia, Parametrisation, Tilt, Unknown, Unknowns

TABLES = {
    "recordings": ("fit", "held_out", "time", "time_unit", "rate"),
    "columns": None,
    "unknowns": None,
    "controller": ("kp", "kd", "delay", "longest_delay"),
    "options": ("starts", "pieces", "loss", "steps", "substeps", "period"),
    "output": ("folder",),
}
HEAD = ("model", "floating_base", "friction", "limits", "motors")
OF_UNKNOWN = ("leaf", "index", "positive", "bounds", "scale", "inertia", "tilt")


@dataclass(frozen=True)
class Results:
    """What a job made: the fit, the verdict on held-out recordings, what is wrong with the data,
    its files by what they hold, and sentences about these."""

    found: Identified
    verdict: HeldOut | None
    diagnosis: Diagnosis
    files: dict[str, Path]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Job:
    """A fit as its file says it; `run` does it."""

    source: str
    setup: Setup
    fit: tuple[Recording, ...]
    held_out: tuple[Recording, ...]
    unknowns: dict[str, Parametrisation]
    grid: Grid | None
    options: dict[str, Any]
    folder: Path

    @classmethod
    def read(cls, path: str | Path) -> Job:
        """The job of a TOML file.

        Raises:
            InputError: no such file, no TOML, something missing or unknown in it; the message names
                the table and key.
        """
        path = Path(path)
        try:
            given = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(
                f"identify: no file {path} ({error.strerror}); `rbjax identify --example FOLDER` "
                "writes one that works"
            ) from error
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"identify: {path} is no TOML: {error}") from error
        _check(given)
        at = path.parent
        name = given["model"]
        source = name if name in scenes() else str(at / name)
        how = {k: given[k] for k in HEAD[1:] if k in given}
        model = load(source, **how)
        setup, delay = _setup(model, given.get("controller", {}))
        options = dict(given.get("options", {}))
        substeps, period = options.pop("substeps", 1), options.pop("period", None)
        files = given["recordings"]
        runs = {use: _read(at, files, use, given["columns"]) for use in ("fit", "held_out")}
        grid = None
        if substeps != 1 or period is not None or delay:
            first = runs["fit"][0]
            clock = first["ctrl" if "ctrl" in first.channels else "q"].step
            period = clock if period is None else float(period)
            longest = int(np.ceil(delay / period)) + 1 if delay else 0
            grid = Grid(period, int(substeps), "rk4", longest)
        folder = at / given.get("output", {}).get("folder", path.stem)
        unknowns = {n: _unknown(model, n, u) for n, u in given["unknowns"].items()}
        Unknowns.of("identify", unknowns, setup)  # refuses what is not there, before any work
        return cls(
            source, setup, tuple(runs["fit"]), tuple(runs["held_out"]), unknowns, grid, options,
            folder,
        )  # fmt: skip

    def run(self, *, resume: bool = False, progress: bool = False) -> Results:
        """Fits, judges, and writes report.html, fit.json and the robot's file with the found
        numbers into the folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        saved = self.folder / "fit.json"
        found = identify(
            self.setup, self.fit, self.unknowns, grid=self.grid, save=saved,
            resume=saved if resume else None, progress=progress, **self.options,
        )  # fmt: skip
        diagnosis = diagnose(found, progress=progress)
        page = self.folder / "report.html"
        title = f"Identification of {Path(self.source).stem}"
        report(found, page, held_out=self.held_out, diagnosis=diagnosis, title=title)
        robot, note = self._robot(found.model)
        files = {"report": page, "fit": saved, "robot": robot}
        verdict = found.on(self.held_out) if self.held_out else None
        return Results(found, verdict, diagnosis, files, (note,) if note else ())

    def _robot(self, model: Model) -> tuple[Path, str]:
        """The user's file with the found numbers; a new one where that cannot say them, and why."""
        own = Path(self.source)
        path = self.folder / (f"{own.stem}-found{own.suffix or '.xml'}")
        try:
            write_back(model, self.source, path)
        except (InputError, UnsupportedFeature, ValueError) as error:
            path = path.with_suffix(".xml")
            write_mjcf(model, path)
            return path, f"{own.name} cannot say the found numbers, so {path.name} is new: {error}"
        return path, ""


def _check(given: Mapping[str, Any]) -> None:
    for key in given:
        if key not in (*HEAD, *TABLES):
            raise UnknownName("key of the configuration", key, [*HEAD, *TABLES])
    for key in ("model", "recordings", "columns", "unknowns"):
        if not given.get(key):
            raise InputError(f"identify: the configuration has no {key}, expected {SAYS[key]}")
    for table, keys in TABLES.items():
        if not isinstance(given.get(table, {}), dict):
            raise InputError(f"identify: {table} is {given[table]!r}, expected a table [{table}]")
        for key in given.get(table, {}):
            if keys is not None and key not in keys:
                raise UnknownName(f"key of [{table}]", key, keys)


SAYS = {
    "model": 'model = "robot.xml"',
    "recordings": '[recordings] with fit = ["run.csv"]',
    "columns": '[columns] with lines such as "elbow angle" = {sensor = "q", joint = "elbow"}',
    "unknowns": '[unknowns] with lines such as damping = {leaf = "joints.damping"}',
}


def _setup(model: Model, given: Mapping[str, Any]) -> tuple[Setup, float]:
    """The set-up and the longest delay."""
    servo = None
    if "kp" in given or "kd" in given:
        gains = [np.broadcast_to(given.get(k, 0.0), (model.nu,)) for k in ("kp", "kd")]
        servo = PD(*(jnp.asarray(x, float) for x in gains))
    delay = given.get("delay")
    longest = given.get("longest_delay", 3 * delay if delay else 0.0)
    return Setup.of(model, servo, delay), float(longest)


def _read(
    at: Path, files: Mapping[str, Any], use: str, columns: Mapping[str, Any]
) -> list[Recording]:
    names = files.get(use, [])
    names = [names] if isinstance(names, str) else names
    if use == "fit" and not names:
        raise InputError(f"identify: [recordings] has no fit, expected {SAYS['recordings']}")
    wanted = {name: _column(name, said) for name, said in columns.items()}
    how = {k: files[k] for k in ("time", "time_unit", "rate") if k in files}
    readers = {".csv": read_csv, ".txt": read_csv, ".npz": read_npz}
    found = []
    for name in names:
        suffix = Path(name).suffix
        if suffix not in readers:
            raise InputError(f"identify: recording {name}, expected a file {listed([*readers], 3)}")
        found.append(readers[suffix](at / name, wanted, **how))
    return found


def _column(name: str, said: Any) -> Column:
    if not isinstance(said, dict) or "sensor" not in said:
        raise InputError(f"identify: column {name} is {said!r}, expected {SAYS['columns']}")
    for key in said:
        if key not in Column._fields:
            raise UnknownName(f"key of column {name}", key, Column._fields)
    return Column(**said)


def _unknown(model: Model, name: str, said: Any) -> Parametrisation:
    if not isinstance(said, dict) or len({"leaf", "inertia", "tilt"} & set(said)) != 1:
        raise InputError(
            f"identify: unknown {name} is {said!r}, expected one of leaf, inertia and tilt, as in "
            f'{SAYS["unknowns"]}, or {name} = {{inertia = "{model.body_names[-1]}"}}'
        )
    for key in said:
        if key not in OF_UNKNOWN:
            raise UnknownName(f"key of unknown {name}", key, OF_UNKNOWN)
    if "tilt" in said:
        return Tilt()
    if "inertia" in said:
        return Inertia(said["inertia"])
    said = dict(said)
    if "bounds" in said:
        said["bounds"] = tuple(map(float, said["bounds"]))
    if "index" in said:
        said["index"] = _place(model, said["leaf"], said["index"])
    return Unknown(**said)


def _place(model: Model, leaf: str, index: Any) -> Any:
    """Places of a leaf; names of bodies, joints or actuators as the first of their numbers."""
    if isinstance(index, list):
        places = [_place(model, leaf, one) for one in index]
        return np.array(places) if all(map(np.isscalar, places)) else tuple(index)
    if not isinstance(index, str):
        return index
    kind = leaf.removeprefix("model.").split(".")[0]
    names: Sequence[str] = {
        "bodies": model.body_names, "actuators": model.actuator_names,
        "controller": model.actuator_names,
    }.get(kind, model.joint_names)  # fmt: skip
    if index not in names:
        raise UnknownName(f"index of {leaf}", index, names)
    k = list(names).index(index)
    by_velocity = leaf.endswith((".armature", ".damping"))
    return model.topology.joint_v[k] if by_velocity else k
