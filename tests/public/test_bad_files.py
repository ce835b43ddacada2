"""Spoilt files of every reader: an error of rbjax, or a result of finite numbers.

A good file is spoilt in one place by a random number generator with a fixed seed. A reader must
raise an error of rbjax with a sentence, or return a result without a number that is not finite.
"""

from __future__ import annotations

import io
import random
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

import rbjax as rb
from rbjax import envs, planning, sysid, wheeled
from rbjax.flexible import modal
from rbjax.sysid.jobs.example import write_example
from rbjax.sysid.jobs.job import Job
from tests.flexible.modal import test_mbdyn_modal
from tests.flexible.modal.points import random_points
from tests.loading import test_any_file
from tests.planning import test_ros_map
from tests.public.test_bad_calls import numeric

SEED = 5
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eEdD][-+]?\d+)?(?![\w.])")
WORD = re.compile(r"[A-Za-z_]+")
NUMBERS = ("nan", "inf", "-1", "0", "1e400", "1e30", "-1e-30", "", "x", "1 2", "1.5", "99", "[]",
           "null", "true")  # fmt: skip
PIECES = ("\0", "<", '"', "]", "{", "é", "\n", ",", ":", "#", "=", "&x;", "  ", "-", "\udcff")


def replaced(text: str, pattern: re.Pattern, chance: random.Random, new: str) -> str:
    found = [*pattern.finditer(text)]
    if not found:
        return text[: len(text) // 2]
    one = chance.choice(found)
    return text[: one.start()] + new + text[one.end() :]


def spoilt_text(text: str, chance: random.Random) -> str:
    """The text with one thing changed."""
    how = chance.randrange(8)
    if how < 3:
        return replaced(text, NUMBER, chance, chance.choice(NUMBERS))
    if how == 3:
        return replaced(text, WORD, chance, chance.choice(WORD.findall(text) or ["a"]))
    at, lines = chance.randrange(len(text)), text.splitlines()
    if how == 4:
        return text[:at] + chance.choice(PIECES) + text[at:]
    if how == 5:
        return text[:at] + ("" if chance.random() < 0.3 else text[at + chance.randint(1, 30) :])
    k = chance.randrange(len(lines))
    return "\n".join([*lines[:k], *([lines[k]] * 2 if how == 6 else []), *lines[k + 1 :]])


def spoilt_archive(data: bytes, chance: random.Random) -> bytes:
    """An .npz file with one thing changed."""
    how = chance.randrange(8)
    if how == 0:
        return data[: chance.randrange(len(data))]
    if how == 1:
        at = chance.randrange(len(data))
        return data[:at] + bytes([chance.randrange(256)]) + data[at + 1 :]
    arrays = dict(np.load(io.BytesIO(data)))
    name = chance.choice(sorted(arrays))
    x = arrays[name]
    text = x.dtype.kind in "US"
    changes: dict[int, Callable[[], Any]] = {
        3: lambda: x[..., None], 4: lambda: x.ravel()[:-1], 5: lambda: np.array(["a"]),
        6: lambda: np.full(x.shape, spoilt_text(f"{x} ", chance) if text else np.nan),
        7: lambda: x.astype(str if not text else bytes),
    }  # fmt: skip
    if how == 2:
        del arrays[name]
    else:
        arrays[name] = changes[how]()
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


class Reader(NamedTuple):
    """A kind of file: its name, how to write a good one in a folder, and how to read it.

    endless: whether a right result has infinite numbers, as limits of a model.
    """

    file: str
    write: Callable[[Path], Any]
    read: Callable[[Path], Any]
    endless: bool = False


CAR = rb.wheeled.kinds()["differential_drive"].make()


def write_policy(folder: Path) -> None:
    env = envs.make("cart_pole_balance", kernel=False)
    policy = envs.learning.new_policy(env, jax.random.key(0), hidden=(4,))
    envs.learning.save_policy(folder, policy, "cart_pole_balance")


def write_motion(folder: Path) -> None:
    model = rb.load("double_pendulum")
    rest = model.default_state()
    still = rb.Trajectory(
        np.arange(3.0), np.stack([rest.q] * 3), np.stack([rest.v] * 3), np.array(True)
    )
    rb.loading.save_trajectory(folder / "motion.npz", model, still)


def write_body(folder: Path) -> None:
    rng = np.random.default_rng(0)
    body = modal.from_points(
        **random_points(rng, 4, 2), stiffness=np.diag([1.0, 2.0]), frames=[0, 3]
    )
    modal.write_sid(body, folder / "body.SID_FEM")


def text(name: str, content: str) -> Callable[[Path], Any]:
    return lambda folder: (folder / name).write_text(content)


TABLE = "t,a\n0,1\n0.1,2\n0.2,3\n0.3,4\n"
COLUMNS = {"a": sysid.Column("q", "hip", "deg")}
READERS = {
    "mjcf": Reader("a.xml", text("a.xml", test_any_file.SMALL), rb.load, True),
    "urdf": Reader("a.urdf", text("a.urdf", test_any_file.ARM), rb.load, True),
    "wheeled": Reader("car.xml", text("car.xml", wheeled.write_mjcf(CAR)),
                      lambda path: wheeled.from_file(path, "*wheel*"), True),
    "job": Reader("identify.toml", lambda folder: write_example(folder), Job.read),
    "csv": Reader("a.csv", text("a.csv", TABLE), lambda path: sysid.read_recording(path, COLUMNS)),
    "map": Reader("map.yaml", test_ros_map.made, planning.OccupancyGrid.from_ros),
    "sid": Reader("body.SID_FEM", write_body, modal.read_sid),
    "mbdyn": Reader("a.fem", text("a.fem", test_mbdyn_modal.text_of(test_mbdyn_modal.RECORDS)),
                    modal.read_mbdyn_modal),
    "policy": Reader("policy.json", write_policy,
                     lambda path: envs.learning.load_policy(path.parent)[1]),
    "motion": Reader("motion.npz", write_motion, rb.loading.load_trajectory, True),
    "npz": Reader("a.npz", lambda folder: np.savez(folder / "a.npz", t=np.arange(4) * 0.1,
                                                   a=np.ones(4)),
                  lambda path: sysid.read_recording(path, COLUMNS)),
}  # fmt: skip


def wrong_with(reader: Reader, path: Path) -> str | None:
    """The problem with what a reader does with a file, or None."""
    try:
        found = reader.read(path)
    except rb.RbjaxError as error:
        length = len(str(error))
        return None if 25 < length < 2000 else f"says {str(error)[:200]!r}"
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    if isinstance(found, rb.loading.SavedTrajectory) and not found.trajectory.success.all():
        return None  # it says so
    for x in numeric(found):
        if x.dtype.kind == "f" and (np.isnan(x) if reader.endless else ~np.isfinite(x)).any():
            return f"gives {x}"
    return None


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder with a good file of a kind."""
    made: dict[str, Path] = {}

    def folder(kind: str) -> Path:
        if kind == "policy":
            pytest.importorskip("orbax.checkpoint")
        if kind not in made:
            made[kind] = tmp_path_factory.mktemp(kind)
            READERS[kind].write(made[kind])
        return made[kind]

    return folder


def found_wrong(kind: str, folder: Path, work: Path, count: int) -> list[str]:
    """What is wrong with the results of `count` spoilt files of a kind."""
    reader, chance = READERS[kind], random.Random(f"{SEED} {kind}")
    shutil.copytree(folder, work, dirs_exist_ok=True)
    path = work / reader.file
    data, wrong = path.read_bytes(), []
    for k in range(count):
        if path.suffix == ".npz":
            bad = spoilt_archive(data, chance)
        else:
            bad = spoilt_text(data.decode(), chance).encode(errors="surrogateescape")
        path.write_bytes(bad)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            how = wrong_with(reader, path)
        if how:
            wrong.append(f"{kind} {k}: {how}")
    return wrong


@pytest.mark.parametrize("count", [30, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", READERS)
def test_a_spoilt_file_is_named(
    kind: str, count: int, good: Callable[[str], Path], tmp_path: Path
) -> None:
    wrong = found_wrong(kind, good(kind), tmp_path, count)
    assert not wrong, "\n".join(["", *wrong])


@pytest.mark.parametrize("kind", READERS)
def test_the_good_files_are_read(kind: str, good: Callable[[str], Path]) -> None:
    with warnings.catch_warnings(action="ignore"):
        READERS[kind].read(good(kind) / READERS[kind].file)
