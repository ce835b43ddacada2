"""The style sheet and the logo of the site, in the colours of rbjax's pictures."""

from __future__ import annotations

from pathlib import Path
from string import Template

from docs.generate import tree
from rbjax import style

#: lighter colours on the dark page, with a contrast of at least 4.5 to 1
LIGHT_BLUE, LIGHT_ORANGE = "#7db8ee", "#f3a55d"

SHEET = Template("""\
:root > *,
[data-md-color-scheme="default"] > * {
  --md-primary-fg-color: $blue;
  --md-accent-fg-color: $orange;
  --md-typeset-a-color: $blue;
}

[data-md-color-scheme="slate"][data-md-color-scheme] > * {
  --md-primary-fg-color: $light_blue;
  --md-accent-fg-color: $light_orange;
  --md-typeset-a-color: $light_blue;
}

/* 92 columns of code between two narrow side bars */
.md-grid {
  max-width: 66rem;
}

@media screen and (min-width: 60em) {
  .md-sidebar {
    width: 10.6rem;
  }
}

/* rows are tight, columns as wide as their words */
.md-typeset table:not([class]) th,
.md-typeset table:not([class]) td {
  min-width: 0;
  padding: 0.45em 0.7em;
  vertical-align: top;
}

.md-typeset table:not([class]) td code {
  white-space: nowrap;
}

/* a row of empty headings is left out */
.md-typeset table:not([class]) thead:not(:has(th:not(:empty))) {
  display: none;
}

/* wide tables scroll in their frame: a shadow at the edge says that there is more */
.md-typeset__scrollwrap table:not([class]) {
  background: none;
}

.md-typeset__scrollwrap {
  background:
    linear-gradient(to right, var(--md-default-bg-color) 40%, transparent) 0 0 / 2.4rem 100%
      no-repeat local,
    linear-gradient(to left, var(--md-default-bg-color) 40%, transparent) 100% 0 / 2.4rem 100%
      no-repeat local,
    linear-gradient(to right, var(--md-default-fg-color--lightest), transparent) 0 0 / 0.5rem
      100% no-repeat,
    linear-gradient(to left, var(--md-default-fg-color--lightest), transparent) 100% 0 / 0.5rem
      100% no-repeat;
}

/* numbers of equal width stand below each other */
.md-typeset table:not([class]) td {
  font-variant-numeric: tabular-nums;
}

/* long lines of printed output are wrapped; on a narrow screen they scroll, as tables of numbers */
@media screen and (min-width: 60em) {
  .md-typeset .language-text code {
    white-space: pre-wrap;
  }
}

/* formulas */
.md-typeset .formula {
  overflow-x: auto;
  overflow-y: hidden;
  margin: 1em 0;
  padding: 0.2em 0;
}

.md-typeset math {
  font-size: 1.08em;
}

.md-typeset math[display="block"] {
  font-size: 1.12em;
}

/* square brackets: two lines with a serif at each end */
.md-typeset mtable.bracketed {
  border: 0 solid currentColor;
  border-width: 0 1px;
  margin: 0 0.15em;
  background:
    linear-gradient(currentColor, currentColor) 0 0 / 0.3em 1px no-repeat,
    linear-gradient(currentColor, currentColor) 100% 0 / 0.3em 1px no-repeat,
    linear-gradient(currentColor, currentColor) 0 100% / 0.3em 1px no-repeat,
    linear-gradient(currentColor, currentColor) 100% 100% / 0.3em 1px no-repeat;
}

/* pictures have a white ground: on a dark page their lightness is inverted, and not their hue */
[data-md-color-scheme="slate"] .md-typeset img {
  filter: invert(1) hue-rotate(180deg);
  mix-blend-mode: screen;
}

[data-md-color-scheme="slate"] .md-typeset iframe,
[data-md-color-scheme="slate"] .md-typeset object {
  filter: invert(1) hue-rotate(180deg);
}

/* entries of the reference */
.md-typeset .doc-heading {
  border-top: 1px solid var(--md-default-fg-color--lightest);
  padding-top: 0.9em;
}

.md-typeset .doc-contents .doc-contents {
  border-left: 2px solid var(--md-default-fg-color--lightest);
  padding-left: 1em;
}

.md-typeset .doc-contents .doc-children {
  border-left: 2px solid var(--md-default-fg-color--lightest);
  padding-left: 1em;
}

.md-typeset .doc-children .doc-heading {
  border-top: none;
  padding-top: 0;
}
""")


#: an arm of two links on a base
LOGO = Template("""\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 64 64">
  <g fill="none" stroke-linecap="round" stroke-width="9">
    <path d="M16 52 L28 22" stroke="$blue"/>
    <path d="M28 22 L52 32" stroke="$orange"/>
  </g>
  <path d="M6 58 H30" stroke="$grey" stroke-linecap="round" stroke-width="6"/>
  <circle cx="28" cy="22" r="3.5" fill="$paper"/>
  <circle cx="16" cy="52" r="3.5" fill="$paper"/>
</svg>
""")


def pages(root: Path) -> tree.Pages:
    """The sheet and the logo, which mkdocs.yml names."""
    colours = {"blue": style.BLUE, "orange": style.ORANGE, "paper": style.PAPER}
    lighter = {"light_blue": LIGHT_BLUE, "light_orange": LIGHT_ORANGE}
    logo = LOGO.substitute(colours, grey="#8a97a3")
    return {"style/rbjax.css": SHEET.substitute(colours | lighter), "style/logo.svg": logo}
