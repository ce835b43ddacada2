from rbjax.stability.linear_analysis import LinearAnalysis, linear_analysis, order_by_conditions
from rbjax.stability.multistep_roots import (
    Characteristic,
    adams,
    backward_differentiation,
    characteristic,
    pece,
)
from rbjax.stability.regions import (
    alpha_degrees,
    imaginary_limit,
    real_limit,
    stability_region,
    stiff_stability,
)
from rbjax.stability.stability_function import StabilityFunction, stability_function
