"""Theory of a single method: its polynomials, roots, regions, orders, and one step."""
