"""Values and derivatives are finite and right where a formula could divide by zero.

At rest, at the identity, at half a turn, straight, without forces: one at a time and all at once,
against central differences on the tangent space of the configuration.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.robots import robot
from tests.tolerances import GRADIENT, relative_error

STEP = 6e-6  # of central differences: the cube root of the rounding unit
ROBOTS = ["small, rolled", "free_body, unrolled"]
IDENTITY, HALF_TURN = np.array([1.0, 0, 0, 0]), np.array([0.0, 0.6, 0, 0.8])
POINTS = {  # which of q, v, tau are special
    "generic": (None, 1.0, 1.0),
    "at rest": (None, 0.0, 1.0),
    "no force": (None, 1.0, 0.0),
    "at rest, no force": (None, 0.0, 0.0),
    "identity": (IDENTITY, 1.0, 1.0),
    "identity, its other sign": (-IDENTITY, 1.0, 1.0),
    "half a turn": (HALF_TURN, 1.0, 1.0),
    "identity, at rest, no force": (IDENTITY, 0.0, 0.0),
}


@functools.cache
def programs(case: str):
    """Values along tangents, and their derivatives forwards and backwards."""
    model = robot(*case.split(", ")).model

    def values(q, v, tau, dq, dv, dtau):
        q, v = rb.integrate(model, q, dq), v + dv
        return (
            rb.forward_dynamics(model, q, v, tau + dtau),
            rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q),
            rb.applied_forces(model, rb.State(q, v)),
        )

    def derivatives(q, v, tau, tangents):
        f = functools.partial(values, q, v, tau)
        zeros = jax.tree.map(jnp.zeros_like, tangents)
        here, rate = jax.jvp(f, zeros, tangents)
        return here, rate, jax.vjp(f, *zeros)[1](jax.tree.map(jnp.ones_like, here))

    return tuple(jax.jit(f) for f in (values, derivatives))


@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("case", ROBOTS)
def test_derivatives(case: str, point: str) -> None:
    sample = robot(*case.split(", "))
    attitude, speed, force = POINTS[point]
    (q,), (v,) = sample.states(1)
    rng = np.random.default_rng(0)
    if attitude is not None:
        q = np.array(sample.model.default_state().q)  # the other joints at their zero, too
        for start in sample.model.topology.quaternion_starts:
            q[start : start + 4] = attitude
    tangents = tuple(rng.normal(size=(3, v.size)))
    tau = force * rng.normal(size=v.size)
    values, derivatives = programs(case)
    here, rate, gradient = derivatives(q, speed * v, tau, tangents)
    by_reverse = sum((g * t).sum() for g, t in zip(gradient, tangents, strict=True))
    ends = [values(q, speed * v, tau, *(side * STEP * x for x in tangents)) for side in (-1, 1)]
    slope = [(right - left) / (2 * STEP) for left, right in zip(*ends, strict=True)]
    for x in jax.tree.leaves((here, rate, gradient)):
        assert np.isfinite(x).all()
    if attitude is HALF_TURN and case == "small, rolled":
        # the ball's spring is wound by half a turn: its rest lies either way, and so do the ends
        rate, slope = rate[:2], slope[:2]
    else:
        assert relative_error(by_reverse, sum(x.sum() for x in rate), floor=1.0) <= GRADIENT
    for got, want in zip(rate, slope, strict=True):
        assert relative_error(got, want, floor=1.0) <= GRADIENT


def test_a_straight_arm_is_no_singularity_of_the_dynamics() -> None:
    model = rb.load("double_pendulum")

    @jax.jit
    def at(q, v):
        def f(q, v):
            return rb.forward_dynamics(model, q, v, jnp.zeros(2)).sum()

        return jax.grad(f, (0, 1))(q, v), jax.hessian(f)(q, v)

    def central(q, v):
        steps = STEP * np.eye(2)
        f = jax.jit(lambda q, v: rb.forward_dynamics(model, q, v, jnp.zeros(2)).sum())
        return np.array([(f(q + h, v) - f(q - h, v)) / (2 * STEP) for h in steps])

    for q in (np.zeros(2), np.array([np.pi, 0.0]), np.array([0.3, np.pi])):
        for v in (np.zeros(2), np.array([0.5, -1.0])):
            (by_q, by_v), second = at(q, v)
            assert relative_error(by_q, central(q, v), floor=1.0) <= GRADIENT
            assert np.isfinite(by_v).all() and np.isfinite(second).all()


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-8, 1e-5, 1e-3, 0.3])
def test_second_derivatives_on_the_manifold(size: float) -> None:
    """difference(q, integrate(q, dq)) = dq: one as a Jacobian, zero as a Hessian."""
    q = robot("free_body").states(1)[0][0]
    first, second = manifold()(q, size * np.array([1.0, 2, 3, -1, 0.5, 2]))
    assert relative_error(first, np.eye(6)) <= 1e-13
    assert np.abs(second).max() <= 1e-11  # derivatives of the series' coefficients cancel


@functools.cache
def manifold():
    model = rb.load("free_body")

    def f(q, dq):
        return rb.difference(model, q, rb.integrate(model, q, dq))

    first, second = jax.jacfwd(f, 1), jax.jacfwd(jax.jacrev(f, 1), 1)
    return jax.jit(lambda q, dq: (first(q, dq), second(q, dq)))


def test_difference_of_a_configuration_with_itself() -> None:
    model = robot("small").model
    q = robot("small").states(1)[0][0]

    @jax.jit
    def at(q0, q1):
        def f(a, b):
            return rb.difference(model, rb.integrate(model, q0, a), rb.integrate(model, q1, b))

        zero = jnp.zeros(model.nv)
        return f(zero, zero), *jax.jacrev(f, (0, 1))(zero, zero)

    value, by_first, by_second = at(q, q)
    assert np.abs(value).max() <= 1e-15
    assert relative_error(by_first, -np.eye(5)) <= 1e-14
    assert relative_error(by_second, np.eye(5)) <= 1e-14
