"""Dense output: its own order between the steps, and on the manifold."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from rbjax.solvers.multistep import AbstractMultistep
from tests.solvers.scenes import SOLVERS, scene

#: name -> order of the values between steps: at most that of the solver
DENSE = {
    "gauss_legendre2": 3,  # the degree of the collocation polynomial, and one
    "lobatto_iiia3": 4,
    "radau_iia3": 4,
    "sdirk2": 2,
    "ros34pw2": 3,
    "adams_bashforth4": 4,
    "pece3": 3,
    "bdf4": 4,
    "generalized_alpha": 2,
    "yoshida4": 4,
    "rkmk4": 4,
}
QUICK = ("radau_iia3", "adams_bashforth4", "rkmk4")
NAMES = [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in DENSE]


@pytest.mark.parametrize("name", NAMES)
def test_order_between_the_steps(name: str) -> None:
    s, solver = scene(name), SOLVERS[name].make()
    ts = jnp.linspace(0.0, s.end, 101)

    @jax.jit
    def path(steps):
        return diffrax.diffeqsolve(
            s.term, solver, 0.0, s.end, s.end / steps, s.y0, s.args,
            saveat=diffrax.SaveAt(ts=ts), max_steps=None,
        ).ys  # fmt: skip

    multistep = isinstance(solver, AbstractMultistep)  # with a start to leave behind
    steps = (1600.0, 64.0, 128.0) if multistep else (1600.0, 32.0, 64.0)
    exact, coarse, fine = (path(n) for n in steps)

    def error(got):
        pairs = zip(jax.tree.leaves(got), jax.tree.leaves(exact), strict=True)
        return max(float(np.abs(a - b).max()) for a, b in pairs)

    order = np.log2(error(coarse) / error(fine))
    assert DENSE[name] - 0.3 < order < DENSE[name] + 0.6, order
    if SOLVERS[name].kind == "lie":
        lengths = np.linalg.norm(coarse[0], axis=-1)
        np.testing.assert_allclose(lengths, 1, atol=4e-16)


def test_events_and_dense_solutions_are_found_through_it() -> None:
    """The quarter period of a spring, by an event; the whole path, evaluated afterwards."""
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, _: (y[1], -y[0])), SOLVERS["yoshida4"].make(), 0.0, 3.0, 0.1,
        (jnp.array(1.0), jnp.array(0.0)), saveat=diffrax.SaveAt(t1=True, dense=True),
        event=diffrax.Event(lambda t, y, args, **_: y[0], optx.Bisection(1e-10, 1e-10)),
    )  # fmt: skip
    assert abs(found.ts[0] - np.pi / 2) < 5e-5
    assert abs(found.evaluate(1.03)[0] - np.cos(1.03)) < 5e-5
