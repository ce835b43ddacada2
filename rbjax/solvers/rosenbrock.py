"""Rosenbrock-W methods: linearly implicit methods that keep their order for any matrix J.

    (I - h gamma J) k_i = h f(t0 + alpha_i h, y0 + sum_j alpha_ij k_j) + h J sum_j gamma_ij k_j
                          + gamma_i h^2 df/dt,    y1 = y0 + sum_i b_i k_i
A step needs one Jacobian and one factorization. The coefficients are checked against the order
conditions of W-methods.

Source: Hairer & Wanner, *Solving Ordinary Differential Equations II*, IV.7; Rang & Angermann, *BIT*
45, 2005.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np

from rbjax.display import displayed
from rbjax.lanes import matvec
from rbjax.solvers.field import flatten, linearize
from rbjax.solvers.root_finding import iterative, mark_failed, step_result, stop_gradient
from rbjax.solvers.steps import AbstractPolynomialSolver, hermite_coefficients, weighted_sums
from rbjax.solvers.tableau import TOLERANCE, Tree, density, trees


def _weights(alpha: np.ndarray, gamma: np.ndarray, tree: Tree, kinds: list[bool]) -> np.ndarray:
    """Return the elementary weights Phi_i (s,) of a rooted tree of a W-method.
    kinds: for each node with one branch, whether it has a factor J. The list is emptied."""
    matrix = gamma if len(tree) == 1 and kinds.pop(0) else alpha
    out = np.ones(len(alpha))
    for branch in tree:
        out = out * (matrix @ _weights(alpha, gamma, branch, kinds))
    return out


def _single(tree: Tree) -> int:
    """Return the number of nodes of a rooted tree that have one branch."""
    return (len(tree) == 1) + sum(map(_single, tree))


def holds(alpha: np.ndarray, gamma: np.ndarray, b: np.ndarray, order: int) -> bool:
    """Check the order conditions of W-methods: weight 1 / density for trees without J, 0 with J."""
    for tree in itertools.chain.from_iterable(trees(p) for p in range(1, order + 1)):
        for kinds in itertools.product([False, True], repeat=_single(tree)):
            target = 0 if any(kinds) else 1 / density(tree)
            if abs(b @ _weights(alpha, gamma, tree, list(kinds)) - target) > TOLERANCE:
                return False
    return True


@displayed
@dataclass(frozen=True)
class RosenbrockTableau:
    """Coefficients of a Rosenbrock-W method.

    Fields:
        alpha, gamma: (s, s), strictly lower triangular; lower triangular with a constant diagonal.
        b: (s,) weights of the method.
        companion: (s,) weights of the embedded method, whose order is one less.
        order: order of the method.
    """

    alpha: tuple[tuple[float, ...], ...]
    gamma: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    companion: tuple[float, ...]
    order: int

    def __post_init__(self) -> None:
        alpha, gamma = np.array(self.alpha), np.array(self.gamma)
        if np.ptp(np.diag(gamma)) or np.triu(alpha).any() or np.triu(gamma, 1).any():
            raise ValueError("rosenbrock: not singly diagonal")
        for b, order in ((self.b, self.order), (self.companion, self.order - 1)):
            if not holds(alpha, gamma, np.array(b), order):
                raise ValueError(f"rosenbrock: the order conditions of {order} do not hold")


class RosenbrockW(AbstractPolynomialSolver, diffrax.AbstractAdaptiveSolver):
    """A Rosenbrock-W method.

    Fields:
        tableau: coefficients of the method.
        linear_solver: a lineax solver; `lineax.GMRES` avoids the matrix.
    """

    tableau: RosenbrockTableau = eqx.field(static=True)
    linear_solver: lx.AbstractLinearSolver = eqx.field(default_factory=lx.LU)

    def order(self, terms):
        return self.tableau.order

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        (f, y), h = flatten(terms, args, t0, y0), t1 - t0
        alpha, gamma = np.array(self.tableau.alpha), np.array(self.tableau.gamma)
        diagonal = float(gamma[0, 0])
        if iterative(self.linear_solver):
            f0, push = jax.linearize(lambda y: f(t0, y), y)
            operator: Any = lx.FunctionLinearOperator(
                lambda k: k - h * diagonal * push(k), jax.eval_shape(lambda: y)
            )
        else:
            f0, jacobian = linearize(f, t0, y)
            push = functools.partial(matvec, jacobian)
            one = jnp.eye(y.size, dtype=y.dtype)
            operator = lx.MatrixLinearOperator(one - h * diagonal * jacobian)
        slope = jax.jvp(lambda t: f(t, y), (t0,), (t0 * 0 + 1,))[1]
        factors = stop_gradient(self.linear_solver.init(operator, {}))

        def stage(ks, row):
            i, alpha, gamma = row
            rate = f(t0 + alpha.sum().astype(h.dtype) * h, y + weighted_sums(alpha, ks))
            turned = push(weighted_sums(gamma, ks))
            right = h * (rate + turned) + (gamma.sum() + diagonal) * h * h * slope
            solved = lx.linear_solve(
                operator, right, self.linear_solver, state=factors, throw=False
            )
            sound = solved.result == lx.RESULTS.successful
            return ks.at[i].set(solved.value, mode="drop"), (rate, sound)

        # One more stage at y1, only for its rate, reuses the compiled body of the loop.
        alpha = np.vstack([alpha, self.tableau.b])
        below = np.vstack([np.tril(gamma, -1), np.zeros(len(gamma))])
        rows = (np.arange(len(alpha)), alpha.astype(y.dtype), below.astype(y.dtype))
        ks, (rates, sound) = jax.lax.scan(stage, jnp.zeros((len(gamma), y.size), y.dtype), rows)
        u, ok = weighted_sums(self.tableau.b, ks), sound[:-1].all()
        error = weighted_sums(np.subtract(self.tableau.b, self.tableau.companion), ks)
        coefficients = hermite_coefficients(u, h * f0, h * rates[-1])
        dense = {"y0": y0, "coefficients": jax.vmap(f.unravel)(coefficients)}
        return (
            f.unravel(y + u),
            f.unravel(mark_failed(ok, error)),
            dense,
            solver_state,
            step_result(ok),
        )


@functools.cache
def _ros2() -> RosenbrockTableau:
    g = 1 - 0.5**0.5
    return RosenbrockTableau(
        ((0.0, 0.0), (1.0, 0.0)), ((g, 0.0), (-2 * g, g)), (1 / 2, 1 / 2), (1.0, 0.0), 2
    )


@functools.cache
def _ros34pw2() -> RosenbrockTableau:
    g, b1, b2 = 4.3586652150845900e-1, 2.4212380706095346e-1, -1.2232505839045147
    return RosenbrockTableau(
        (
            (0.0, 0.0, 0.0, 0.0),
            (8.7173304301691801e-1, 0.0, 0.0, 0.0),
            (8.4457060015369423e-1, -1.1299064236484185e-1, 0.0, 0.0),
            (0.0, 0.0, 1.0, 0.0),
        ),
        (
            (g, 0.0, 0.0, 0.0),
            (-8.7173304301691801e-1, g, 0.0, 0.0),
            (-9.0338057013044082e-1, 5.4180672388095326e-2, g, 0.0),
            (b1, b2, 5.4526025533510214e-1, g),
        ),
        (b1, b2, 1.5452602553351021, g),
        (3.7810903145819369e-1, -9.6042292212423178e-2, 0.5, 2.1793326075422950e-1),
        3,
    )


def ros2(**options: Any) -> RosenbrockW:
    """Return Verwer's Rosenbrock-W method of two stages: order 2, L-stable.

    Args:
        options: fields of `RosenbrockW`.

    Example:
        >>> import rbjax as rb
        >>> rb.solvers.ros2().order(None)
        2
    """
    return RosenbrockW(_ros2(), **options)


def ros34pw2(**options: Any) -> RosenbrockW:
    """Return Rang and Angermann's Rosenbrock-W method of four stages: order 3, L-stable.

    Args:
        options: fields of `RosenbrockW`.

    See `ros2` for an example.
    """
    return RosenbrockW(_ros34pw2(), **options)
