"""The tutorials, made from the executed notebooks.

- `notebooks`: a notebook as Markdown
- `pages`: the page of each, and their list
"""
