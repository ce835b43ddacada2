"""Makes the generated pages of the documentation: `python -m docs.generate`.

A file with a function `pages(root)` is a generator; `__main__` finds it by itself.

- `tree`: copies sources, writes pages, orders them
- `convert`: formulas, and links to the reference, of all pages
- `mathematics`: LaTeX as MathML
- `rooms`: the public names by room and subject
- `reference`: a page for each room
- `plain_text`, `docstrings`: docstrings as Markdown, for griffe
- `home`: README as the home page
- `registries`: joints, forces, solvers and other registries as tables
- `command_line`: the help of `rbjax`
- `style_sheet`: the colours of the site
- `llms`: llms.txt and llms-full.txt
"""
