"""The terms that solvers take: only in time, sums of them, and on groups."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.solvers.scenes import SOLVERS

ONE = jnp.array(1.0)
PATH = diffrax.LinearInterpolation(jnp.array([0.0, 0.5, 1.0]), jnp.array([0.0, 2.0, 1.0]))


def decay(t, y, args):
    return -y


def end(term, solver, y0=ONE, t1=0.5):
    return diffrax.diffeqsolve(term, solver, 0.0, t1, 0.05, y0).ys


@pytest.mark.parametrize("name", ["radau_iia3", "bdf2", "ros2", "adams_bashforth2", "rkmk4"])
@pytest.mark.parametrize("beside", [(), (diffrax.ODETerm(decay),)])
def test_a_control_other_than_time_is_refused(name: str, beside) -> None:
    """The field is per unit of time, so the result would be wrong without an error."""
    control = diffrax.ControlTerm(decay, PATH)
    term = diffrax.MultiTerm(*beside, control) if beside else control
    with pytest.raises(rb.InputError, match=r"ControlTerm.* expected a term in time only.*to_ode"):
        end(term, SOLVERS[name].make())


def test_a_control_made_a_rate_is_taken() -> None:
    """y' = -y x', x from 0 to 2."""
    got = end(diffrax.ControlTerm(decay, PATH).to_ode(), rb.solvers.radau_iia(3))
    np.testing.assert_allclose(got[0], np.exp(-2), rtol=1e-6)


@pytest.mark.parametrize("solver", [rb.solvers.gauss_legendre(3), rb.solvers.rkmk(5)])
def test_sums_of_terms_are_taken(solver) -> None:
    term = diffrax.MultiTerm(diffrax.ODETerm(decay), diffrax.ODETerm(lambda t, y, _: 0.5 * y))
    np.testing.assert_allclose(end(term, solver)[0], np.exp(-0.25), rtol=1e-9)


def test_sums_of_accelerations_are_taken() -> None:
    """v' = -q - v / 2, the damping apart."""
    spring = diffrax.ODETerm(lambda t, y, _: (y[1], -y[0]))
    damper = diffrax.ODETerm(lambda t, y, _: (0 * y[1], -y[1] / 2))
    together = diffrax.ODETerm(lambda t, y, _: (y[1], -y[0] - y[1] / 2))
    got, want = (
        end(term, rb.solvers.newmark(), (ONE, 0 * ONE))
        for term in (diffrax.MultiTerm(spring, damper), together)
    )
    np.testing.assert_allclose(got, want, rtol=1e-13)


@pytest.mark.parametrize("name", ["radau_iia2", "bdf2", "ros2", "adams_bashforth3"])
def test_a_term_on_a_group_is_refused_where_increments_add(name: str) -> None:
    body = rb.solvers.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    with pytest.raises(rb.InputError, match=r"on the group Product, expected a vector field.*rkmk"):
        end(body, SOLVERS[name].make(), (jnp.array([1.0, 0, 0, 0]), jnp.ones(3)))
