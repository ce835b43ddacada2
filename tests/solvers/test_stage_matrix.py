"""Stage equations whose rows vanish, or turn round between the stages of a step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.solvers import radau_iia
from rbjax.solvers.constrained.differential_algebraic import DAE, StepStart, solve
from rbjax.solvers.constrained.schur_complement import Factored, Matrix
from rbjax.solvers.constrained.simplified import weights

TABLEAU = radau_iia(3).tableau
FORCE = 7.0


def cross(index: int, redundant: bool) -> DAE:
    """A unit mass that moves along x or along y, x y = 0, under a force across that grows with x:
    its row vanishes where both do."""
    again = 2 if redundant else 1

    def f(t, z, rate, w):
        (x, y, vx, vy), (dx, dy, ax, ay) = z, rate
        l = w.sum()
        row = x * y if index == 3 else x * vy + y * vx
        off = [dx - vx, dy - vy, ax - l * y, ay - (FORCE + l) * x]
        return jnp.stack([*off, *[row] * again])

    return DAE(f, (index - 1,) * again, jnp.ones(again), 2)


@pytest.mark.parametrize("index, redundant", [(2, False), (3, False), (3, True)])
def test_a_step_through_the_middle_of_a_cross(index: int, redundant: bool) -> None:
    """Along x at 1 m/s, from places where a stage is at the middle, near it, or on both sides."""
    h, equations = 0.1, cross(index, redundant)
    of_stages = weights(np.array(TABLEAU.a), jnp.float64)
    m = len(equations.depth)

    @jax.jit
    def after(x):
        y = jnp.stack([x, 0.0 * x, 1.0 + 0.0 * x, 0.0 * x])
        start = StepStart(0.0, y, jnp.array([1.0, 0, 0, 0]), jnp.zeros(m))
        base = jnp.broadcast_to(y, (3, 4))
        found = solve(equations, h, h * jnp.array(TABLEAU.c), base, of_stages, start)
        return found.ok, y + h * jnp.array(TABLEAU.b) @ found.rates, found.w

    places = -h * np.array([*TABLEAU.c, 0.5, 0.155, 0.99])
    for x in [*places[:3] + 1e-3, *places[:3] - 1e-5, *places[3:]]:
        ok, end, w = after(jnp.array(x))
        assert ok and np.isfinite(w).all()
        np.testing.assert_allclose(end[:2], [x + h, 0], atol=1e-8)
        np.testing.assert_allclose(end[2:], [1, 0], atol=1e-4)  # what is left of w, from zero


def test_eigenvalues_of_either_sign() -> None:
    """Of S = diag(1, -e, 0), e as small as what would be added: the solution is not larger than
    what least squares make it, and rows that do nothing leave w where it was."""
    e = 1e-8
    one, none = jnp.eye(3), jnp.zeros((3, 3))
    matrix = Matrix(one, none, none, jnp.diag(jnp.array([1.0, -e, 0.0])))

    @jax.jit
    def found(b, c):
        return Factored(matrix, jnp.ones(1), e).once(b, c)

    r = jnp.concatenate([jnp.zeros((3, 1)), jnp.array([[2.0], [e], [0.0]])], 1)
    w = found(r, jnp.array([[0.0], [0.0], [5.0]]))[:, 1]
    np.testing.assert_allclose(w[0], 2.0, rtol=1e-12)
    np.testing.assert_allclose(w[2], 5.0, rtol=1e-12)
    assert abs(w[1]) < 1.0
    assert jax.tree.all(jax.tree.map(lambda x: np.isfinite(x).all(), w))
