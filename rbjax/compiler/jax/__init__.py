"""The JAX primitive that runs a program: batching, derivatives, sharding, calls from XLA."""
