"""Design of experiments: excitation trajectories that show the parameters best."""
