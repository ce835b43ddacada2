"""Feedback laws: controllers of robots, allocation of forces to actuators, attraction maps."""
