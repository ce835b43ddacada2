"""Direct collocation by an interior point method."""
