"""The unknown parameters of a model: their names, coordinates, bounds and first guesses."""
