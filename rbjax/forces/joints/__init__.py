"""Forces of joints: springs, dampers, friction, limits, curves."""
