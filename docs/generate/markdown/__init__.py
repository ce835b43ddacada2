"""Markdown of all pages.

- `convert`: formulas, and links to the reference, of all pages
- `mathematics`: LaTeX as MathML
- `plain_text`: docstrings as Markdown
- `table`: a table of cells
- `docstrings`: the same for griffe, and the constructors that equinox makes
"""
