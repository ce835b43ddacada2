"""The equations of constrained motion: residuals, multipliers, projections, derivatives."""
