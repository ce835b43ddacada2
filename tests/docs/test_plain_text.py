"""Docstrings as Markdown: plain text is no markup, names are links, examples stay."""

from docs.generate.markdown.plain_text import escaped, linked, markdown, with_fields

LINKS = {"rbjax.load": "rbjax.load", "rbjax.dynamics.jacobian": "rbjax.jacobian"}

TEXT = """Compute x[i] * y_ with `a*b` and mass_matrix.

Args:
    x, y: numbers [m],
        two of them.
    scale: a factor; see `rb.load`.

Example:
    >>> [1 * 2][0]
    2
"""


def test_marks_of_plain_text_are_escaped():
    assert escaped("x[i] * y_ < `a*b` and mass_matrix") == (
        r"x\[i\] \* y\_ &lt; `a*b` and mass_matrix"
    )


def test_names_of_the_reference_become_links():
    text = "`rb.load`, `rbjax.dynamics.jacobian(model)`, `rb.nothing`"
    assert linked(text, LINKS) == (
        "[`rb.load`][rbjax.load], [`rbjax.dynamics.jacobian(model)`][rbjax.jacobian], `rb.nothing`"
    )
    assert linked("[`rb.load`](x.md)", LINKS) == "[`rb.load`](x.md)"


def test_a_docstring():
    lines = markdown(TEXT, LINKS).split("\n")
    assert lines[0] == r"Compute x\[i\] \* y\_ with `a*b` and mass_matrix."
    assert lines[3:8] == [
        r"    x: numbers \[m\],", "        two of them.",
        r"    y: numbers \[m\],", "        two of them.",
        "    scale: a factor; see [`rb.load`][rbjax.load].",
    ]  # fmt: skip
    assert lines[9:12] == ["Examples:", "    >>> [1 * 2][0]", "    2"]


def test_a_text_table_stays():
    assert "    a_  [b]" in markdown("Text:\n\n    a_  [b]\n\nMore.", {})


def test_a_session_in_the_text_is_fenced():
    text = "Compute.\n\nAs in\n>>> [1][0]\n1\n\nMore [x]."
    assert markdown(text, {}).split("\n") == [
        "Compute.", "", "As in", "", "```pycon", ">>> [1][0]", "1", "```", "", r"More \[x\].",
    ]  # fmt: skip


def test_fields_of_a_class_get_a_heading():
    text = "A regulator.\n\nK, P: matrices.\nerror: a bound\n    of P.\n\nSource: a book."
    assert with_fields(text, {"K", "P", "error"}) == (
        "A regulator.\n\nFields:\n    K, P: matrices.\n    error: a bound\n        of P.\n\n"
        "Source: a book."
    )
    assert with_fields(text, {"K"}) == text
