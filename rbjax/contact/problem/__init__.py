"""The convex problem of contacts, limits, friction loss and equalities at a state.

- `world.py`: the geoms and links that can touch.
- `cones.py`: friction cones, with their forces and Hessians.
- `contact_rows.py`: the rows of contacts, by sets of pairs.
- `latched_disc.py`: friction bounded by a latched normal force (Coulomb's law).
- `in_use.py`: the contacts in use, with derivatives.
- `problem.py`: the problem, with factors in joint space.
- `articulated.py`: factors by sweeps of articulated bodies.
- `assemble.py`: the problem of a model at a state.
"""
