"""Readers: csv and npz files into a `Recording`.

A mapping says which column of the file is which sensor, joint and unit. Everything else of the file
is not read. Sensors at several rates may share one table: a row in which all columns of a sensor
are blank holds no sample of it.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbjax.errors import InputError, UnknownName, listed
from rbjax.sysid.recording import Channel, Recording
from rbjax.sysid.units import in_si


class Column(NamedTuple):
    """What a column of a file, or an array with several columns, measures.

    Fields: sensor, such as "q" or "gyro:imu"; joint, the column's name, or one name a column; unit,
    scale, sign, noise, as in `Channel`; time, the column with its clock, if not the file's.
    """

    sensor: str
    joint: str | Sequence[str] | None = None
    unit: str = ""
    scale: float = 1.0
    sign: int = 1
    noise: float | None = None
    time: str | None = None


def read_csv(
    path: str | Path,
    columns: Mapping[str, Any],
    *,
    time: str = "t",
    time_unit: str = "s",
    rate: float | None = None,
    delimiter: str | None = None,
    decimal: str = ".",
    comment: str = "#",
    name: str | None = None,
) -> Recording:
    """A recording from a table of text.

    The header is the first line that holds all the names asked for; lines above it and comments
    are skipped. Blank cells and "nan" are samples that did not arrive.

    Args:
        path: of the file.
        columns: name in the header -> `Column`, or its fields as a tuple: ("q", "elbow", "deg").
        time: name of the clock's column.
        time_unit: of the clock.
        rate: in Hz: the clock is row / rate, and no column is read for it.
        delimiter: between cells; found by itself if None.
        decimal: "." or ",".
        comment: lines that start so are skipped.
        name: of the recording; the file's if None.

    Returns:
        `Recording`.

    Raises:
        InputError: no such file, no such columns, a cell that is no number, and all that `Channel`
            and `Recording` refuse.
        UnknownName: a name that is not in the header.

    Example:
        >>> import pathlib, tempfile
        >>> from rbjax.sysid import read_csv
        >>> path = pathlib.Path(tempfile.mkdtemp(), "run.csv")
        >>> _ = path.write_text("# bench 3\\nms;elbow\\n0;90\\n5;180\\n")
        >>> run = read_csv(path, {"elbow": ("q", "elbow", "deg")}, time="ms", time_unit="ms")
        >>> run["q"].t.tolist(), run["q"].values.ravel().round(2).tolist()
        ([0.0, 0.005], [1.57, 3.14])
    """
    path = _file("read_csv", path)
    wanted = _columns("read_csv", columns)
    clocks = {c.time or time for c in wanted.values()} if rate is None else set()
    lines = [
        (number, line)
        for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1)
        if line.strip() and not line.lstrip().startswith(comment)
    ]
    rows = _cells(path, lines, delimiter)
    header, body = _header(path, rows, [*wanted, *sorted(clocks)])
    table = {
        n: _numbers(path, n, header.index(n), body, decimal) for n in (*wanted, *sorted(clocks))
    }
    return _recording(name or path.stem, "read_csv", table, wanted, time, time_unit, rate)


def read_npz(
    path: str | Path,
    columns: Mapping[str, Any],
    *,
    time: str = "t",
    time_unit: str = "s",
    rate: float | None = None,
    name: str | None = None,
) -> Recording:
    """A recording from the arrays of an npz file.

    Args:
        path: of the file.
        columns: name of an array -> `Column`, or its fields as a tuple. An array is (samples,), or
            (samples, columns), where `joint` is the name of each column, or the name of an array
            of the file that holds them. NaN is a sample that did not arrive.
        time: name of the clock's array.
        time_unit: of the clock.
        rate: in Hz: the clock is k / rate, and no array is read for it.
        name: of the recording; the file's if None.

    Returns:
        `Recording`.

    Raises:
        InputError: no such file, and all that `Channel` and `Recording` refuse.
        UnknownName: a name that the file does not hold.

    Example:
        >>> import numpy as np, pathlib, tempfile
        >>> from rbjax.sysid import read_npz
        >>> path = pathlib.Path(tempfile.mkdtemp(), "run.npz")
        >>> np.savez(path, angle=np.ones((50, 2)), joints=["hip", "knee"])
        >>> run = read_npz(path, {"angle": ("q", "joints", "deg")}, rate=100)
        >>> run["q"].names, run.end
        (('hip', 'knee'), 0.49)
    """
    path = _file("read_npz", path)
    wanted = _columns("read_npz", columns)
    with np.load(path, allow_pickle=False) as file:
        clocks = {c.time or time for c in wanted.values()} if rate is None else set()
        for n in (*wanted, *clocks):
            if n not in file.files:
                raise UnknownName(f"array of {path.name}", n, file.files)
        table = {n: _array(path, n, file[n]) for n in (*wanted, *clocks)}
        for n, c in wanted.items():
            if isinstance(c.joint, str) and c.joint in file.files:
                wanted[n] = c._replace(joint=tuple(map(str, file[c.joint])))
    return _recording(name or path.stem, "read_npz", table, wanted, time, time_unit, rate)


def _recording(
    name: str,
    where: str,
    table: Mapping[str, np.ndarray],
    wanted: Mapping[str, Column],
    time: str,
    time_unit: str,
    rate: float | None,
) -> Recording:
    if rate is not None and not rate > 0:
        raise InputError(f"{where}: rate is {rate}, expected a positive number of Hz")
    channels = {}
    for sensor in dict.fromkeys(c.sensor for c in wanted.values()):
        parts = [(n, c) for n, c in wanted.items() if c.sensor == sensor]
        clocks = {c.time or time for _, c in parts}
        if len(clocks) > 1:
            raise InputError(
                f"{where}: the columns of {sensor} have the clocks {', '.join(sorted(clocks))}, "
                "expected one clock a sensor"
            )
        values: list[np.ndarray] = []
        names: list[str] = []
        noises: list[float | None] = []
        for n, c in parts:
            x = table[n] if table[n].ndim > 1 else table[n][:, None]
            if c.joint is not None:
                own = [c.joint] if isinstance(c.joint, str) else list(c.joint)
            else:
                own = [n] if x.shape[1] == 1 else [f"{n}[{k}]" for k in range(x.shape[1])]
            if len(own) != x.shape[1]:
                raise InputError(
                    f"{where}: {n} has {x.shape[1]} columns, expected {len(own)}, one for each of "
                    f"{', '.join(own)}"
                )
            names += own
            values.append(x * (in_si(c.unit) * c.scale * c.sign))
            noises += [c.noise] * len(own)
        x = np.concatenate(values, 1)
        clock = next(iter(clocks))
        t = np.arange(len(x)) / rate if rate is not None else table[clock] * in_si(time_unit)
        some = ~np.isnan(x).all(1)
        if len(t) == len(x):
            t, x = t[some], x[some]
        noise = None if None in noises else noises
        try:
            channels[sensor] = Channel(t, x, names, noise=noise, dropped="nan")
        except InputError as error:
            raise InputError(f"{where}: {name}, sensor {sensor}: {error}") from error
    return Recording(name, channels)


def _columns(where: str, columns: Mapping[str, Any]) -> dict[str, Column]:
    example = '{"angle": ("q", "elbow", "deg")}'
    if not isinstance(columns, Mapping) or not columns:
        raise InputError(f"{where}: columns is {columns!r}, expected a dict such as {example}")
    out = {}
    for n, c in columns.items():
        if not isinstance(c, tuple) or not 1 <= len(c) <= len(Column._fields):
            raise InputError(
                f"{where}: columns[{n!r}] is {c!r}, expected a Column or the fields of one "
                f"({', '.join(Column._fields)}), as in {example}"
            )
        out[n] = Column(*c)
        if out[n].sign not in (1, -1) or not np.isfinite(out[n].scale) or not out[n].scale:
            raise InputError(
                f"{where}: columns[{n!r}] has scale {out[n].scale} and sign {out[n].sign}, "
                "expected a factor other than 0, and 1 or -1"
            )
    return out


def _file(where: str, path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))
        raise InputError(
            f"{where}: no file {path}; in {path.parent} there are: {listed(beside, 8) or 'none'}"
        )
    return path


def _array(path: Path, name: str, x: np.ndarray) -> np.ndarray:
    if x.dtype.kind not in "biuf" or x.ndim not in (1, 2):
        raise InputError(
            f"read_npz: array {name} of {path.name} has dtype {x.dtype} and shape {x.shape}, "
            "expected numbers, (samples,) or (samples, columns)"
        )
    return x.astype(float)


def _cells(
    path: Path, lines: Sequence[tuple[int, str]], delimiter: str | None
) -> list[tuple[int, list[str]]]:
    if delimiter is None:
        sample = "\n".join(line for _, line in lines[:20])
        try:
            delimiter = csv.Sniffer().sniff(sample, ",;\t|").delimiter
        except csv.Error:  # the sniffer wants the same number on each line
            delimiter = max(",;\t|", key=sample.count)
        if delimiter not in sample:
            delimiter = " "
    together = delimiter == " "
    parsed = csv.reader((x for _, x in lines), delimiter=delimiter, skipinitialspace=together)
    return [(n, [x.strip() for x in row]) for (n, _), row in zip(lines, parsed, strict=True)]


def _header(
    path: Path, rows: Sequence[tuple[int, list[str]]], names: Iterable[str]
) -> tuple[list[str], Sequence[tuple[int, list[str]]]]:
    """The names of the columns, and the rows below them."""
    head = [row for _, row in rows[:20]]
    for k, row in enumerate(head):
        if set(names) <= set(row):
            return row, rows[k + 1 :]
    if not head:
        raise InputError(f"read_csv: {path.name} has no rows, expected a header and numbers")
    likeliest = max(head, key=lambda row: (len(set(names) & set(row)), -head.index(row)))
    missing = next(n for n in names if n not in likeliest)
    raise UnknownName(f"column of {path.name}", missing, likeliest)


def _numbers(
    path: Path, name: str, at: int, body: Sequence[tuple[int, list[str]]], decimal: str
) -> np.ndarray:
    out = np.empty(len(body))
    for k, (line, row) in enumerate(body):
        cell = row[at] if at < len(row) else ""
        try:
            out[k] = float(cell.replace(decimal, ".")) if cell else np.nan
        except ValueError as error:
            raise InputError(
                f"read_csv: {path.name}, line {line}, column {name}: got {cell!r}, expected a "
                "number, or a blank cell where no sample arrived"
            ) from error
    return out
