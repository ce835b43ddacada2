"""Linear systems: regulators, Riccati and Lyapunov equations, structure, margins, filters."""
