"""Analysis of motions: linearised, over a million steps, in chaos, on scenes that break methods.

It imports `theory`, which does not import it.
"""
