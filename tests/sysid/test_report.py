"""The report of a fit, from what it found to what the file says."""

import pytest

import rbjax as rb
from rbjax.sysid import identify, report
from tests.sysid.test_identify import DAMPING, GUESS, MASS, seen


def test_a_report_says_what_was_found(tmp_path):
    found = identify(GUESS, seen(0, 1e-3, count=60), {"mass": MASS, "damping": DAMPING})
    path = report(found, tmp_path / "report.html", held_out=seen(5, 1e-3, count=60))
    page = path.read_text()
    for name, value in found.values.items():
        assert f"<td>{name}</td>" in page and f"<td>{value:.5g}</td>" in page
    for words in (
        "run 0",
        found.status.text,
        "2 of 2 are identifiable",
        "on 1 recording outside of",
    ):
        assert words in page
    # fits of q and v, residuals, intervals, correlation, held out
    assert page.count("data:image/png") == 6
    assert 'src="http' not in page and "<script" not in page
    with pytest.raises(rb.InputError, match="no folder"):
        report(found, tmp_path / "nowhere" / "report.html")
