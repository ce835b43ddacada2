"""Cases of flexible links: cross-sections, and the motion of a beam."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax import flexible
from tests.public.grid import Case

ONE = np.array([0.01, 0.02, 0.03])
TWO = np.array([0.005, 0.012, 0.025])
Q = np.array([[0.1, -0.2, 0.3, 0.2], [0.0, 0.0, 0.0, 0.0], [-0.4, 0.3, 0.1, -0.2]])
STEEL = {"E": 2.1e11, "nu": 0.3, "density": 7800.0}


def of_section(name: str) -> Any:
    def made(dtype: Any) -> Any:
        def found(*sizes: Any) -> Any:
            own = getattr(flexible, name)(*sizes, **STEEL)
            return own.stiffness, own.mass, own.inertia

        return found

    return made


def from_stiffness(dtype: Any) -> Any:
    return lambda scale: flexible.section(scale * jnp.arange(1.0, 7.0), 0.5, [2.0, 1.0, 1.0])


def of_beam(f: Any) -> Any:
    """A function of the length, q and v of a beam with two bending strains."""

    def made(dtype: Any) -> Any:
        def found(length: Any, q: Any, v: Any) -> Any:
            own = flexible.beam(length, [1.0, 2.0, 3.0, 0, 0, 0], {"k_y": 1, "k_z": 1}, mass=0.5)
            model = rb.load("<mujoco/>").astype(dtype).with_beam("rod", own)
            return f(model, q, v)

        return found

    return made


LENGTH = np.array([0.8, 1.0, 1.3])
FLEXIBLE: dict[str, Case] = {
    "circle": Case(of_section("circle"), [ONE], dtypes=(np.float64,)),
    "tube": Case(of_section("tube"), [ONE, TWO], dtypes=(np.float64,)),
    "rectangle": Case(of_section("rectangle"), [ONE, TWO], dtypes=(np.float64,)),
    "ellipse": Case(of_section("ellipse"), [ONE, TWO], dtypes=(np.float64,)),
    "section": Case(from_stiffness, [LENGTH], dtypes=(np.float64,)),
    "beam": Case(
        of_beam(lambda m, q, v: rb.forward_dynamics(m, q, v, q)), [LENGTH, Q, Q],
        dtypes=(np.float64,),
    ),
    "beam, tip": Case(
        of_beam(lambda m, q, v: rb.frame_velocity(m, q, v, "rod")), [LENGTH, Q, Q],
        dtypes=(np.float64,),
    ),
}  # fmt: skip
