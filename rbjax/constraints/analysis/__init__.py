"""Analysis of a constrained robot: mobility, assembly, reaction forces."""
