"""Readers: csv and npz files into a `Recording`.

A mapping says which column of the file is which sensor, joint and unit. Everything else of the file
is not read. Sensors at several rates may share one table: a row in which all columns of a sensor
are blank holds no sample of it.
"""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbjax.errors import InputError, RbjaxError, UnknownName, listed
from rbjax.sysid.data.recording import Channel, Recording
from rbjax.sysid.data.units import OF_SENSORS, TIME, in_si


class Column(NamedTuple):
    """What a column of a file, or an array with several columns, measures.

    Fields:
        sensor: such as "q" or "gyro:imu".
        joint: the joint's name, or one name a column of an array; the column's name if None.
        unit, scale, sign: as in `Channel`.
        noise: standard deviation in SI; for all columns of a sensor, or for none.
        time: the column with its clock; the file's clock if None.
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

    The header is the first line that contains all requested names; lines above it and comments are
    skipped. Blank cells and "nan" are samples that did not arrive. Each row must have as many cells
    as the header.

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
    _characters(delimiter, decimal, comment)
    clocks = _clocks("read_csv", wanted, time, time_unit, rate)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"read_csv: {path.name} is not a text file in UTF-8 ({error}), expected a table of text"
        ) from error
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not (comment and line.lstrip().startswith(comment))
    ]
    try:
        rows = _cells(path, lines, delimiter)
    except csv.Error as error:
        raise InputError(f"read_csv: {path.name} is not a table of cells: {error}") from error
    header, body = _header(path, rows, [*wanted, *sorted(clocks)])
    _whole(path, header, body, [*wanted, *sorted(clocks)])
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
    clocks = _clocks("read_npz", wanted, time, time_unit, rate)
    try:
        # `ZipFile` rejects an npy file
        with zipfile.ZipFile(path), np.load(path, allow_pickle=False) as file:
            for n in (*wanted, *clocks):
                if n not in file.files:
                    raise UnknownName(f"array of {path.name}", n, file.files)
            table = {n: _array(path, n, file[n]) for n in (*wanted, *clocks)}
            for n, c in wanted.items():
                if isinstance(c.joint, str) and c.joint in file.files:
                    wanted[n] = c._replace(joint=tuple(map(str, np.ravel(file[c.joint]))))
    except RbjaxError:
        raise
    except Exception as error:  # a damaged archive may raise anything
        raise InputError(
            f"read_npz: {path.name} cannot be read ({str(error)[:200]}), expected a file of "
            "numpy.savez with arrays of numbers; pickled objects are not read"
        ) from error
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
        if None in noises and any(x is not None for x in noises):
            without = names[noises.index(None)]
            raise InputError(
                f"{where}: some columns of {sensor} state their noise and {without} does not, "
                "expected noise of all columns of a sensor, or of none"
            )
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
        _check_column(f"{where}: columns[{n!r}]", out[n])
    return out


def _check_column(where: str, c: Column) -> None:
    if not isinstance(c.sensor, str) or not c.sensor:
        raise InputError(f'{where} has sensor {c.sensor!r}, expected a name such as "q"')
    joints = [c.joint] if isinstance(c.joint, str) or c.joint is None else c.joint
    if not isinstance(joints, (list, tuple)) or not all(
        isinstance(j, str) or c.joint is None for j in joints
    ):
        raise InputError(
            f"{where} has joint {c.joint!r}, expected a joint's name, or a list of them"
        )
    numbers = {"scale": c.scale, "sign": c.sign, "noise": 1.0 if c.noise is None else c.noise}
    for name, x in numbers.items():
        if isinstance(x, bool) or not isinstance(x, (int, float, np.number)):
            raise InputError(f"{where} has {name} {x!r}, expected a number")
    if c.sign not in (1, -1) or not np.isfinite(c.scale) or not c.scale:
        raise InputError(
            f"{where} has scale {c.scale} and sign {c.sign}, expected a factor other than 0, and "
            "1 or -1"
        )
    if not 0 < numbers["noise"] < np.inf:
        raise InputError(f"{where} has noise {c.noise}, expected a standard deviation above 0")
    if not (c.time is None or isinstance(c.time, str)):
        raise InputError(f"{where} has time {c.time!r}, expected the name of a column")
    in_si(c.unit)
    suited = OF_SENSORS.get(c.sensor.partition(":")[0])
    if c.unit and suited is not None and c.unit not in suited:
        raise UnknownName(f"unit of sensor {c.sensor}", c.unit, suited)


def _clocks(
    where: str, wanted: Mapping[str, Column], time: Any, time_unit: Any, rate: Any
) -> set[str]:
    """Check time, time_unit and rate. Return the names of the clocks; none with a rate."""
    if rate is None:
        if not isinstance(time, str):
            raise InputError(f"{where}: time is {time!r}, expected the name of the clock")
        if time_unit not in TIME:
            raise UnknownName("unit of time", time_unit, TIME)
        return {c.time or time for c in wanted.values()}
    number = isinstance(rate, (int, float, np.number)) and not isinstance(rate, bool)
    if not number or not 0 < rate < np.inf:
        raise InputError(f"{where}: rate is {rate!r}, expected a positive number of Hz")
    return set()


def _characters(delimiter: Any, decimal: Any, comment: Any) -> None:
    one = delimiter is None or (isinstance(delimiter, str) and len(delimiter) == 1)
    if not one or (delimiter is not None and delimiter in '\r\n"'):
        raise InputError(
            f'read_csv: delimiter is {delimiter!r}, expected one character such as ";", or None'
        )
    if decimal not in (".", ","):
        raise InputError(f'read_csv: decimal is {decimal!r}, expected "." or ","')
    if not isinstance(comment, str):
        raise InputError(f'read_csv: comment is {comment!r}, expected a text such as "#"')


def _whole(
    path: Path, header: Sequence[str], body: Sequence[tuple[int, list[str]]], names: Sequence[str]
) -> None:
    """`InputError` unless names of the header are unique, and rows as long as the header."""
    for name in names:
        if header.count(name) > 1:
            raise InputError(
                f"read_csv: {path.name} has {header.count(name)} columns called {name!r}, expected "
                "different names for the columns that are read"
            )
    if not body:
        raise InputError(f"read_csv: {path.name} has no rows below its header, expected numbers")
    for line, row in body:
        if len(row) < len(header) or any(row[len(header) :]):
            raise InputError(
                f"read_csv: {path.name}, line {line} has {len(row)} cells, expected {len(header)} "
                "as the header has; a decimal comma needs decimal = ',', and a sample that did not "
                "arrive is a blank cell between delimiters"
            )


def _file(where: str, path: str | Path) -> Path:
    try:
        path = Path(path)
        there = path.is_file()
    except (OSError, TypeError, ValueError) as error:
        text = f"{str(path)[:60]!r} ({type(error).__name__})"
        raise InputError(f"{where}: path is {text}, expected the path of a file") from error
    if not there:
        others = sorted(p.name for p in path.parent.glob(f"*{path.suffix}"))
        raise InputError(
            f"{where}: no file {path}; in {path.parent} there are: {listed(others, 8) or 'none'}"
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
            last = max(i for i, cell in enumerate(row) if cell)  # a line may end with a delimiter
            return row[: last + 1], rows[k + 1 :]
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
