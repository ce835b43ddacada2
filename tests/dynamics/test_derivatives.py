"""Analytic derivatives beside those of the definition by forward mode, and beside Pinocchio's."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.robots import QUICK, robot
from tests.tolerances import F64_IDENTITY, relative_error

STATES = 3


def by_forward_mode(model, q, v, x):
    """d ID of the definition: integrate along each tangent, and differentiate RNEA."""

    def forces(dq, dv, a):
        return rb.inverse_dynamics(model, rb.integrate(model, q, dq), v + dv, a)

    zero = jnp.zeros(model.nv)
    return jax.jacfwd(forces, (0, 1, 2))(zero, zero, x)


CASES = [
    "small, unrolled",
    "small, rolled",
    "tree:4, unrolled",
    pytest.param("humanoid, rolled", marks=pytest.mark.slow),
    *(pytest.param(f"tree:{k}, unrolled", marks=pytest.mark.slow) for k in (0, 2, 7, 9)),
    *(pytest.param(f"tree:{k}, rolled", marks=pytest.mark.slow) for k in (0, 1, 4, 8)),
]


@pytest.mark.parametrize("case", CASES)
def test_both_are_those_of_the_definition(case: str) -> None:
    sample = robot(*case.split(", "))
    model = sample.model
    q, v = sample.states(STATES)
    a = np.random.default_rng(3).normal(size=v.shape)

    def all_of_them(q, v, a):
        tau = rb.inverse_dynamics(model, q, v, a)
        by_q, by_v, M = by_forward_mode(model, q, v, a)
        forward = [-jnp.linalg.solve(M, x) for x in (by_q, by_v)] + [jnp.linalg.inv(M)]
        return (
            tuple(rb.inverse_dynamics_derivatives(model, q, v, a)),
            (by_q, by_v, M),
            tuple(rb.forward_dynamics_derivatives(model, q, v, tau)),
            tuple(forward),
        )

    run = jax.jit(jax.vmap(all_of_them), compiler_options=QUICK)
    inverse, inverse_wanted, forward, forward_wanted = run(q, v, a)
    for got, want in zip(inverse, inverse_wanted, strict=True):
        assert relative_error(got, want, batch_dims=1, floor=1.0).max() <= F64_IDENTITY
    for got, want in zip(forward, forward_wanted, strict=True):
        assert relative_error(got, want, batch_dims=1, floor=1.0).max() <= F64_IDENTITY
