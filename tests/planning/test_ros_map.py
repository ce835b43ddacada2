"""Maps of ROS: pixels, rows and thresholds by hand."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import rbjax as rb
from rbjax.planning import OccupancyGrid

#: three columns, two rows, the upper one first
PIXELS = np.array([[0, 254, 205], [254, 254, 0]], np.uint8)
YAML = """# a map
image: map.pgm
resolution: 0.05
origin: [-1.0, 2.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def made(folder: Path, text: str = YAML, pixels: np.ndarray = PIXELS, name: str = "map.pgm"):
    Image.fromarray(pixels).save(folder / name)
    (folder / "map.yaml").write_text(text)
    return folder / "map.yaml"


def test_rows_go_up_and_columns_go_along_x(tmp_path: Path) -> None:
    grid = OccupancyGrid.from_ros(made(tmp_path))
    assert grid.occupied.shape == (3, 2)
    np.testing.assert_array_equal(grid.occupied[:, 0], [False, False, True])  # the lower row
    np.testing.assert_array_equal(grid.occupied[:, 1], [True, False, True])  # 205 is unknown
    assert float(grid.resolution) == pytest.approx(0.05)
    np.testing.assert_allclose(grid.origin, [-1.0, 2.0])
    free = OccupancyGrid.from_ros(made(tmp_path), unknown="free")
    np.testing.assert_array_equal(free.occupied[:, 1], [True, False, False])


@pytest.mark.parametrize(
    "text",
    [
        YAML.replace("origin: [-1.0, 2.0, 0.0]", "origin:\n- -1.0\n- 2.0\n- 0.0"),
        YAML.replace("origin: [-1.0, 2.0, 0.0]", "origin:\n  - -1.0 # x\n  - 2.0\n  - 0"),
        YAML + "mode: trinary\n",
        YAML.replace("map.pgm", '"map.pgm"').replace("negate: 0", "negate: false"),
    ],
)
def test_the_same_map_written_otherwise(tmp_path: Path, text: str) -> None:
    grid, want = (OccupancyGrid.from_ros(made(tmp_path, x)) for x in (text, YAML))
    np.testing.assert_array_equal(grid.occupied, want.occupied)
    np.testing.assert_array_equal(grid.origin, want.origin)


def test_negated_and_in_colour(tmp_path: Path) -> None:
    want = OccupancyGrid.from_ros(made(tmp_path)).occupied
    text = YAML.replace("negate: 0", "negate: 1")
    negated = OccupancyGrid.from_ros(made(tmp_path, text, 255 - PIXELS))
    np.testing.assert_array_equal(negated.occupied, want)
    colour = np.repeat(PIXELS[..., None], 3, -1)
    text = YAML.replace("map.pgm", "map.png")
    np.testing.assert_array_equal(
        OccupancyGrid.from_ros(made(tmp_path, text, colour, "map.png")).occupied, want
    )


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("map.pgm", "none.pgm", "expected a PGM or PNG file"),
        ("resolution: 0.05", "resolution: 0", "resolution is '0', expected a finite number above"),
        ("resolution: 0.05", "resolution: nan", "resolution is 'nan'"),
        ("resolution: 0.05\n", "", r"keys \['resolution'\] are missing"),
        ("[-1.0, 2.0, 0.0]", "[-1.0, 2.0, 0.3]", "turned by yaw = 0.3 rad"),
        ("[-1.0, 2.0, 0.0]", "[-1.0]", "origin is"),
        ("[-1.0, 2.0, 0.0]", "[x, 2.0]", "origin is 'x', expected a finite number"),
        ("negate: 0", "negate: 3", "negate is '3', expected 0 or 1"),
        ("0.65", "1.65", "occupied_thresh is '1.65'"),
        ("0.65", "0.1", "free_thresh 0.196 is above occupied_thresh 0.1"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(rb.InputError, match=message):
        OccupancyGrid.from_ros(made(tmp_path, YAML.replace(old, new)))


def test_no_file_another_mode_and_another_unknown(tmp_path: Path) -> None:
    with pytest.raises(rb.InputError, match="map_server"):
        OccupancyGrid.from_ros(tmp_path / "none.yaml")
    with pytest.raises(rb.UnknownName, match="'trinary', 'scale'"):
        OccupancyGrid.from_ros(made(tmp_path, YAML + "mode: raw\n"))
    with pytest.raises(rb.UnknownName, match="'occupied', 'free'"):
        OccupancyGrid.from_ros(made(tmp_path), unknown="maybe")
