"""Bad recordings as files: each is named by an error of rbjax, none is read in silence."""

import io

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from rbjax.errors import InputError, UnknownName
from rbjax.sysid import Column, read_recording
from tests.sysid.test_bad_jobs import MANY, never_bare

WANTED = {"a": Column("q", "hip", "deg"), "i": Column("tau", "hip")}
ROWS = [["0", "1", "5"], ["0.1", "2", "6"], ["0.2", "3", "7"], ["0.3", "4", "8"]]
HEAD = ["t", "a", "i"]


@st.composite
def bad_tables(draw):
    """Bytes of a csv file with one thing wrong."""
    head, rows = list(HEAD), [list(row) for row in ROWS]
    k, j = draw(st.integers(0, 3)), draw(st.integers(0, 2))
    what = draw(st.sampled_from([
        "word", "word", "short", "long", "name", "twice", "clock", "clock", "infinite", "empty",
        "head", "one row", "bytes", "delimiter", "comma", "no clock",
    ]))  # fmt: skip
    if what == "word":
        rows[k][j] = draw(st.sampled_from(["x", "1,2.3.4", "--", "1e", "0x1", "1 2", "NV", "'1'"]))
        rows[k][j] = rows[k][j].replace(",", "")
    elif what == "short":
        rows[k] = rows[k][: draw(st.integers(1, 2))]
    elif what == "long":
        rows[k].append("9")
    elif what == "name":
        head[j] += draw(st.sampled_from(["x", "_", "2"]))
    elif what == "twice":
        head.append(head[j])
        rows = [[*row, "1"] for row in rows]
    elif what == "clock":
        later = k or 1
        rows[later][0] = draw(st.sampled_from([rows[later - 1][0], "-1", "nan", "inf", "-inf"]))
    elif what == "no clock":
        rows[k][0] = ""
    elif what == "infinite":
        rows[k][1 + j % 2] = draw(st.sampled_from(["inf", "-inf", "1e999"]))
    elif what == "empty":
        return b""
    elif what == "head":
        rows = []
    elif what == "one row":
        rows = rows[:1]
    elif what == "bytes":
        return draw(st.binary(min_size=1, max_size=60))
    elif what == "delimiter":
        text = "\n".join(",".join(row) for row in [head, *rows])
        return text.replace(",", draw(st.sampled_from(["/", "&", "::", "-"]))).encode()
    elif what == "comma":  # decimal commas in a table of commas
        rows = [[x if "." in x else f"{x}.5" for x in row] for row in rows]
        return "\n".join(",".join(row).replace(".", ",") for row in [head, *rows]).encode()
    return "\n".join(",".join(row) for row in [head, *rows]).encode()


@st.composite
def bad_archives(draw):
    """Bytes of an npz file with one thing wrong."""
    arrays = {"t": np.arange(4) * 0.1, "a": np.ones((4, 1)), "i": np.arange(4.0)}
    name = draw(st.sampled_from(sorted(arrays)))
    what = draw(st.sampled_from([
        "missing", "kind", "shape", "length", "clock", "infinite", "cut", "bytes", "npy", "object",
    ]))  # fmt: skip
    if what == "missing":
        arrays.pop(name)
    elif what == "kind":
        arrays[name] = draw(st.sampled_from([np.array(list("abcd")), np.ones(4) * 1j]))
    elif what == "shape":
        arrays[name] = draw(st.sampled_from([np.ones((4, 2)), np.ones((4, 1, 1)), np.array(1.0)]))
        if name == "t":
            arrays["t"] = np.ones((4, 1, 1))
    elif what == "length":
        arrays[name] = np.arange(draw(st.sampled_from([0, 1, 3, 5])) * 1.0)
        if name == "t":
            arrays["t"] = arrays["t"] + 0.0
    elif what == "clock":
        arrays["t"] = draw(st.sampled_from([
            np.zeros(4), np.arange(4)[::-1], np.full(4, np.nan), np.array([0, 1, np.inf, 3]),
        ]))  # fmt: skip
    elif what == "infinite":
        arrays["i"] = np.array([0, np.inf, 1, 2])
    elif what == "object":
        arrays[name] = np.array([1, None, 2, 3], object)
    file = io.BytesIO()
    np.savez(file, **arrays)
    content = file.getvalue()
    if what == "cut":
        return content[: draw(st.integers(0, len(content) - 1))]
    if what == "bytes":
        return draw(st.binary(max_size=60))
    if what == "npy":
        file = io.BytesIO()
        np.save(file, arrays["i"])
        return file.getvalue()
    return content


