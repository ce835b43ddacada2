"""Recordings as arrays on the grid of a simulation.

Runs of different lengths are padded with samples of weight 0, to form one batch with one program.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, integer, real_number
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.motion.field import dynamics_of, free_motion
from rbjax.motion.integrators import integrator_of
from rbjax.sysid.data.recording import HELD, JOINT_SENSORS, Channel, Recording
from rbjax.sysid.simulation.setup import Grid, Setup


class Run(NamedTuple):
    """One run, or a batch of runs.

    Fields:
        start: first readings as a state, or the given initial state if `exact` is 1.
        commands: (N, n) commands.
        times: sensor -> (T,) times in s after the start.
        values: sensor -> (T, n) recorded values.
        weights: sensor -> (T, n) 1 / sigma, or 0 for a missing value.
        known: 1 if the initial state is known, else 0.
        exact: 1 if the recording has an `initial_state`, else 0.
    """

    start: State
    commands: jax.Array
    times: dict[str, Any]
    values: dict[str, Any]
    weights: dict[str, Any]
    known: Any = 0.0
    exact: Any = 0.0


def _check_grid(setup: Setup, grid: Grid) -> None:
    instance("identify", "grid", grid, Grid, "a Grid(period)")
    period = real_number("identify", "period of the grid", grid.period, "seconds above 0", above=0)
    dynamics = dynamics_of("identify", setup.model, free_motion, None, steps=True)
    integrator_of("identify", grid.integrator, dynamics, setup.model)
    integer("identify", "substeps of the grid", grid.substeps, least=1)
    integer("identify", "longest_delay of the grid", grid.longest_delay, least=0)
    delay = 0.0 if setup.delay is None else float(np.max(np.asarray(setup.delay)))
    if delay > grid.longest_delay * period * (1 + 1e-6):
        raise InputError(
            f"identify: commands are {delay:g} s late, but the grid has longest_delay "
            f"{grid.longest_delay}, which are {grid.longest_delay * period:g} s; expected a Grid "
            f"with longest_delay {int(np.ceil(delay / period - 1e-6))} or more"
        )


def make_run(setup: Setup, run: Recording, grid: Grid) -> Run:
    """Convert a recording to arrays on the grid of a simulation."""
    _check_grid(setup, grid)
    model, dtype = setup.model, setup.model.gravity.dtype
    run = order_columns(model, run)
    measured = [s for s in setup.sensors if s in run.channels]
    if "q" not in measured:
        raise InputError(
            f"identify: recording {run.name} has channels {', '.join(run)}, expected q among them: "
            "a simulation starts from a configuration"
        )
    _check_columns(setup, run, measured)
    channels = {s: run[s] for s in (*measured, HELD) if s in run.channels}
    start = start_time(setup, run)
    # the last command holds for one step of its channel
    end = min(c.t[-1] + (c.step if s == HELD else 0.0) for s, c in channels.items())
    count = int((end - start) / grid.period + 1e-6)
    if count < 1:
        raise InputError(
            f"identify: recording {run.name} lasts {end - start:g} s, expected at least a period "
            f"of {grid.period:g} s"
        )
    # other sensors at the last instant depend on the command that begins at it
    periods = count if {*measured} <= {"q", "v"} else count + 1
    if "ctrl" in run.channels:
        instants = start + grid.period * (np.arange(periods) + 1e-6)  # after a command has changed
        held = np.searchsorted(run["ctrl"].t, instants, side="right") - 1
        commands = run["ctrl"].values[held]
    else:
        commands = np.zeros((periods, model.nu))
    times, values, weights = {}, {}, {}
    for sensor in measured:
        channel = run[sensor]
        inside = (channel.t >= start - 1e-9) & (channel.t <= start + count * grid.period + 1e-9)
        arrived = channel.arrived[inside]
        sigma = 1.0 if channel.noise is None else channel.noise
        times[sensor] = channel.t[inside] - start
        values[sensor] = np.where(arrived, np.nan_to_num(channel.values[inside]), 0.0)
        weights[sensor] = arrived / sigma
    given = run.initial_state
    q, v = _first_readings(model, run, start) if given is None else _check_state(model, run, given)
    x = None if model.nx == 0 else model.default_state().x
    if given is not None and model.nx and given.x is not None:
        x = given.x
    first: Any = (q, v, x)
    found = Run(
        State(*first), commands, times, values, weights,
        np.array(float(run.start_is_known)), np.array(float(given is not None)),
    )  # fmt: skip
    # convert with numpy, since JAX compiles each operation for every shape
    return jax.tree.map(lambda a: jnp.asarray(np.asarray(a, dtype)), found)


def start_time(setup: Setup, run: Recording) -> float:
    """Find the start time of a simulation in s: the first sample of q after all channels begin."""
    used = [c for s, c in run.channels.items() if s in setup.sensors or s == HELD]
    start = max(float(c.t[0]) for c in used)
    later = run["q"].t[run["q"].t >= start - 1e-9]
    return max(start, float(later[0])) if len(later) else start


def order_columns(model: Model, run: Recording) -> Recording:
    """Order the columns of joints and actuators as in the model."""
    run.check_model(model)
    channels = dict(run.channels)
    for sensor, due in JOINT_SENSORS.items():
        if sensor not in channels:
            continue
        channel, size = channels[sensor], getattr(model, due)
        names = model.actuator_names if sensor == HELD else model.joint_names
        if len(channel.names) != size and sensor not in (HELD, "q"):
            channel = channels[sensor] = _add_unmeasured(model, channel)
        if len(channel.names) != size:
            raise InputError(
                f"identify: channel {sensor} of recording {run.name} has {len(channel.names)} "
                f"columns, expected all {size} of the model; give those that were not measured as "
                'nan with dropped="nan"'
            )
        if set(channel.names) == set(names) and channel.names != tuple(names):
            order = [channel.names.index(name) for name in names]
            noise = None if channel.noise is None else channel.noise[order]
            channels[sensor] = Channel(
                channel.t, channel.values[:, order], tuple(names), noise=noise, dropped="nan"
            )
    return dataclasses.replace(run, channels=channels)


def _add_unmeasured(model: Model, channel: Channel) -> Channel:
    """Add missing velocity coordinates as NaN columns to a channel of some joints."""
    slices = [model.v_slice(name) for name in channel.names]
    if any(at.stop - at.start != 1 for at in slices):
        return channel
    values = np.full((len(channel.t), model.nv), np.nan)
    noise = None if channel.noise is None else np.ones(model.nv)
    for k, at in enumerate(slices):
        values[:, at.start] = channel.values[:, k]
        if noise is not None:
            noise[at.start] = channel.noise[k]
    each = len(model.joint_names) == model.nv
    names = tuple(model.joint_names) if each else None
    return Channel(channel.t, values, names, noise=noise, dropped="nan")


def _check_columns(setup: Setup, run: Recording, measured: Sequence[str]) -> None:
    for sensor in measured:
        due, got = setup.columns(sensor).size, len(run[sensor].names)
        if got != due:
            raise InputError(
                f"identify: channel {sensor} of recording {run.name} has {got} columns, expected "
                f"{due}, as the set-up reads"
            )


def _check_state(model: Model, run: Recording, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Check the initial state of a recording, and return its q and v."""
    for name, x, size in (("q", state.q, model.nq), ("v", state.v, model.nv)):
        if np.shape(x) != (size,) or not np.isfinite(np.asarray(x)).all():
            raise InputError(
                f"identify: recording {run.name} has an initial_state whose {name} is {x}, "
                f"expected ({size},) finite numbers"
            )
    return np.asarray(state.q), np.asarray(state.v)


