"""Identification jobs that are defined by a TOML file.

`docs/guides/job_files.md` lists the tables and keys. Paths are relative to the file. Results are
written into a folder within the file's folder, unless the caller gives another folder.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice
from rbjax.errors import InputError, UnsupportedFeature, listed
from rbjax.loading import load, scenes, write_back, write_mjcf
from rbjax.model import Model
from rbjax.sensors import Currents
from rbjax.sysid.data.readers import Column, read_recording
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.estimators.identification import identify
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.estimators.multi_start import many_starts
from rbjax.sysid.jobs.keys import KEYS, NEEDED, check, check_joints, index_of, shorten
from rbjax.sysid.judgement.corrections import Diagnosis
from rbjax.sysid.judgement.diagnosis import diagnose
from rbjax.sysid.judgement.report_page import report
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.parameters.unknowns import Inertia, Parametrisation, Tilt, Unknown
from rbjax.sysid.simulation.runs import default_grid
from rbjax.sysid.simulation.setup import PD, Grid, Setup
from rbjax.sysid.statistics.comparisons import HeldOut


@dataclass(frozen=True)
class Results:
    """Results of a job.

    Fields:
        found: the fit.
        verdict: verdict on the held-out recordings; None without held-out recordings.
        diagnosis: diagnosis of the recordings and the fit.
        files: the written files, such as "report" -> path.
        notes: sentences on the files.
    """

    found: Identified
    verdict: HeldOut | None
    diagnosis: Diagnosis
    files: dict[str, Path]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Job:
    """An identification job, read from a TOML file."""

    source: str
    setup: Setup
    fit: tuple[Recording, ...]
    held_out: tuple[Recording, ...]
    unknowns: dict[str, Parametrisation]
    grid: Grid | None
    options: dict[str, Any]
    folder: Path
    guesses: int | None = None

    @classmethod
    def read(cls, path: str | Path, *, folder: str | Path | None = None) -> Job:
        """Read and check a TOML file, and read the files that it references.

        Args:
            path: path of the TOML file.
            folder: folder of the results. None: the folder in [output].

        Raises:
            InputError: no such file, not TOML, an invalid value, or recordings that do not match
                the robot. The message contains table and key.
            UnknownName: an unknown table, key, unit, sensor, joint, body or leaf.
        """
        path = Path(path)
        given = _toml(path)
        check(given)
        at = path.parent
        out = _folder(path, given) if folder is None else Path(folder)
        name = given["model"]
        source = name if name in scenes() else str(at / name)
        model = load(source, **{k: given[k] for k in KEYS[""] if k != "model" and k in given})
        files = given["recordings"]
        wanted = {name: Column(**line) for name, line in given["columns"].items()}
        runs = {use: _read(at, files, use, wanted) for use in ("fit", "held_out")}
        for run in (*runs["fit"], *runs["held_out"]):
            check_joints(model, run, wanted)
            run.check_model(model)
        setup = _with_sensors(_controlled(model, given.get("controller", {})), given, wanted)
        options = dict(given.get("options", {}))
        grid = _grid(setup, given.get("controller", {}), options, runs)
        unknowns = {n: _unknown(setup, n, line) for n, line in given["unknowns"].items()}
        Unknowns.of("identify", unknowns, setup)  # raises before any work
        guesses = options.pop("many_starts", None)
        return cls(
            source, setup, tuple(runs["fit"]), tuple(runs["held_out"]), unknowns, grid, options,
            out, guesses,
        )  # fmt: skip

    def run(self, *, resume: bool = False, progress: bool = False) -> Results:
        """Fit, diagnose and validate, and write the results into the folder.

        The results are report.html, fit.json and the robot's file with the estimates.
        """
        saved = self.folder / "fit.json"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"identify: folder {self.folder} cannot be created: {error}"
            ) from error
        how: dict[str, Any] = {"grid": self.grid, "progress": progress, **self.options}
        if self.guesses is not None and not resume:
            found = many_starts(
                self.setup, self.fit, self.unknowns, guesses=self.guesses, save=saved, **how
            ).best
        else:
            found = identify(
                self.setup, self.fit, self.unknowns, save=saved, resume=saved if resume else None,
                **how,
            )  # fmt: skip
        diagnosis = diagnose(found, progress=progress)
        page = self.folder / "report.html"
        title = f"Identification of {Path(self.source).stem}"
        report(found, page, held_out=self.held_out, diagnosis=diagnosis, title=title)
        robot, note = self._robot(found.model)
        files = {"report": page, "fit": saved, "robot": robot}
        verdict = found.validate(self.held_out) if self.held_out else None
        return Results(found, verdict, diagnosis, files, (note,) if note else ())

    def _robot(self, model: Model) -> tuple[Path, str]:
        """Write the estimates into a copy of the robot's file, or a new file with the reason."""
        own = Path(self.source)
        path = self.folder / (f"{own.stem}-found{own.suffix or '.xml'}")
        try:
            write_back(model, self.source, path)
        except (InputError, UnsupportedFeature, ValueError) as error:
            path = path.with_suffix(".xml")
            write_mjcf(model, path)
            return path, f"{own.name} cannot hold the estimates, so {path.name} is new: {error}"
        return path, ""


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"identify: no file {path} ({error.strerror}); `rbjax identify --example FOLDER` "
            "writes one that works"
        ) from error
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, an integer too long
        reason = str(error)[:200]
        raise InputError(f"identify: {path} is not a TOML file: {reason}") from error


