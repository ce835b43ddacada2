"""How motions stay, drift, diverge and fail."""

from rbjax.stability.canonical import Hamiltonian, from_canonical, to_canonical
from rbjax.stability.drift import Invariants, Trend, drift, trend
from rbjax.stability.lyapunov import Exponent, GradientGrowth, gradient_growth, lyapunov
from rbjax.stability.march import March

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
    "Hamiltonian",
    "to_canonical",
    "from_canonical",
]
