"""Which solver, step and formulation fit a motion: measured on it, with a sentence that says why.

`rb.solvers.recommend` and `rb.constraints.recommend` are the names for users.
"""

from rbjax.recommend.solver import Recommendation, recommend

__all__ = ["Recommendation", "recommend"]
