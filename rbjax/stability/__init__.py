"""How motions stay, drift, diverge and fail."""

from rbjax.stability.canonical import Hamiltonian, from_canonical, to_canonical
from rbjax.stability.drift import Invariants, Trend, drift, trend
from rbjax.stability.lyapunov import Exponent, GradientGrowth, gradient_growth, lyapunov
from rbjax.stability.march import March
from rbjax.stability.scenes import Scene, Truth, scenes, truth
from rbjax.stability.systems import Arm, Body
from rbjax.stability.trials import attempt
from rbjax.stability.verdicts import Outcome, Verdict, verdict

__all__ = [
    "drift",
    "trend",
    "Trend",
    "Invariants",
    "March",
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
    "Body",
    "truth",
    "Truth",
    "Hamiltonian",
    "to_canonical",
    "from_canonical",
]
