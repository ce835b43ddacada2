"""Registry of the solvers by name, with their properties."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import diffrax

from rbjax.solvers import lie, multistep, rosenbrock, runge_kutta, second_order, splitting
from rbjax.solvers.root_finding import MAX_STEPS, very_chord

KINDS = ("ode", "second-order", "split", "lie")


@dataclass(frozen=True)
class Entry:
    """A solver and its properties.

    Fields:
        make: () -> the diffrax solver.
        order: order of convergence.
        kind: kind of equations: "ode" any vector field; "second-order" a pair (q, v) with q' = v
            and v' = a(t, q, v); "split" the same pair, best if a does not depend on v; "lie" a term
            on a group.
        implicit: whether a step solves equations.
        adaptive: whether the solver estimates its error. Run others with constant steps, or in a
            `diffrax.HalfSolver`.
    """

    make: Callable[[], diffrax.AbstractSolver]
    order: int
    kind: str
    implicit: bool
    adaptive: bool


def all() -> dict[str, Entry]:
    """Return the solvers by name, in a fixed order.

    Example:
        >>> import rbjax as rb
        >>> entry = rb.solvers.all()["radau_iia3"]
        >>> entry.order, entry.kind, entry.implicit
        (5, 'ode', True)
    """
    out: dict[str, Entry] = {}

    def add(name, make, order, kind="ode", implicit=False, adaptive=True):
        out[name] = Entry(make, order, kind, implicit, adaptive)

    add("euler", diffrax.Euler, 1, adaptive=False)
    add("heun", diffrax.Heun, 2)
    add("rk4", runge_kutta.RK4, 4)
    add("implicit_midpoint", runge_kutta.implicit_midpoint, 2, implicit=True)
    add("trapezoid", runge_kutta.trapezoid, 2, implicit=True)
    for family, stages, order in (
        (runge_kutta.gauss_legendre, 2, 4),
        (runge_kutta.gauss_legendre, 3, 6),
        (runge_kutta.lobatto_iiia, 3, 4),
        (runge_kutta.lobatto_iiic, 2, 2),
        (runge_kutta.lobatto_iiic, 3, 4),
        (runge_kutta.radau_iia, 2, 3),
        (runge_kutta.radau_iia, 3, 5),
    ):
        add(f"{family.__name__}{stages}", partial(family, stages), order, implicit=True)
    add("sdirk2", runge_kutta.SDIRK2, 2, implicit=True)
    for kvaerno, order in (
        (diffrax.Kvaerno3, 3),
        (diffrax.Kvaerno4, 4),
        (diffrax.Kvaerno5, 5),
    ):
        make = partial(kvaerno, root_finder=very_chord(), root_find_max_steps=MAX_STEPS)
        add(kvaerno.__name__.lower(), make, order, implicit=True)
    add("ros2", rosenbrock.ros2, 2, implicit=True)
    add("ros34pw2", rosenbrock.ros34pw2, 3, implicit=True)

    for k in range(1, 6):
        add(f"adams_bashforth{k}", partial(multistep.adams_bashforth, k), k, adaptive=k > 1)
    for k in range(2, 6):
        add(f"adams_moulton{k}", partial(multistep.adams_moulton, k), k, implicit=True)
    for k in range(2, 6):
        add(f"pece{k}", partial(multistep.pece, k), k)
    for k in range(1, 7):
        add(f"bdf{k}", partial(multistep.bdf, k), k, implicit=True)

    for second in (second_order.newmark, second_order.hht_alpha, second_order.generalized_alpha):
        add(second.__name__, second, 2, "second-order", True, False)
    add("central_differences", second_order.CentralDifferences, 2, "second-order", False, False)
    add("semi_implicit_euler", second_order.SemiImplicitEuler, 1, "second-order", True, False)
    add("variational_midpoint", second_order.VariationalMidpoint, 2, "second-order", True, False)

    for split, order in (
        (splitting.symplectic_euler, 1),
        (splitting.stoermer_verlet, 2),
        (splitting.yoshida4, 4),
        (splitting.yoshida6, 6),
    ):
        add(split.__name__, split, order, "split", adaptive=False)

    for k in range(2, 6):
        add(f"rkmk{k}", partial(lie.rkmk, k), k, "lie")
    add("crouch_grossman3", lie.CrouchGrossman3, 3, "lie", adaptive=False)
    add("commutator_free4", lie.CommutatorFree4, 4, "lie", adaptive=False)
    add("lie_generalized_alpha", second_order.generalized_alpha, 2, "lie", True, False)
    add("rigid_body_splitting", lie.RigidBodySplitting, 2, "lie", adaptive=False)
    return out
