"""Statistics of residuals and Jacobians: rank, intervals, whiteness and comparisons."""
