"""Pages: words are escaped, tables and pictures are inside."""

from rbjax.html_page import code, element, link, listed, page, picture, table


def test_words_are_words_and_nothing_is_outside():
    body = [element("p", "a < b & c", "note"), code("x <y>"), listed(["1 < 2"]),
            table(["a", "b"], [["1", "<2>"]]), picture(b"png", "a <picture>")]  # fmt: skip
    body.append(link("fit.html", "a fit & more"))
    text = page("<title>", "lead", body, "end")
    assert '<p class="note">a &lt; b &amp; c</p>' in text
    assert "<h1>&lt;title&gt;</h1>" in text and "<td>&lt;2&gt;</td>" in text
    assert "<li>1 &lt; 2</li>" in text and "x &lt;y&gt;" in text
    assert '<a href="fit.html">a fit &amp; more</a>' in text
    assert 'src="data:image/png;base64,cG5n"' in text and "http" not in text