def bad_file(folder, content, suffix):
    path = folder / f"run.{suffix}"
    path.write_bytes(content)
    never_bare(lambda: read_recording(path, WANTED))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("data")


def test_the_files_that_are_spoilt_are_good(folder):
    (folder / "run.csv").write_text("\n".join(",".join(row) for row in [HEAD, *ROWS]))
    assert read_recording(folder / "run.csv", WANTED)["tau"].values.ravel().tolist() == [5, 6, 7, 8]


@MANY
@hypothesis.given(content=bad_tables())
def test_150_bad_tables_are_named(folder, content):
    bad_file(folder, content, "csv")


@MANY
@hypothesis.given(content=bad_archives())
def test_150_bad_archives_are_named(folder, content):
    bad_file(folder, content, "npz")


@pytest.mark.parametrize(
    "column",
    [
        {"sensor": 5}, {"sensor": ""}, {"sensor": "nope"}, {"joint": 5}, {"joint": [1]},
        {"unit": "furlong"}, {"unit": 5}, {"unit": "N m"}, {"scale": 0}, {"scale": np.nan},
        {"scale": "x"}, {"scale": True}, {"sign": 0}, {"sign": 5}, {"sign": "-1"}, {"noise": 0.0},
        {"noise": -1}, {"noise": np.nan}, {"noise": np.inf}, {"noise": "x"}, {"time": 5},
    ],
    ids=str,
)  # fmt: skip
def test_bad_columns_are_named(folder, column):
    (folder / "run.csv").write_text("\n".join(",".join(row) for row in [HEAD, *ROWS]))
    wanted = {"a": Column("q", "hip")._replace(**column)}
    never_bare(lambda: read_recording(folder / "run.csv", wanted))


@pytest.mark.parametrize(
    "how",
    [
        {"rate": 0}, {"rate": -1}, {"rate": np.nan}, {"rate": np.inf}, {"rate": "x"}, {"time": 5},
        {"time": "x"}, {"time_unit": "deg"}, {"time_unit": 5}, {"delimiter": ""},
        {"delimiter": ";;"}, {"delimiter": 5}, {"delimiter": "\n"}, {"decimal": ";"},
        {"decimal": 5}, {"comment": 5}, {"path": 5}, {"path": "x" * 5000}, {"path": "a\0b"},
        {"columns": 5}, {"columns": {"a": 5}}, {"columns": {"a": ()}},
    ],
    ids=lambda how: str(how)[:40],
)  # fmt: skip
def test_bad_arguments_are_named(folder, how):
    (folder / "run.csv").write_text("\n".join(",".join(row) for row in [HEAD, *ROWS]))
    given = {"path": folder / "run.csv", "columns": WANTED} | how
    path, columns = given.pop("path"), given.pop("columns")
    never_bare(lambda: read_recording(path, columns, **given))


def test_a_row_of_another_length_is_named(folder):
    path = folder / "run.csv"
    path.write_text("t,a,i\n0,1,2\n0,5,1,2\n")
    with pytest.raises(InputError, match=r"line 3 has 4 cells, expected 3.*decimal = ','"):
        read_recording(path, WANTED)
    path.write_text("t;a;i;\n0;1;2;\n0,5;1;2;\n")  # each row may end with a delimiter
    assert read_recording(path, WANTED, decimal=",")["q"].t.tolist() == [0, 0.5]
    with pytest.raises(UnknownName, match="unit of sensor q 'rpm'"):
        read_recording(path, {"a": ("q", "hip", "rpm")}, decimal=",")
    current = read_recording(path, {"a": ("tau", "hip", "A", 0.1)}, decimal=",")
    assert current["tau"].values.ravel().tolist() == [0.1, 0.1]  # by the torque constant
