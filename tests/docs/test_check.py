"""The check of a built site finds dead links, missing pictures and resources of other hosts."""

from docs.generate.check import faults

PAGE = """<html><head><link rel="stylesheet" href="style.css"></head><body>
<h1 id="top">T</h1><a href="other/#there">a</a> <a href="https://example.org">b</a> %s
</body></html>"""


def site(tmp_path, extra=""):
    (tmp_path / "other").mkdir()
    (tmp_path / "style.css").write_text("")
    (tmp_path / "index.html").write_text(PAGE % extra)
    (tmp_path / "other" / "index.html").write_text('<h2 id="there">O</h2><a href="../#top">up</a>')
    return faults(tmp_path)


def test_a_whole_site_has_no_fault(tmp_path):
    assert site(tmp_path) == []


def test_faults_are_named(tmp_path):
    extra = (
        '<a href="nowhere/">x</a><a href="other/#gone">y</a><img alt="z" src="no.png">'
        '<script src="https://cdn.example.org/a.js"></script>'
    )
    assert site(tmp_path, extra) == [
        "index.html: nowhere/: no such file",
        "index.html: other/#gone: no such heading",
        "index.html: no.png: no such file",
        "index.html: loads https://cdn.example.org/a.js",
    ]