def _folder(path: Path, given: Mapping[str, Any]) -> Path:
    """Return the folder of the results. Check that it is within the folder of the job file."""
    name = given.get("output", {}).get("folder", path.stem)
    at = path.parent.resolve()
    if not (at / name).resolve().is_relative_to(at):
        raise InputError(
            f"identify: [output] folder is {shorten(name)}, which lies outside of {at}, expected a "
            "folder within it; `rbjax identify FILE --out FOLDER` writes elsewhere"
        )
    return path.parent / name


def _controlled(model: Model, given: Mapping[str, Any]) -> Setup:
    """Create the set-up with the controller and delay of a job file."""
    servo = None
    if "kp" in given or "kd" in given:
        if not model.nu:
            raise InputError(
                "identify: [controller] has gains, but the model has no actuators; "
                "motors = true gives each hinge and slide one"
            )
        gains = {}
        for key in ("kp", "kd"):
            values = np.asarray(given.get(key, 0.0), float)
            if values.shape not in ((), (model.nu,)):
                raise InputError(
                    f"identify: [controller] {key} has {values.size} numbers, expected one, or "
                    f"{model.nu}, one for each actuator: {listed(model.actuator_names, 8)}"
                )
            gains[key] = jnp.asarray(np.broadcast_to(values, (model.nu,)))
        servo = PD(**gains)
    delay = given.get("delay")
    if delay is None and "longest_delay" in given:
        raise InputError("identify: [controller] has longest_delay without delay, expected both")
    return Setup.of(model, servo, None if delay is None else float(delay))


def _with_sensors(setup: Setup, given: Mapping[str, Any], columns: Mapping[str, Column]) -> Setup:
    """Add every sensor of the columns to the set-up."""
    options = given.get("sensors", {})
    for sensor in dict.fromkeys(c.sensor for c in columns.values()):
        if sensor in ("q", "v", "ctrl"):
            continue
        if sensor.partition(":")[0] in ("force", "torque", "other"):
            raise InputError(
                f"identify: sensor {sensor} is not one that a job file can simulate, expected q, "
                "v, a, tau, current, ctrl, pose:NAME, position:SITE, gyro:SITE or "
                "accelerometer:SITE; leave its columns out, or call `rb.sysid.identify` with "
                "`Setup.with_sensors` and a `CustomSensor`"
            )
        if sensor != "current":
            setup = setup.with_sensors(sensor)
            continue
        nv = setup.model.nv
        constant = np.asarray(options.get("current", 0.0), float)
        if "current" not in options or constant.shape not in ((), (nv,)):
            raise InputError(
                "identify: sensor current needs the torque constants of the joints, expected "
                f"[sensors] with current = a number in N m/A, or a list of {nv}"
            )
        constants = Currents(jnp.asarray(np.broadcast_to(constant, (nv,))))
        setup = setup.with_sensors({"current": constants})
    return setup


