"""Solvers of differential equations that diffrax lacks. Each is a diffrax solver.

`diffrax.diffeqsolve` runs them on any vector field, `rbjax.simulate` on a robot. `all()` returns
them by name. `rbjax.recommend.solver(model, state, accuracy)` chooses one.

    any vector field      RK4, implicit_midpoint, trapezoid, gauss_legendre, radau_iia,
                          lobatto_iiia, lobatto_iiic, SDIRK2, ros2, ros34pw2,
                          adams_bashforth, adams_moulton, pece, bdf
    q' = v, v' = a        newmark, hht_alpha, generalized_alpha, CentralDifferences,
                          SemiImplicitEuler, VariationalMidpoint
    best if a is          symplectic_euler, stoermer_verlet, yoshida4, yoshida6
    independent of v
    on a Lie group        rkmk, CrouchGrossman3, CommutatorFree4, generalized_alpha,
                          RigidBodySplitting
The last three groups accept terms `OnGroup`. The second group also accepts any pair of arrays.
`integrate_until` integrates until an event, with the derivatives of the event.
`Compensated` wraps a solver of the first group and carries the rounding errors of its additions.
"""

from rbjax.solvers.compensated import Compensated
from rbjax.solvers.events import Arrival, carry_back, integrate_until
from rbjax.solvers.groups import SE3, SO3, AbstractGroup, OnGroup, Product, Vector
from rbjax.solvers.lie import (
    CommutatorFree4,
    CrouchGrossman3,
    MuntheKaas,
    RigidBody,
    RigidBodySplitting,
    rkmk,
)
from rbjax.solvers.multistep import (
    BDF,
    Adams,
    adams_bashforth,
    adams_moulton,
    bdf,
    pece,
)
from rbjax.solvers.registry import KINDS, Entry, all
from rbjax.solvers.root_finding import RootFinder, chord, newton, very_chord
from rbjax.solvers.rosenbrock import RosenbrockTableau, RosenbrockW, ros2, ros34pw2
from rbjax.solvers.runge_kutta import (
    RK4,
    SDIRK2,
    ImplicitRungeKutta,
    gauss_legendre,
    implicit_midpoint,
    lobatto_iiia,
    lobatto_iiic,
    radau_iia,
    trapezoid,
)
from rbjax.solvers.second_order import (
    CentralDifferences,
    GeneralizedAlpha,
    SemiImplicitEuler,
    VariationalMidpoint,
    generalized_alpha,
    hht_alpha,
    newmark,
)
from rbjax.solvers.splitting import (
    Splitting,
    stoermer_verlet,
    symplectic_euler,
    yoshida4,
    yoshida6,
)
from rbjax.solvers.steps import AbstractGroupSolver
from rbjax.solvers.tableau import Tableau

__all__ = [
    "all",
    "Entry",
    "KINDS",
    # any vector field
    "RK4",
    "ImplicitRungeKutta",
    "Tableau",
    "implicit_midpoint",
    "trapezoid",
    "gauss_legendre",
    "radau_iia",
    "lobatto_iiia",
    "lobatto_iiic",
    "SDIRK2",
    "RosenbrockW",
    "RosenbrockTableau",
    "ros2",
    "ros34pw2",
    "Adams",
    "BDF",
    "adams_bashforth",
    "adams_moulton",
    "pece",
    "bdf",
    "Compensated",
    # second order
    "GeneralizedAlpha",
    "newmark",
    "hht_alpha",
    "generalized_alpha",
    "CentralDifferences",
    "SemiImplicitEuler",
    "VariationalMidpoint",
    # splittings
    "Splitting",
    "symplectic_euler",
    "stoermer_verlet",
    "yoshida4",
    "yoshida6",
    # Lie groups
    "AbstractGroup",
    "AbstractGroupSolver",
    "Vector",
    "SO3",
    "SE3",
    "Product",
    "OnGroup",
    "MuntheKaas",
    "rkmk",
    "CrouchGrossman3",
    "CommutatorFree4",
    "RigidBody",
    "RigidBodySplitting",
    # events
    "integrate_until",
    "carry_back",
    "Arrival",
    # roots
    "RootFinder",
    "newton",
    "chord",
    "very_chord",
]

__dir__ = __all__.copy
