"""The program of one thread: statements, operations, and the builder that writes it."""
