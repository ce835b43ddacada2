"""What motions show: linearised, over a million steps, in chaos, on scenes built to break methods.

Stands on the theory beside it, which knows nothing of runs.
"""
