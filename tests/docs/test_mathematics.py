"""Every formula of the pages can be made MathML."""

import pytest

from tests.docs.pages import PAGES, name, prose

pytest.importorskip("latex2mathml", reason="pip install 'rbjax[docs]'")

from docs.generate.markdown.convert import convert
from docs.generate.markdown.mathematics import mathml, with_mathml


@pytest.mark.parametrize("page", PAGES[1:], ids=name)
def test_formulas_of_a_page_can_be_read(page):
    text = page.read_text()
    if "$" in prose(text):
        with_mathml(prose(text))


def test_formulas_become_mathml_and_code_stays():
    text = "with $M \\dot v$ and `$HOME`, 3 $ and 4 $\n\n$$\nM a = f\n$$\n\n```\n$x$\n```\n"
    found = convert(text, {})
    assert found.count("<math") == 2 and "`$HOME`, 3 $ and 4 $" in found and "$x$" in found
    assert 'display="block"' in found


def test_a_formula_with_a_mistake_is_named():
    with pytest.raises(ValueError, match="cannot be read"):
        mathml("\\begin{nothing}", False)
    with pytest.raises(ValueError, match=r"unknown commands.*nothing"):
        mathml("\\nothing x", False)


def test_brackets_after_a_line_break_are_no_length():
    found = mathml(r"\begin{bmatrix} [q] & 0 \\ [p] & 1 \end{bmatrix}", True)
    assert "<mi>p</mi>" in found and "<mi>q</mi>" in found


def test_names_become_links_and_blocks_lose_their_marks():
    links = {"rbjax.rollout": "rbjax.rollout"}
    text = "# `rb.rollout`\n\nUse `rb.rollout` or [`rb.rollout`](x.md).\n\n"
    text += "```python {.slow}\n1\n```\n"
    found = convert(text, links)
    assert found.count("[`rb.rollout`][rbjax.rollout]") == 1 and "```python\n" in found


def test_paths_of_pages_become_links():
    found = convert("See `docs/guides/contacts.md`.", {}, "develop/architecture.md")
    assert found == "See [`docs/guides/contacts.md`](../guides/contacts.md)."
