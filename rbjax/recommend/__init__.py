"""Recommend a solver, formulation, fidelity or control method for a motion.

    solver            a solver and its step, for a robot from a state
    formulation       a formulation and its step, for a robot with constraints
    fidelity          a fidelity and its step, for a wheeled robot on a manoeuvre
    contact_law       a law of contact, for a robot from a state
    control_method    a method of `rb.control.solve`, for a problem
Each function measures its candidates on the motion itself and returns a `Recommendation`: the
choice, its cost, the measured candidates, and the reason in a sentence.
"""

from rbjax.recommend.contact_laws import LawRecommendation, contact_law
from rbjax.recommend.control_methods import MethodRecommendation, control_method
from rbjax.recommend.fidelities import FidelityRecommendation, fidelity
from rbjax.recommend.formulations import FormulationRecommendation, formulation
from rbjax.recommend.recommendation import Recommendation
from rbjax.recommend.solvers import SolverRecommendation, solver

__all__ = [
    "FidelityRecommendation",
    "FormulationRecommendation",
    "LawRecommendation",
    "MethodRecommendation",
    "Recommendation",
    "SolverRecommendation",
    "contact_law",
    "control_method",
    "fidelity",
    "formulation",
    "solver",
]

__dir__ = __all__.copy
