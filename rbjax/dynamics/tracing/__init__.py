"""How algorithms run in JAX: checked and compiled calls, derivative rules, batches, counts."""
