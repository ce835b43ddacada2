"""Identities of the equations of motion that hold for every robot, with both sides computed.

One compiled program for each robot computes both sides. MuJoCo is the reference for momentum.
"""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.dynamics.algorithms.rnea import momentum
from tests.robots import at, robot
from tests.tolerances import F64_IDENTITY, F64_PARITY, GRADIENT, relative_error

STATES = 8
STEP = 6e-6  # of central differences: the cube root of the rounding unit
CASES = [  # robot, driver
    "double_pendulum, unrolled",
    pytest.param("small, rolled", marks=pytest.mark.slow),
    pytest.param("quadruped, rolled", marks=pytest.mark.slow),
    pytest.param("small, unrolled", marks=pytest.mark.slow),
    pytest.param("free_body, unrolled", marks=pytest.mark.slow),
    pytest.param("arm7, rolled", marks=pytest.mark.slow),
    pytest.param("tree:0, rolled", marks=pytest.mark.slow),
    pytest.param("tree:4, rolled", marks=pytest.mark.slow),
]


def both_sides(model: rb.Model, q, v, a, w):
    """identity -> (one side, the other)."""
    zero = jnp.zeros(model.nv)
    some = sorted({0, model.nb // 2, model.nb - 1})  # bodies; each Jacobian is one more program
    w = jnp.zeros_like(w).at[jnp.array(some)].set(w[jnp.array(some)])

    def in_free_fall(t):
        moved = rb.integrate(model, q, v * t), v + rb.forward_dynamics(model, q, v, zero) * t
        T = rb.kinetic_energy(model, *moved)
        return rb.mass_matrix(model, moved[0]), T + rb.potential_energy(model, moved[0])

    M, C = rb.mass_matrix(model, q), rb.coriolis_matrix(model, q, v)
    g, b = rb.gravity_forces(model, q), rb.bias_forces(model, q, v)
    tau = rb.inverse_dynamics(model, q, v, a, w)
    J = jnp.stack([rb.jacobian(model, q, model.body_names[b]) for b in some])
    Jw = jnp.einsum("bin,bi->n", J, w[jnp.array(some)])
    pi, Y = rb.inertial_parameters(model), rb.inertial_regressor(model, q, v, a)
    M_rate, power = jax.jvp(in_free_fall, (0.0,), (1.0,))[1]
    return {
        "M is symmetric": (M, M.T),
        "M = d tau / d a": (
            M,
            jax.jacfwd(functools.partial(rb.inverse_dynamics, model, q, v))(zero),
        ),
        "M M^-1 = 1": (M @ rb.inverse_mass_matrix(model, q), jnp.eye(model.nv)),
        "M v = p": (M @ v, momentum(model, q, v)),
        "M a + b - J^T w = tau": (M @ a + b - Jw, tau),
        "wrenches are J^T w": (rb.dynamics.generalized_forces(model, q, w), Jw),
        "velocities are J v": (rb.body_velocities(model, q, v)[jnp.array(some)], J @ v),
        "FD undoes ID": (rb.forward_dynamics(model, q, v, tau, w), a),
        "C v + g = b": (C @ v + g, b),
        "M' = C + C^T": (M_rate, C + C.T),
        "T = v M v / 2": (rb.kinetic_energy(model, q, v), v @ M @ v / 2),
        "g = dU / dq": (
            g,
            jax.grad(lambda dq: rb.potential_energy(model, rb.integrate(model, q, dq)))(zero),
        ),
        "regressor": (
            Y @ pi + model.joints.armature * a,
            rb.inverse_dynamics(model, q, v, a),
        ),
        "free fall keeps T + U": (power, 0 * power),
        "minus after plus": (rb.difference(model, q, rb.integrate(model, q, 0.3 * a)), 0.3 * a),
    }  # fmt: skip


def compiled(f):
    return jax.jit(jax.vmap(f))


@functools.cache
def sides(case: str):
    sample = robot(*case.split(", "))
    q, v = sample.states(STATES)
    rng = np.random.default_rng(1)
    a, w = rng.normal(size=v.shape), rng.normal(size=(STATES, sample.model.nb, 6))
    scale = np.abs(at(sample.reference, q[0], v[0]).qfrc_bias).max()
    return compiled(functools.partial(both_sides, sample.model))(q, v, a, w), scale


@pytest.mark.parametrize("case", CASES)
def test_identities(case: str) -> None:
    pairs, bias = sides(case)
    assert np.linalg.eigvalsh(pairs["M is symmetric"][0]).min() > 0
    for name, (left, right) in pairs.items():
        floor = 1e-3
        if name in ("M' = C + C^T", "g = dU / dq"):
            floor = 1.0  # sums of larger terms that may cancel, as in a robot of constant M
        if name == "free fall keeps T + U":
            floor = max(1.0, bias)  # two powers of this size cancel
        error = relative_error(left, right, batch_dims=1, floor=floor)
        assert error.max() <= F64_IDENTITY, name


@pytest.mark.parametrize("case", CASES)  # those of every kind of joint: test_derivatives.py
def test_partial_derivatives(case: str) -> None:
    """Of inverse and forward dynamics with respect to q (tangent), v, and a or tau."""
    sample = robot(*case.split(", "))
    model = sample.model
    q, v = sample.states(3)
    x = np.random.default_rng(2).normal(size=v.shape)

    def difference(f, q, v, x):
        def moved(column, side):
            step = side * STEP * column
            return (
                f(model, rb.integrate(model, q, step), v, x),
                f(model, q, v + step, x),
                f(model, q, v, x + step),
            )

        def slope(column):
            ends = zip(moved(column, 1.0), moved(column, -1.0), strict=True)
            return tuple((right - left) / (2 * STEP) for right, left in ends)

        return jax.vmap(slope, out_axes=1)(jnp.eye(model.nv))

    def pairs(q, v, x):
        tau = rb.inverse_dynamics(model, q, v, x)
        return (
            tuple(rb.inverse_dynamics_derivatives(model, q, v, x)),
            difference(rb.inverse_dynamics, q, v, x),
            tuple(rb.forward_dynamics_derivatives(model, q, v, tau)),
            difference(rb.forward_dynamics, q, v, tau),
        )

    inverse, inverse_slopes, forward, forward_slopes = compiled(pairs)(q, v, x)
    for got, want in zip((*inverse, *forward), (*inverse_slopes, *forward_slopes), strict=True):
        assert relative_error(got, want, batch_dims=1, floor=1.0).max() <= GRADIENT


@pytest.mark.parametrize("case", ["small, unrolled", "quadruped, rolled"])
def test_momentum_is_that_of_mujoco(case: str) -> None:
    sample = robot(*case.split(", "))
    q, v = sample.states(STATES)

    def ours(q, v):
        return rb.center_of_mass(sample.model, q), rb.centroidal_momentum(sample.model, q, v)

    com, momentum = jax.jit(jax.vmap(ours))(q, v)
    mass = sample.reference.body_mass.sum()
    for k in range(STATES):
        data = at(sample.reference, q[k], v[k])
        mujoco.mj_subtreeVel(sample.reference, data)
        want = np.r_[data.subtree_angmom[0], mass * data.subtree_linvel[0]]
        assert relative_error(com[k], data.subtree_com[0]) <= F64_PARITY
        assert relative_error(momentum[k], want) <= F64_PARITY
