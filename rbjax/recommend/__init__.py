"""Which solver, step, formulation, fidelity or method of control fits a motion: measured on it,
with a sentence that says why.

`rb.solvers.recommend`, `rb.constraints.recommend`, `rb.wheeled.recommend` and
`rb.control.recommend` are the names for users.
"""

from rbjax.recommend.solver import Recommendation, recommend

__all__ = ["Recommendation", "recommend"]
