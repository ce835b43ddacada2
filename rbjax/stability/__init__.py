"""Stability analysis: the linear theory of any solver, and measurements of its code.

    stability_function, characteristic    R(z) and phi(zeta, z), in exact arithmetic
    multistep, rb.solvers.Tableau         user-defined methods, for all functions below
    linear_analysis                       order, error constant, limits, A-, A(alpha)-, L-stability
    growth_factors, spectral_radius, dissipation, period_elongation
                                          properties of one step of the solver's code
    order_by_conditions, measured_order   by rooted trees, and by halving the step
    state_matrix, reduced_linearisation, stable_step, measured_stable_step
                                          a robot's linearised motion, and its largest stable step
    drift, trend                          invariants over a million steps, and a test for drift
    limit_cycle                           fixed point of a return map, and its eigenvalues
    lyapunov, gradient_growth             chaos, and the time after which a gradient is noise
    verdict, attempt, scenes              failures of a run; any solver on scenes built to break it
    plot_regions, plot_spectral_radius    plots on matplotlib axes

`theory/` analyses a single method, `runs/` analyses motions.
"""

from rbjax.stability.pictures import plot_regions, plot_spectral_radius
from rbjax.stability.runs.canonical import Hamiltonian, from_canonical, to_canonical
from rbjax.stability.runs.drift import (
    DONE,
    NO_ROOT,
    NOT_FINITE,
    Invariants,
    LongRun,
    Trend,
    drift,
    trend,
)
from rbjax.stability.runs.largest_step import ROLLOUT, measured_stable_step, stable_step
from rbjax.stability.runs.limit_cycles import LimitCycle, limit_cycle
from rbjax.stability.runs.linearisation import (
    ReducedLinearisation,
    equilibrium,
    motion_matrices,
    reduced_linearisation,
    state_matrix,
)
from rbjax.stability.runs.lyapunov import Exponent, GradientGrowth, gradient_growth, lyapunov
from rbjax.stability.runs.scenes import Arm, Scene, Top, Truth, scenes, truth
from rbjax.stability.runs.trials import Outcome, Verdict, attempt, verdict
from rbjax.stability.theory.linear_analysis import (
    LinearAnalysis,
    MeasuredOrder,
    linear_analysis,
    measured_order,
    order_by_conditions,
)
from rbjax.stability.theory.multistep_roots import (
    Characteristic,
    adams,
    backward_differentiation,
    characteristic,
    multistep,
    pece,
)
from rbjax.stability.theory.oscillator import (
    dissipation,
    growth_factors,
    oscillator_factors,
    period_elongation,
    spectral_radius,
)
from rbjax.stability.theory.regions import (
    alpha_degrees,
    imaginary_limit,
    real_limit,
    stability_region,
    stiff_stability,
)
from rbjax.stability.theory.stability_function import StabilityFunction, stability_function

__all__ = [
    # linear theory
    "LinearAnalysis",
    "linear_analysis",
    "StabilityFunction",
    "stability_function",
    "Characteristic",
    "characteristic",
    "multistep",
    "adams",
    "backward_differentiation",
    "pece",
    "alpha_degrees",
    "imaginary_limit",
    "real_limit",
    "stability_region",
    "stiff_stability",
    "order_by_conditions",
    # measured on a step of the code
    "growth_factors",
    "oscillator_factors",
    "spectral_radius",
    "dissipation",
    "period_elongation",
    "MeasuredOrder",
    "measured_order",
    # a robot's motion, linearised
    "state_matrix",
    "motion_matrices",
    "equilibrium",
    "ReducedLinearisation",
    "reduced_linearisation",
    "stable_step",
    "measured_stable_step",
    "ROLLOUT",
    # motions: drift, growth, failure
    "drift",
    "trend",
    "Trend",
    "Invariants",
    "LongRun",
    "DONE",
    "NOT_FINITE",
    "NO_ROOT",
    "limit_cycle",
    "LimitCycle",
    "lyapunov",
    "Exponent",
    "gradient_growth",
    "GradientGrowth",
    "verdict",
    "Verdict",
    "Outcome",
    "attempt",
    "scenes",
    "Scene",
    "Arm",
    "Top",
    "truth",
    "Truth",
    "Hamiltonian",
    "to_canonical",
    "from_canonical",
    # pictures
    "plot_regions",
    "plot_spectral_radius",
]

__dir__ = __all__.copy
