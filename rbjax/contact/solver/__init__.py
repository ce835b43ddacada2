"""The solver of the contact problem, and its results.

- `newton.py`: Newton's method with a line search.
- `conjugate_gradients.py`: the direction if contacts inside a tree are added to the factors.
- `linear_solution.py`: the same equation at a solution, for derivatives.
- `contact_forces.py`: the forces of contacts.
- `solution.py`: acceleration, forces by kind, and the report of the solver.
"""
