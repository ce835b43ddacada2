"""The algorithms that benchmarks of a batch time, (model, q, v, u) -> results; no benchmark."""

from collections.abc import Callable

import rbjax as rb

ALGORITHMS: dict[str, Callable] = {
    "forward dynamics": rb.forward_dynamics,
    "RNEA": rb.inverse_dynamics,
    "CRBA": lambda m, q, v, u: rb.mass_matrix(m, q),
    "forward kinematics": lambda m, q, v, u: rb.forward_kinematics(m, q),
    "derivatives of forward dynamics": rb.forward_dynamics_derivatives,
    "derivatives of inverse dynamics": rb.inverse_dynamics_derivatives,
}