def _grid(
    setup: Setup, controller: Mapping[str, Any], options: dict[str, Any],
    runs: Mapping[str, list[Recording]],
) -> Grid | None:  # fmt: skip
    """Create the grid from period, substeps and delay. None: the default of `identify`.

    Without substeps, `identify` checks the length of the steps.
    """
    substeps, period = options.pop("substeps", None), options.pop("period", None)
    if substeps is None and period is None and setup.delay is None:
        return None
    shortest = min(run.end - run.start for use in runs.values() for run in use)
    longest = None
    if setup.delay is not None:
        delay = float(controller["delay"])
        longest = float(controller.get("longest_delay", 3 * delay))
        if not delay <= longest < shortest:
            raise InputError(
                f"identify: [controller] delay is {delay:g} s and longest_delay {longest:g} s, "
                f"expected delay <= longest_delay < {shortest:g} s, the length of the shortest "
                "recording"
            )
    seconds = None if period is None else float(period)
    grid = default_grid(runs["fit"], setup, longest=longest, period=seconds)
    if grid.period >= shortest:
        raise InputError(
            f"identify: [options] period is {grid.period:g} s, expected less than {shortest:g} s, "
            "the length of the shortest recording"
        )
    return grid._replace(substeps=0 if substeps is None else substeps)


def _read(
    at: Path, files: Mapping[str, Any], use: str, wanted: Mapping[str, Column]
) -> list[Recording]:
    names = files.get(use, [])
    names = [names] if isinstance(names, str) else names
    known = ("time", "time_unit", "rate", "delimiter", "decimal", "comment")
    how = {k: files[k] for k in known if k in files}
    for name in names:
        if Path(name).suffix not in (".csv", ".txt", ".npz"):
            raise InputError(
                f"identify: recording {shorten(name)}, expected a file .csv, .txt or .npz"
            )
    return [read_recording(at / name, wanted, **how) for name in names]


def _unknown(setup: Setup, name: str, line: Mapping[str, Any]) -> Parametrisation:
    kinds = [key for key in ("leaf", "inertia", "tilt") if key in line]
    if len(kinds) != 1:
        raise InputError(
            f"identify: unknown {name} is {shorten(line)}, expected one of leaf, inertia and tilt, "
            f"as in {NEEDED['unknowns']}, or {name} = {{inertia = "
            f'"{setup.model.body_names[-1]}"}}'
        )
    if kinds[0] != "leaf":
        others = [key for key in line if key != kinds[0]]
        if others:
            raise InputError(
                f"identify: unknown {name} has {kinds[0]} and {listed(others, 4)}, expected "
                f"{kinds[0]} only; the other keys belong to a leaf"
            )
        if kinds[0] == "tilt":
            return Tilt()
        return Inertia(choice("body", line["inertia"], setup.model.body_names))
    how = dict(line)
    for key in how.keys() & {"bounds", "prior"}:
        how[key] = tuple(map(float, how[key]))
    if "positive" in how and "bounds" in how:
        raise InputError(
            f"identify: unknown {name} has positive and bounds, expected one of them: "
            "bounds = [0.0, inf] is positive"
        )
    if "index" in how:
        how["index"] = index_of(setup, how["leaf"], how["index"])
    return Unknown(**how)
