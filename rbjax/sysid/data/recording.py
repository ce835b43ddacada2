"""Recordings of the sensors of a robot, each with its own clock.

A `Channel` is one sensor: times t (samples,) in s and values (samples, columns) in SI. Sensors may
have different rates, irregular clocks, and missing samples, which are NaN in `values`. A
`Recording` contains the channels of one run by sensor:
    q v a tau     of the joints: rad, rad/s, rad/s^2, N m (slides: m, m/s, m/s^2, N)
    current       of the joint motors, A
    ctrl          commands; each command holds until the next one
    pose:NAME     of a body or a site: position in m and quaternion (w, x, y, z), in the world
    position:SITE, gyro:SITE, accelerometer:SITE, force:SITE, torque:SITE    3 numbers each
    other:NAME    any other sensor
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import InitVar, dataclass
from typing import Any

import numpy as np

from rbjax.arguments import choice, instance, real_array
from rbjax.display import Display, displayed, plural, value_text
from rbjax.errors import InputError, UnknownName
from rbjax.model import Model, State
from rbjax.sensors import kinds
from rbjax.sysid.data.filtering import interpolate_columns, quaternion_columns
from rbjax.sysid.data.units import in_si

#: joint sensor -> attribute of the model with its number of columns
JOINT_SENSORS = {"q": "nq", "v": "nv", "a": "nv", "tau": "nv", "current": "nv", "ctrl": "nu"}
#: sensors of a body or a site -> number of columns
PLACED_SENSORS = {"pose": 7, "position": 3, "gyro": 3, "accelerometer": 3, "force": 3, "torque": 3}
HELD = "ctrl"


@displayed
@dataclass(frozen=True, eq=False)
class Channel:
    """The samples of one sensor, with its own clock.

    Args:
        t: (samples,) increasing times in s.
        values: (samples, columns) or (samples,) values in `unit`.
        names: names of the columns (joints, actuators or axes). None: "0", "1", ...
        unit: unit of all values, or one unit for each column (`in_si`). Values are converted to SI.
        scale: additional factor for all columns or for each column, such as a torque constant in N
            m/A.
        sign: 1, or -1 for a sensor of the opposite sign; for all columns or for each column.
        noise: (columns,) standard deviation in SI, if known. The columns of a quaternion have the
            standard deviation of the rotation, in rad.
        dropped: (samples,) or (samples, columns) mask of missing samples; or "nan" if missing
            samples are NaN.

    Raises:
        InputError: wrong lengths, a clock that does not increase, or a value that is neither finite
            nor dropped.
        UnknownName: an unknown unit.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid import Channel
        >>> seen = Channel([0.0, 0.1, 0.2], [[90.0], [np.nan], [180.0]], ("elbow",), unit="deg",
        ...     dropped="nan")
        >>> seen.values.ravel().round(2).tolist(), seen.arrived.ravel().tolist()
        ([1.57, nan, 3.14], [True, False, True])
    """

    t: Any
    values: Any
    names: Any = None
    unit: InitVar[str | Sequence[str]] = ""
    scale: InitVar[float | Sequence[float]] = 1.0
    sign: InitVar[int | Sequence[int]] = 1
    noise: Any = None
    dropped: InitVar[Any] = None

    def __post_init__(self, unit: Any, scale: Any, sign: Any, dropped: Any) -> None:
        t, values = _floats("t", self.t), _floats("values", self.values)
        values = values[:, None] if values.ndim == 1 else values
        if t.ndim != 1 or values.ndim != 2 or len(t) != len(values) or len(t) < 2:
            raise InputError(
                f"Channel: t has shape {t.shape} and values {values.shape}, expected (samples,) "
                "and (samples, columns) with the same number of samples, at least 2"
            )
        columns = values.shape[1]
        if not (self.names is None or isinstance(self.names, Iterable)):
            raise InputError(f"Channel: names is {self.names!r}, expected one for each column")
        names = tuple(map(str, range(columns) if self.names is None else self.names))
        if len(names) != columns or len(set(names)) != columns:
            raise InputError(
                f"Channel: names are {names}, expected {columns} different ones, one a column"
            )
        instance("Channel", "unit", unit, Iterable, "a unit, or one for each column")
        units = [unit] * columns if isinstance(unit, str) else list(unit)
        factor = _one_a_column("unit", [in_si(u) for u in units], columns)
        signs = _one_a_column("sign", sign, columns)
        if not (np.abs(signs) == 1).all():
            raise InputError(f"Channel: sign is {sign}, expected 1 or -1; a factor is `scale`")
        factor = factor * signs * _one_a_column("scale", scale, columns)
        noise = None if self.noise is None else _one_a_column("noise", self.noise, columns)
        if noise is not None and (noise < 0).any():
            raise InputError(f"Channel: noise is {noise}, expected positive standard deviations")
        _check_clock(t)
        missing = np.isnan(values) if isinstance(dropped, str) else _mask(dropped, values.shape)
        if isinstance(dropped, str) and dropped != "nan":
            raise InputError(f'Channel: dropped is {dropped!r}, expected an array of bool or "nan"')
        wrong = np.argwhere(~np.isfinite(values) & ~missing)
        if len(wrong):
            i, j = wrong[0]
            raise InputError(
                f"Channel: {names[j]} is {values[i, j]} at sample {i} (t = {t[i]:g} s), and "
                f"{len(wrong)} values in all are not finite; if these samples did not arrive, "
                'say dropped="nan"'
            )
        held = {"t": t, "values": np.where(missing, np.nan, values * factor), "names": names}
        for name, x in (held | {"noise": noise}).items():
            object.__setattr__(self, name, x)
            if isinstance(x, np.ndarray):
                x.setflags(write=False)

    @property
    def arrived(self) -> np.ndarray:
        """The mask (samples, columns) of the samples that are not missing."""
        return ~np.isnan(self.values)

    @property
    def step(self) -> float:
        """The median step of the clock in s."""
        return float(np.median(np.diff(self.t)))

    def drop(self, dropped: Any) -> Channel:
        """Return the channel with the samples of a mask (samples,) or (samples, columns) marked as
        missing."""
        mask = ~self.arrived | _mask(dropped, self.values.shape)
        return self.replace(self.t, np.where(mask, np.nan, self.values))

    def replace(self, t: Any, values: Any) -> Channel:
        """Return the channel with another clock t in s and other values in SI. NaN is a missing
        sample."""
        return Channel(t, values, self.names, noise=self.noise, dropped="nan")


@displayed
@dataclass(frozen=True, eq=False)
class Recording:
    """The channels of one run, by sensor. All clocks have the same origin.

    Args:
        name: name of the run.
        channels: sensor -> `Channel`. `rbjax.sysid.data.recording` lists the sensors.
        source: name of the recording of which this is a segment; its own name if "".
        initial_state: state at the start, if it is known exactly, such as rest at a known
            configuration. None: `identify` estimates it, unless the only sample of channel v is its
            first one. In that case the first readings of q and v are the exact initial state.

    Raises:
        InputError: no channels, clocks without a common time, or an initial_state that is not a
            `State`.
        UnknownName: an unknown sensor.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid import Channel, Recording
        >>> t = np.linspace(0.0, 1.0, 101)
        >>> run = Recording("swing", {"q": Channel(t, np.sin(t), ("hinge",))})
        >>> run.segment(0.2, 0.5).channels["q"].values.shape
        (31, 1)
    """

    name: str
    channels: Mapping[str, Channel]
    source: str = ""
    initial_state: State | None = None

    def __post_init__(self) -> None:
        where = f"Recording {self.name}"
        fix = "a State, such as State(q, v), or None to have it estimated"
        instance(where, "initial_state", self.initial_state, State | None, fix)
        instance("Recording", "name", self.name, str, "a str")
        instance(where, "channels", self.channels, Mapping, "a dict sensor -> Channel")
        object.__setattr__(self, "channels", dict(self.channels))
        object.__setattr__(self, "source", self.source or self.name)
        if not self.channels:
            raise InputError(f"Recording {self.name}: no channels, expected at least one sensor")
        for sensor, channel in self.channels.items():
            kind, _, where = str(sensor).partition(":")
            instance(f"Recording {self.name}", f"channel {sensor}", channel, Channel, "a Channel")
            added = kinds()
            known = [*JOINT_SENSORS, *(k for k, of in added.items() if not of.placed)]
            placed = [*PLACED_SENSORS, *(k for k, of in added.items() if of.placed), "other"]
            if sensor not in known and not (where and kind in placed):
                names = dict.fromkeys([*known, *(f"{kind}:NAME" for kind in placed)])
                raise UnknownName("sensor", sensor, [*names])
            columns = PLACED_SENSORS.get(kind, len(channel.names))
            if len(channel.names) != columns:
                raise InputError(
                    f"Recording {self.name}: channel {sensor} has {len(channel.names)} columns, "
                    f"expected {columns}"
                )
        if self.end <= self.start:
            first = max(self.channels, key=lambda s: self.channels[s].t[0])
            last = min(self.channels, key=lambda s: self.channels[s].t[-1])
            raise InputError(
                f"Recording {self.name}: channel {first} begins at {self.start:g} s, after channel "
                f"{last} has ended ({self.end:g} s), expected clocks that count from one instant"
            )

    def _display_(self) -> Display:
        rows = []
        for sensor, x in self.channels.items():
            missing = int((~x.arrived).sum())
            names = value_text(tuple(map(str, x.names)), 40)
            rows.append((sensor, str(len(x.t)), f"{1 / x.step:.4g}", names, str(missing)))
        title = f"Recording {self.name!r}: {self.end - self.start:.4g} s"
        title += f", {plural(len(rows), 'channel')}"
        return Display(title, rows, ("sensor", "samples", "Hz", "columns", "missing"))

    @property
    def start_is_known(self) -> bool:
        """Whether the initial state is known exactly.

        It is known if `initial_state` is given, or if v has no sample except its first one.
        """
        if self.initial_state is not None:
            return True
        if "v" not in self.channels:
            return False
        arrived = self.channels["v"].arrived
        return bool(arrived[0].all() and not arrived[1:].any())

    def __getitem__(self, sensor: str) -> Channel:
        return self.channels[choice(f"channel of recording {self.name}", sensor, self.channels)]

    @property
    def start(self) -> float:
        """The earliest time in s at which all channels have samples."""
        return max(float(c.t[0]) for c in self.channels.values())

    @property
    def end(self) -> float:
        """The latest time in s at which all channels have samples."""
        return min(float(c.t[-1]) for c in self.channels.values())

    def check_model(self, model: Model) -> None:
        """Raise InputError or UnknownName unless the channels match the model.

        A joint channel has one column for each coordinate of the model (nq, nv or nu), or columns
        with the names of joints (actuators) that have one coordinate each.
        """
        for sensor, channel in self.channels.items():
            kind, _, where = sensor.partition(":")
            if sensor in JOINT_SENSORS:
                due, size = JOINT_SENSORS[sensor], getattr(model, JOINT_SENSORS[sensor])
                named = model.actuator_names if sensor == HELD else model.joint_names
                if len(channel.names) != size and not set(channel.names) <= set(named):
                    raise InputError(
                        f"Recording {self.name}: channel {sensor} has {len(channel.names)} columns "
                        f"({', '.join(channel.names)}), expected {size} (the model's {due}), or "
                        f"columns named after: {', '.join(named)}"
                    )
            elif kind == "pose" and where not in (*model.body_names, *model.site_names):
                known = [*model.body_names, *model.site_names]
                raise UnknownName(f"body or site of channel {sensor}", where, known)
            elif where and kind not in ("pose", "other") and where not in model.site_names:
                raise UnknownName(f"site of channel {sensor}", where, model.site_names)

    def on_clock(
        self, t: Any, *, gap: float | None = None, model: Model | None = None
    ) -> Recording:
        """Resample all channels at the same times.

        Commands hold their last value. Attitudes, in poses and in the q of ball and free joints,
        are interpolated by slerp. Other columns are interpolated by cubic splines with an error of
        order step^4. A value is NaN if its samples are too far apart (`gap`).

        Args:
            t: (samples,) times in s, within every channel's clock.
            gap: longest interval in s to interpolate, also across missing samples. None: 3 median
                steps of the clock, and no interpolation across missing samples.
            model: robot, which determines the quaternion columns of q. None: any four successive
                columns that vary and have length 1 at every sample.

        Raises:
            InputError: times outside of a channel's clock.
        """
        t = _floats("t", t)
        for sensor, c in self.channels.items():
            if t.ndim != 1 or len(t) < 2 or not (c.t[0] <= t[0] and t[-1] <= c.t[-1]):
                raise InputError(
                    f"Recording {self.name}.on_clock: t is from {t.min():g} to {t.max():g} s, "
                    f"expected (samples,) times that increase, from {c.t[0]:g} to {c.t[-1]:g} s, "
                    f"where channel {sensor} has samples"
                )
        channels = {}
        for sensor, c in self.channels.items():
            if sensor == HELD:
                values = c.values[np.searchsorted(c.t, t, side="right") - 1]
            else:
                turns = quaternion_columns(sensor, c.values, model)
                values = interpolate_columns(c.t, c.values, t, c.step, gap, turns)
            channels[sensor] = c.replace(t, values)
        return dataclasses.replace(self, channels=channels)

    def segment(self, t0: float, t1: float) -> Recording:
        """Select the samples from t0 to t1 in s. The command that is active at t0 moves to t0.

        Raises:
            InputError: a channel with fewer than two samples in that interval.
        """
        cut = {}
        for sensor, c in self.channels.items():
            keep = (t0 <= c.t) & (c.t <= t1)
            t, values = c.t[keep], c.values[keep]
            before = np.flatnonzero(c.t < t0)
            if sensor == HELD and len(before) and not (len(t) and t[0] == t0):
                t, values = np.append(t0, t), np.vstack([c.values[before[-1]], values])
            if len(t) < 2:
                raise InputError(
                    f"Recording {self.name}.segment: channel {sensor} has {len(t)} samples from "
                    f"{t0:g} to {t1:g} s, expected at least 2; the recording is from "
                    f"{self.start:g} to {self.end:g} s"
                )
            cut[sensor] = c.replace(t, values)
        first = self.initial_state if t0 <= self.start else None
        return Recording(f"{self.name}[{t0:g}:{t1:g}]", cut, self.source, first)

    def segments(self, seconds: float) -> list[Recording]:
        """Cut into successive segments of this length. A shorter rest at the end is dropped."""
        given: Any = seconds
        number = isinstance(given, (int, float, np.number)) and seconds > 0
        count = int((self.end - self.start) / seconds + 1e-9) if number else 0
        if count < 1:
            raise InputError(
                f"Recording {self.name}.segments: seconds is {seconds}, expected a positive length "
                f"of at most {self.end - self.start:g} s"
            )
        starts = [self.start + seconds * k for k in range(count)]
        return [self.segment(t0, t0 + seconds) for t0 in starts]

    def __iter__(self) -> Iterator[str]:
        return iter(self.channels)


def _floats(name: str, x: Any) -> np.ndarray:
    fix = "an array of numbers with rows of equal length"
    return real_array("Channel", name, x, fix, finite=False)


def _one_a_column(name: str, given: Any, columns: int) -> np.ndarray:
    """Convert one number or one number for each column to (columns,), and reject zeros."""
    x = np.array(np.nan) if np.asarray(given).dtype == bool else _floats(name, given)
    if x.shape not in ((), (1,), (columns,)) or not np.isfinite(x).all() or (x == 0).any():
        raise InputError(
            f"Channel: {name} is {x.tolist()}, expected one number other than 0, or {columns}, one "
            "a column"
        )
    return np.broadcast_to(x, (columns,)).copy()


def _mask(dropped: Any, shape: tuple[int, int]) -> np.ndarray:
    mask = np.asarray(False if dropped is None else dropped)
    if mask.dtype != bool:
        raise InputError(f"Channel: dropped has dtype {mask.dtype}, expected bool")
    if mask.shape not in ((), shape[:1], shape):
        raise InputError(
            f"Channel: dropped has shape {mask.shape}, expected {shape[:1]} or {shape}"
        )
    return np.broadcast_to(mask[:, None] if mask.ndim == 1 else mask, shape)


def _check_clock(t: np.ndarray) -> None:
    if not np.isfinite(t).all():
        i = int(np.flatnonzero(~np.isfinite(t))[0])
        raise InputError(f"Channel: t is {t[i]} at sample {i}, expected finite times in s")
    steps = np.diff(t)
    wrong = np.flatnonzero(steps <= 0)
    if len(wrong):
        i = int(wrong[0])
        what = "stands still" if steps[i] == 0 else "goes back"
        raise InputError(
            f"Channel: the clock {what} at sample {i + 1} (t = {t[i]:g} s, then {t[i + 1]:g} s), "
            f"and at {len(wrong)} samples in all, expected times that increase; leave out samples "
            "that came twice"
        )


def noise_is_stated(runs: Sequence[Recording], sensor: str) -> bool:
    """Check whether every recording states the noise of a sensor."""
    return all(run[sensor].noise is not None for run in runs)
