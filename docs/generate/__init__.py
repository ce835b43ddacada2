"""Makes the generated pages of the documentation: `python -m docs.generate`.

A file with a function `pages(root)` is a generator; `__main__` finds it by itself.

- `tree`: copies sources, writes pages, orders them
- `home`: README as the home page
- `style_sheet`: the colours of the site
- `markdown`: formulas, links and docstrings as Markdown
- `reference`: a page for each room, registries, the command line
- `tutorials`: a page for each notebook
- `tasks`: a page for each task of an environment
- `benchmarks`, `figures`, `measured`, `subjects`: tables, charts and numbers of the results
- `animations`, `motions`, `pictures`: what moves
- `llms`: llms.txt and llms-full.txt
- `check`: dead links of the built site
- `repository`: the address of the repository
"""
