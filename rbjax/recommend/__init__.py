"""Which solver, step, formulation or fidelity fits a motion: measured on it, with a sentence that
says why.

`rb.solvers.recommend`, `rb.constraints.recommend` and `rb.wheeled.recommend` are the names for
users.
"""

from rbjax.recommend.solver import Recommendation, recommend

__all__ = ["Recommendation", "recommend"]
