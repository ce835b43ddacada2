"""Makes the generated pages of the documentation: `python -m docs.generate`.

- `tree`: copies sources, writes pages, orders them
"""
