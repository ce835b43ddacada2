"""Analysis of motions: linearisation, long runs, chaos, and scenes that break methods.

This package imports `theory`, which does not import it.
"""
