"""Rules that lower each primitive of a jaxpr to statements of a program."""
