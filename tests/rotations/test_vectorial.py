"""Masarati's Table A.1: the vectorial parametrizations against their closed forms, row by row."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from mpmath import mp

from rbjax.rotations import representations, vectorial
from rbjax.rotations.representation import Representation
from tests.oracles.vectorial import TABLE, Row
from tests.rotations import exact
from tests.tolerances import relative_error

AXES = np.array([[1.0, -2.0, 2.0], [0.6, 0.0, -0.8]]) / [[3.0], [1.0]]
#: representation -> its row, and what p is multiplied by
ROWS = {name: (name, 1.0) for name in TABLE} | {"gibbs": ("cayley", 0.5)}
ROWS["mrp"] = ("wiener_milenkovic", 0.25)


def angles(row: Row) -> np.ndarray:
    """At and near zero, anywhere, and up to the end."""
    near = [0.0, 1e-300, 1e-12, 1e-8, 1e-5, 1e-3, 0.1]
    return np.array([*near, *(row.end * np.array([0.3, 0.6, 0.9])),
                     *(row.end - np.array([1e-2, 1e-4, 1e-6]))])  # fmt: skip


def closed_forms(row: Row, x: np.ndarray, scale: float) -> list[np.ndarray]:
    """R, H and H^-1 at the very numbers x, in a hundred digits."""
    with mp.workdps(exact.DIGITS):
        p = [a / mpmath.mpf(scale) for a in exact.numbers(x)]
        K, one = exact.hat(p), mpmath.eye(3)
        if not any(p):
            matrices = [one, one / scale, one * scale]
        else:
            t = row.angle(exact.norm(p))
            mu, z1, z2, z3, g = (f(t) for f in (row.mu, row.zeta1, row.zeta2, row.zeta3, row.gamma))
            H, back = mu * one + z2 * K + z3 * K * K, one / mu - K / 2 + g * K * K
            matrices = [one + z1 * K + z2 * K * K, H / scale, back * scale]
        return [np.array(M.tolist(), float) for M in matrices]


@pytest.mark.parametrize("name", TABLE)
def test_the_table_is_right(name: str) -> None:
    """R by the power series of its logarithm, H by differences of R, H^-1 by elimination."""
    row = TABLE[name]
    with mp.workdps(exact.DIGITS):

        def rotation(p: list) -> mpmath.matrix:
            t = row.angle(exact.norm(p))
            return exact.series(exact.hat([a * t / exact.norm(p) for a in p]))

        for share in (0.01, 0.5, 0.97):
            t = mpmath.mpf(share) * row.end
            assert abs(row.angle(row.p(t)) - t) < 1e-90
            assert abs(row.mu(t) * mpmath.diff(row.p, t) - 1) < 1e-40
            x = np.array([float(row.p(t) * a) for a in exact.numbers(AXES[0])])
            R, H, back = closed_forms(row, x, 1.0)
            _, space = exact.rate_matrices(rotation, exact.numbers(x))
            for got, want in ((R, rotation(exact.numbers(x))), (H, space), (back, space**-1)):
                assert relative_error(got, np.array(want.tolist(), float)) <= 4e-16


@pytest.mark.parametrize("name", ROWS)
def test_table_a1(name: str) -> None:
    """Rotation and map, both ways and from both sides: R, H, H^T, and their inverses."""
    key, scale = ROWS[name]
    row, rep = TABLE[key], (
        representations().get(name) or Representation(name, vectorial.VECTORIAL[name])
    )  # fmt: skip
    with mp.workdps(30):
        sizes = [float(scale * row.p(mpmath.mpf(t))) for t in angles(row)]
    x = np.concatenate([np.outer(sizes, axis) for axis in AXES])
    left = row.end - np.tile(angles(row), len(AXES))

    @jax.jit
    def ours(x: jax.Array) -> tuple[jax.Array, ...]:
        return (
            rep.to_matrix(x), rep.space_rate_matrix(x), rep.inverse_space_rate_matrix(x),
            jnp.swapaxes(rep.body_rate_matrix(x), 1, 2),
            jnp.swapaxes(rep.inverse_body_rate_matrix(x), 1, 2),
        )  # fmt: skip

    R, H, back = (np.array(M) for M in zip(*(closed_forms(row, a, scale) for a in x), strict=True))
    # near the end a unit in the last place of x is as much more of cos: of sine-like p with the
    # square of the distance, of the Euler vector's pole with the distance
    sine = key in ("linear", "reduced_euler_rodrigues")
    limit = 1e-15 * np.maximum(1, left ** -(2.0 if sine else 1.0))
    for got, want in zip(ours(x), (R, H, back, H, back), strict=True):
        error = relative_error(got, want, batch_dims=1, floor=0.0)
        assert (error <= limit).all(), (error / limit).max()
