"""Execution of algorithms in JAX: checked and compiled calls, derivative rules, batches, counts."""