def _first_readings(model: Model, run: Recording, start: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the first readings of q and v. Without a channel v, v is the slope of q."""

    def first(sensor: str) -> np.ndarray:
        channel = run[sensor]
        found = channel.values[int(np.searchsorted(channel.t, start - 1e-9))]
        if np.isnan(found).any():
            raise InputError(
                f"identify: the first sample of {sensor} in recording {run.name} did not arrive, "
                "expected one to start from: begin where all arrived, by run.segment(t0, t1)"
            )
        return found

    q = first("q")
    if "v" in run.channels:
        return q, first("v")
    if model.nq != model.nv:
        raise InputError(
            f"identify: recording {run.name} has no channel v, expected one: the model has "
            "attitudes, whose angular velocity is not the derivative of q"
        )
    channel = run["q"]
    k = int(np.searchsorted(channel.t, start - 1e-9))
    few = slice(k, k + 5)
    return q, np.polyfit(channel.t[few] - channel.t[k], channel.values[few], 2)[1]


def stack_runs(runs: Sequence[Run]) -> Run:
    """Stack runs into a batch, padded to the longest one."""
    sensors = {tuple(sorted(e.values)) for e in runs}
    if len(sensors) > 1:
        raise InputError(
            f"identify: the recordings have channels {sorted(sensors)}, expected the same in all; "
            "leave out what only some have"
        )

    def stack(arrays: Sequence[Any], mode: Any) -> Any:
        longest = max(a.shape[0] for a in arrays)
        ends = [[(0, longest - a.shape[0])] + [(0, 0)] * (a.ndim - 1) for a in arrays]
        padded = [np.pad(a, end, mode=mode) for a, end in zip(arrays, ends, strict=True)]
        return jnp.asarray(np.stack(padded))

    def each(field: str, mode: str) -> dict[str, Any]:
        first = getattr(runs[0], field)
        return {s: stack([getattr(e, field)[s] for e in runs], mode) for s in first}

    return Run(
        jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *(e.start for e in runs)),
        stack([e.commands for e in runs], "edge"),
        each("times", "edge"), each("values", "constant"), each("weights", "constant"),
        *(jnp.asarray(np.stack([getattr(e, f) for e in runs])) for f in ("known", "exact")),
    )  # fmt: skip


def default_grid(
    runs: Sequence[Recording], setup: Setup | None = None, *, longest: float | None = None,
    period: float | None = None,
) -> Grid:  # fmt: skip
    """Create a grid with the period of the finest clock, unless `period` is given.

    The finest clock of all channels counts, since commands may be logged only when they change.
    `longest` is the largest delay in s. None: three times the delay of the set-up, or three
    periods.
    """
    step = min(channel.step for run in runs for channel in run.channels.values())
    # round, so that clocks with rounding errors share a program
    period = float(f"{step:.12g}") if period is None else period
    if setup is None or setup.delay is None:
        return Grid(period)
    if longest is None:
        longest = max(3 * float(np.max(np.asarray(setup.delay))), 3 * period)
    periods = int(np.ceil(longest / period - 1e-6)) + 1 if longest > 0 else 0
    return Grid(period, longest_delay=periods)


def make_batch(setup: Setup, runs: Sequence[Recording], grid: Grid) -> Run:
    """Convert recordings to a batch of runs."""
    return stack_runs([make_run(setup, run, grid) for run in runs])
