"""Coefficients against the textbook's, at equal steps; orders at unequal ones; the start."""

from fractions import Fraction

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.solvers import adams_bashforth, bdf, pece
from rbjax.solvers.multistep import basis, integrals, slopes_at_one
from tests.oracles import load
from tests.solvers.scenes import SCENES

ORACLE = load("ode_methods")
SCENE = SCENES["ode"]


@pytest.mark.parametrize("name", [n for n in ORACLE if n[:2] in ("AB", "AM", "BD")])
def test_equal_steps_give_the_textbook_coefficients(name: str) -> None:
    want = np.array([float(Fraction(x)) for x in ORACLE[name]])
    n = len(want)
    if name.startswith("BDF"):
        got = slopes_at_one(1.0 - jnp.arange(n))[::-1]
    else:
        nodes = jnp.arange(0.0, -n, -1.0) + (1.0 if name.startswith("AM") else 0.0)
        got = integrals(nodes).sum(1)
    np.testing.assert_allclose(got, want, atol=2e-14)


def test_basis_is_one_at_its_node_and_zero_at_others() -> None:
    nodes = jnp.array([1.0, 0.0, -0.7, -2.0, -2.1])
    powers = nodes[None, :] ** jnp.arange(5)[:, None]
    np.testing.assert_allclose(basis(nodes) @ powers, np.eye(5), atol=1e-13)


@pytest.mark.parametrize(
    ("solver", "order"),
    [
        (bdf(2), 2),
        (adams_bashforth(4), 4),
        (pece(3), 3),
        pytest.param(bdf(3), 3, marks=pytest.mark.slow),
        pytest.param(adams_bashforth(2), 2, marks=pytest.mark.slow),
    ],
)
def test_order_at_unequal_steps(solver, order: int) -> None:
    """Steps of 1 : 1.4 in turn."""

    @jax.jit
    def end(ts, steps):
        def once(i, carry):
            y, state = carry
            t0, t1 = ts[i], ts[i + 1]
            y, _, _, state, _ = solver.step(
                SCENE.term, t0, t1, y, SCENE.args, state, made_jump=False
            )
            return y, state

        y0 = jnp.asarray(SCENE.y0)
        state = solver.init(SCENE.term, ts[0], ts[1], y0, SCENE.args)
        return jax.lax.fori_loop(0, steps, once, (y0, state))[0]

    def error(n):
        ts = np.append(0.0, np.cumsum(np.where(np.arange(n) % 2, 1.4, 1.0)))
        ts = np.pad(ts / ts[-1] * SCENE.end, (0, 128 - n), mode="edge")
        return np.abs(np.asarray(end(ts, n)) - SCENE.exact).max()

    found = np.array([error(n) for n in (32, 64, 128)])
    assert abs(np.log2(found[:-1] / found[1:]) - order).max() < 0.2, found


@pytest.mark.slow
def test_a_jump_starts_anew() -> None:
    """A kink in the field costs nothing if its time is given."""

    def field(t, y, args):
        return jnp.where(t < 1.0, 1.0, -2.0) * y * jnp.cos(t)

    exact = np.exp(np.sin(1.0) - 2 * (np.sin(2.0) - np.sin(1.0)))

    def error(n, **told):
        fixed = diffrax.PIDController(
            rtol=1e-3, atol=1e-3, dtmax=2 / n, dtmin=2 / n, force_dtmin=True
        )
        out = diffrax.diffeqsolve(
            diffrax.ODETerm(field), adams_bashforth(4), 0.0, 2.0, 2 / n, jnp.array(1.0),
            stepsize_controller=diffrax.ClipStepSizeController(fixed, **told),
        )  # fmt: skip
        return abs(float(out.ys[0]) - exact)

    told = {"jump_ts": jnp.array([1.0])}
    assert error(40, **told) < error(20, **told) / 10
    assert error(40, **told) < error(40) / 100
