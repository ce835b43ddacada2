"""Motion: the field of a robot, its integrators, `rollout`, `simulate`, trajectories."""
