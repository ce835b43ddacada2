"""Lowering rules: each translates one JAX primitive into statements of a program."""
