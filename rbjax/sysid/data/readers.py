"""The reader of recordings from text tables and npz files.

A mapping defines the sensor, joint and unit of each column. Sensors at several rates may share one
table: a row with blanks in all columns of a sensor has no sample of this sensor.
"""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbjax.arguments import choice, existing_file, instance, real_number
from rbjax.errors import InputError, RbjaxError, UnknownName
from rbjax.sysid.data.recording import Channel, Recording
from rbjax.sysid.data.units import OF_SENSORS, TIME, in_si

WHERE = "read_recording"


class Column(NamedTuple):
    """The meaning of a column of a file, or of an array with several columns.

    Fields:
        sensor: name of the sensor, such as "q" or "gyro:imu".
        joint: name of the joint, or one name for each column of an array. None: the name of the
            column.
        unit: unit of the values, as in `Channel`.
        scale: factor of the values, as in `Channel`.
        sign: 1 or -1, as in `Channel`.
        noise: standard deviation in SI. State it for all columns of a sensor, or for none.
        time: name of the column with the clock. None: the clock of the file.
    """

    sensor: str
    joint: str | Sequence[str] | None = None
    unit: str = ""
    scale: float = 1.0
    sign: int = 1
    noise: float | None = None
    time: str | None = None


def read_recording(
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
    """Read a recording from a text table, or from the arrays of a file .npz.

    The header of a table is the first line that contains all requested names. Lines above it and
    comments are skipped. Blank cells and "nan" are missing samples. Each row must have as many
    cells as the header. An array has shape (samples,) or (samples, columns), with NaN for a missing
    sample. For several columns `joint` has one name for each, or is the name of an array of names
    in the file.

    Args:
        path: path of the file.
        columns: name in the header, or of an array -> `Column`, or its fields as a tuple: ("q",
            "elbow", "deg").
        time: name of the clock's column or array.
        time_unit: unit of the clock.
        rate: sample rate in Hz for a file without a clock. The time is row / rate.
        delimiter: delimiter between the cells of a table. None: detect it.
        decimal: decimal mark of a table, "." or ",".
        comment: prefix of lines of a table to skip.
        name: name of the recording. None: the name of the file.

    Returns:
        `Recording`.

    Raises:
        InputError: no such file, a cell that is not a number, or invalid data (`Channel`,
            `Recording`).
        UnknownName: a name that is not in the file.

    Example:
        >>> import pathlib, tempfile
        >>> from rbjax.sysid import read_recording
        >>> path = pathlib.Path(tempfile.mkdtemp(), "run.csv")
        >>> _ = path.write_text("# bench 3\\nms;elbow\\n0;90\\n5;180\\n")
        >>> run = read_recording(path, {"elbow": ("q", "elbow", "deg")}, time="ms", time_unit="ms")
        >>> run["q"].t.tolist(), run["q"].values.ravel().round(2).tolist()
        ([0.0, 0.005], [1.57, 3.14])
    """
    path = existing_file(WHERE, path)
    wanted = _columns(columns)
    choice("decimal mark", decimal, (".", ","))
    one = isinstance(delimiter, str) and len(delimiter) == 1 and delimiter not in '\r\n"'
    if not (delimiter is None or one):
        raise InputError(
            f'{WHERE}: delimiter is {delimiter!r}, expected one character such as ";", or None'
        )
    instance(WHERE, "comment", comment, str, 'a text such as "#"')
    clocks = _clocks(wanted, time, time_unit, rate)
    if path.suffix == ".npz":
        table = _arrays(path, wanted, clocks)
    else:
        table = _text(path, [*wanted, *sorted(clocks)], delimiter, decimal, comment)
    return _recording(name or path.stem, table, wanted, time, time_unit, rate)


def _text(
    path: Path, names: Sequence[str], delimiter: str | None, decimal: str, comment: str
) -> dict[str, np.ndarray]:
    """Read columns of a text table."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{WHERE}: {path.name} is not a text file in UTF-8 ({error}), expected a table of text"
        ) from error
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not (comment and line.lstrip().startswith(comment))
    ]
    try:
        rows = _cells(path, lines, delimiter)
    except csv.Error as error:
        raise InputError(f"{WHERE}: {path.name} is not a table of cells: {error}") from error
    return _table(path, rows, names, decimal)


def _arrays(path: Path, wanted: dict[str, Column], clocks: set[str]) -> dict[str, np.ndarray]:
    """Read arrays of a file of NumPy. A joint that names an array of names becomes these names."""
    try:
        # `ZipFile` rejects an npy file
        with zipfile.ZipFile(path), np.load(path, allow_pickle=False) as file:
            for n in (*wanted, *clocks):
                choice(f"array of {path.name}", n, file.files)
            table = {n: _array(path, n, file[n]) for n in (*wanted, *clocks)}
            for n, c in wanted.items():
                if isinstance(c.joint, str) and c.joint in file.files:
                    wanted[n] = c._replace(joint=tuple(map(str, np.ravel(file[c.joint]))))
    except RbjaxError:
        raise
    except Exception as error:  # a damaged archive may raise anything
        raise InputError(
            f"{WHERE}: {path.name} cannot be read ({str(error)[:200]}), expected a file of "
            "numpy.savez with arrays of numbers; pickled objects are not read"
        ) from error
    return table


def _recording(
    name: str,
    table: Mapping[str, np.ndarray],
    wanted: Mapping[str, Column],
    time: str,
    time_unit: str,
    rate: float | None,
) -> Recording:
    """Convert a table of numbers to a recording."""
    channels = {}
    for sensor in dict.fromkeys(c.sensor for c in wanted.values()):
        parts = [(n, c) for n, c in wanted.items() if c.sensor == sensor]
        clocks = {c.time or time for _, c in parts}
        if len(clocks) > 1:
            raise InputError(
                f"{WHERE}: the columns of {sensor} have the clocks {', '.join(sorted(clocks))}, "
                "expected one clock a sensor"
            )
        names: list[str] = []
        each: list[Column] = []
        for n, c in parts:
            count = 1 if table[n].ndim == 1 else table[n].shape[1]
            own = [n] if count == 1 else [f"{n}[{k}]" for k in range(count)]
            if c.joint is not None:
                own = [c.joint] if isinstance(c.joint, str) else list(c.joint)
            if len(own) != count:
                raise InputError(
                    f"{WHERE}: {n} has {count} columns, expected {len(own)}, one for each of "
                    f"{', '.join(own)}"
                )
            names += own
            each += [c] * count
        noise: list[Any] = [c.noise for c in each]
        if None in noise and any(sigma is not None for sigma in noise):
            raise InputError(
                f"{WHERE}: some columns of {sensor} state their noise and "
                f"{names[noise.index(None)]} does not, expected noise of all columns of a sensor, "
                "or of none"
            )
        x = np.column_stack([table[n] for n, _ in parts])
        t = np.arange(len(x)) / rate if rate is not None else table[clocks.pop()] * in_si(time_unit)
        if len(t) == len(x):
            some = ~np.isnan(x).all(1)
            t, x = t[some], x[some]
        try:
            channels[sensor] = Channel(
                t, x, names, [c.unit for c in each], [c.scale for c in each],
                [c.sign for c in each], None if None in noise else noise, "nan",
            )  # fmt: skip
        except InputError as error:
            raise InputError(f"{WHERE}: {name}, sensor {sensor}: {error}") from error
    return Recording(name, channels)


def _columns(columns: Mapping[str, Any]) -> dict[str, Column]:
    """Check the columns, and convert them to `Column`."""
    example = '{"angle": ("q", "elbow", "deg")}'
    if not isinstance(columns, Mapping) or not columns:
        raise InputError(f"{WHERE}: columns is {columns!r}, expected a dict such as {example}")
    out = {}
    for n, given in columns.items():
        at = f"{WHERE}: columns[{n!r}]"
        if not isinstance(given, tuple) or not 1 <= len(given) <= len(Column._fields):
            raise InputError(
                f"{at} is {given!r}, expected a Column or the fields of one "
                f"({', '.join(Column._fields)}), as in {example}"
            )
        out[n] = c = Column(*given)
        if not isinstance(c.sensor, str) or not c.sensor:
            raise InputError(f'{at} has sensor {c.sensor!r}, expected a name such as "q"')
        joints = [c.joint or ""] if isinstance(c.joint, str | None) else c.joint
        if not isinstance(joints, (list, tuple)) or not all(isinstance(j, str) for j in joints):
            raise InputError(
                f"{at} has joint {c.joint!r}, expected a joint's name, or a list of them"
            )
        if not (c.time is None or isinstance(c.time, str)):
            raise InputError(f"{at} has time {c.time!r}, expected the name of a column")
        in_si(c.unit)
        suited = OF_SENSORS.get(c.sensor.partition(":")[0])
        if c.unit and suited is not None:
            choice(f"unit of sensor {c.sensor}", c.unit, suited)
    return out


def _clocks(wanted: Mapping[str, Column], time: Any, time_unit: Any, rate: Any) -> set[str]:
    """Check time, time_unit and rate, and return the names of the clocks, none if rate is given."""
    if rate is not None:
        real_number(WHERE, "rate", rate, "a positive number of Hz", above=0.0)
        return set()
    instance(WHERE, "time", time, str, "the name of the clock")
    choice("unit of time", time_unit, TIME)
    return {c.time or time for c in wanted.values()}


def _array(path: Path, name: str, x: np.ndarray) -> np.ndarray:
    """Check an array of a file, and convert it to float."""
    if x.dtype.kind not in "biuf" or x.ndim not in (1, 2):
        raise InputError(
            f"{WHERE}: array {name} of {path.name} has dtype {x.dtype} and shape {x.shape}, "
            "expected numbers, (samples,) or (samples, columns)"
        )
    return x.astype(float)


def _cells(
    path: Path, lines: Sequence[tuple[int, str]], delimiter: str | None
) -> list[tuple[int, list[str]]]:
    """Split numbered lines into cells."""
    if delimiter is None:
        sample = "\n".join(line for _, line in lines[:20])
        try:
            delimiter = csv.Sniffer().sniff(sample, ",;\t|").delimiter
        except csv.Error:  # the sniffer needs the same number on each line
            delimiter = max(",;\t|", key=sample.count)
        if delimiter not in sample:
            delimiter = " "
    parsed = [
        *csv.reader((x for _, x in lines), delimiter=delimiter, skipinitialspace=delimiter == " ")
    ]
    if len(parsed) < len(lines):
        raise csv.Error(f"line {lines[len(parsed) - 1][0]} opens a quotation that does not end")
    return [(n, [x.strip() for x in row]) for (n, _), row in zip(lines, parsed, strict=True)]


def _table(
    path: Path, rows: Sequence[tuple[int, list[str]]], names: Sequence[str], decimal: str
) -> dict[str, np.ndarray]:
    """Parse the numbers in the columns with these names."""
    head = [row for _, row in rows[:20]]
    if not head:
        raise InputError(f"{WHERE}: {path.name} has no rows, expected a header and numbers")
    at = next((k for k, row in enumerate(head) if set(names) <= set(row)), None)
    if at is None:
        likeliest = max(head, key=lambda row: (len(set(names) & set(row)), -head.index(row)))
        missing = next(n for n in names if n not in likeliest)
        raise UnknownName(f"column of {path.name}", missing, likeliest)
    last = max(i for i, cell in enumerate(head[at]) if cell)  # a line may end with a delimiter
    header, body = head[at][: last + 1], rows[at + 1 :]
    for name in names:
        if header.count(name) > 1:
            raise InputError(
                f"{WHERE}: {path.name} has {header.count(name)} columns called {name!r}, expected "
                "different names for the columns that are read"
            )
    if not body:
        raise InputError(f"{WHERE}: {path.name} has no rows below its header, expected numbers")
    for line, row in body:
        if len(row) < len(header) or any(row[len(header) :]):
            raise InputError(
                f"{WHERE}: {path.name}, line {line} has {len(row)} cells, expected {len(header)} "
                "as the header has; a decimal comma needs decimal = ',', and a sample that did not "
                "arrive is a blank cell between delimiters"
            )
    table = {name: np.full(len(body), np.nan) for name in names}
    for name, out in table.items():
        column = header.index(name)
        for k, (line, row) in enumerate(body):
            try:
                out[k] = float(row[column].replace(decimal, ".") or "nan")
            except ValueError as error:
                raise InputError(
                    f"{WHERE}: {path.name}, line {line}, column {name}: got {row[column]!r}, "
                    "expected a number, or a blank cell where no sample arrived"
                ) from error
    return table
