"""MBDyn's modal format: the two examples of its manual, and wrong files."""

import numpy as np
import pytest

from rbjax.errors import InputError, UnknownName
from rbjax.flexible.modal import inertia_invariants, read_mbdyn_modal

#: three nodes on a line, two modes; MBDyn input manual, appendix "Modal Element Data"
RECORDS = {
    1: "** revision, nodes, normal, attached, constraint, rejected\nREV0 3 2 0 0 0",
    2: "1001 1002 1003",
    3: "0.1 0",
    4: "0 0.2",
    5: "0\n0\n0",
    6: "-2.\n0\n2.",
    7: "0\n0\n0",
    8: "** mode 1\n0 0 1 0 0 0\n0 0 0 0 0 0\n0 0 1 0 0 0\n"
    "** mode 2\n1 0 0 0 0 0\n0 0 0 0 0 0\n1 0 0 0 0 0",
    9: "2 0\n0 2",
    10: "1 0\n0 1D2",
    11: "1 1 1 1 1 1\n" * 3,
}
GLOBAL = "3\n0 0 0\n11 0 0\n0 3 0\n0 0 11"


def text_of(records):
    head = "** MBDyn MODAL DATA FILE\n** NODE SET ALL\n\n"
    return head + "".join(f"** RECORD GROUP {k}, TEXT\n{v}\n**\n" for k, v in records.items())


def read(tmp_path, records, **options):
    (tmp_path / "a.fem").write_text(text_of(records))
    return read_mbdyn_modal(tmp_path / "a.fem", **options)


def test_dynamic_example_of_the_manual(tmp_path):
    found = read(tmp_path, RECORDS)
    body = found.body
    assert float(body.mass) == 3.0
    assert body.first_moment.tolist() == [0.0, 0.0, 0.0]
    assert body.inertia.tolist() == np.diag([11.0, 3.0, 11.0]).tolist()
    assert body.stiffness.tolist() == [[1.0, 0.0], [0.0, 100.0]]
    assert body.frame_names == ("1001", "1002", "1003")
    assert body.modes[2].tolist() == [[0.0, 1.0], [0.0, 0.0], [1.0, 0.0]]
    assert found.q.tolist() == [0.1, 0.0] and found.v.tolist() == [0.0, 0.2]
    places = np.array([[0, -2.0, 0], [0, 0, 0], [0, 2, 0]])
    want = inertia_invariants(np.ones(3), places, np.asarray(body.modes))
    assert np.allclose(body.first_moment1, want.I3) and np.allclose(body.coupling, want.I4)
    assert np.allclose(body.inertia2, (want.N + want.N.transpose(1, 0, 2, 3)) / 2)


def test_static_example_of_the_manual(tmp_path):
    """Without lumped masses the inertia is of order zero."""
    records = {k: v for k, v in RECORDS.items() if k not in (3, 4, 11)} | {12: GLOBAL}
    records[9] = "0 0\n0 0"
    found = read(tmp_path, records, frames=["1003"])
    body = found.body
    assert float(body.mass) == 3.0 and np.allclose(body.inertia, np.diag([11.0, 3.0, 11.0]))
    for name in ("first_moment1", "inertia1", "inertia2", "coupling", "coupling1", "modal_mass"):
        assert not np.any(getattr(body, name)), name
    assert body.frame_names == ("1003",) and not found.q.any()


def test_global_inertia_replaces_that_of_the_points(tmp_path):
    """Record 12 is about the center of mass, the body about the origin. Record 13 is damping."""
    moved = "3\n0 1 0\n11 0 0\n0 3 0\n0 0 11"
    records = RECORDS | {12: moved, 13: "0.1 0.02\n0.03 0.4"}
    body = read(tmp_path, records).body
    assert np.allclose(body.first_moment, [0.0, 3.0, 0.0])
    assert np.allclose(body.inertia, np.diag([14.0, 3.0, 14.0]))
    assert np.allclose(body.damping, [[0.1, 0.03], [0.02, 0.4]])  # columns are given first
    assert np.allclose(body.first_moment1, read(tmp_path, RECORDS).body.first_moment1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({1: None}, "RECORD GROUP 1"),
        ({1: "REV0 3 2"}, "record 1 has 3 values"),
        ({1: "REV0 3 x 0 0 0"}, "integer"),
        ({1: "REV0 3 0 0 0 0"}, "0 modes"),
        ({9: None}, "record 9 is missing"),
        ({8: "1 2 3"}, "record 8 has 3 values, expected 36"),
        ({10: "1 0 0 text"}, "record 10"),
        ({11: None}, "neither record 11"),
        ({11: "1 2 1 1 1 1\n" * 3}, "differ along"),
        ({5: "0 0 nan"}, "not finite"),
    ],
)
def test_wrong_files_are_sentences(tmp_path, change, message):
    records = {k: v for k, v in (RECORDS | change).items() if v is not None}
    with pytest.raises(InputError, match=message):
        read(tmp_path, records)


def test_unknown_frames_and_repeated_records(tmp_path):
    with pytest.raises(UnknownName, match="1004"):
        read(tmp_path, RECORDS, frames=["1004"])
    (tmp_path / "b.fem").write_text(text_of(RECORDS) + text_of({7: "0 0 0"}))
    with pytest.raises(InputError, match="twice"):
        read_mbdyn_modal(tmp_path / "b.fem")
