"""Derivatives of inverse and forward dynamics against their definition and Pinocchio."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.random_trees import (
    acceleration_to_pinocchio,
    pinocchio_model,
    pinocchio_velocity_map,
    random_tree,
    to_pinocchio,
)
from rbjax.dynamics.tracing.operations import operation_count
from tests.robots import load_quietly, robot
from tests.tolerances import F64_IDENTITY, F64_PARITY, relative_error

STATES = 3
SLOW = pytest.mark.slow  # the definition's program takes long to compile
CASES = [  # robot, driver
    "double_pendulum, unrolled",
    "small, rolled",
    *(pytest.param(f"{name}, unrolled", marks=SLOW) for name in ("small", "free_body", "tree:4")),
    *(pytest.param(f"tree:{seed}, rolled", marks=SLOW) for seed in (0, 1, 2, 4, 8)),
    pytest.param("gymnasium/humanoid.xml, rolled", marks=SLOW),
]


def by_definition(model, q, v, a):
    """dID by forward mode: along tangents of the configuration, of v and of a."""

    def forces(dq, v, a):
        return rb.inverse_dynamics(model, rb.integrate(model, q, dq), v, a)

    return jax.jacfwd(forces, (0, 1, 2))(jnp.zeros(model.nv), v, a)


@pytest.mark.parametrize("case", CASES)
def test_they_are_those_of_the_definition(case: str) -> None:
    sample = robot(*case.split(", "))
    model = sample.model
    q, v = sample.states(STATES)
    a = np.random.default_rng(3).normal(size=v.shape)

    def both(q, v, a):
        wanted = by_definition(model, q, v, a)
        tau = rb.inverse_dynamics(model, q, v, a)
        return (
            tuple(rb.inverse_dynamics_derivatives(model, q, v, a)),
            tuple(rb.forward_dynamics_derivatives(model, q, v, tau)),
            wanted,
        )

    inverse, forward, wanted = jax.jit(jax.vmap(both))(q, v, a)
    by_q, by_v, M = map(np.asarray, wanted)
    solved = -np.linalg.solve(M, by_q), -np.linalg.solve(M, by_v), np.linalg.inv(M)
    for got, want in zip((*inverse, *forward), (*wanted, *solved), strict=True):
        assert relative_error(got, want, batch_dims=1, floor=1.0).max() <= F64_IDENTITY


def test_half_the_arithmetic_of_an_arm() -> None:
    """Forward mode takes 24,000 operations for an arm of seven joints."""
    sample = robot("arm7", "unrolled")
    q, v = (x[0] for x in sample.states(1))
    assert operation_count(rb.forward_dynamics_derivatives, sample.model, q, v, v).total < 10_000


@pytest.mark.parametrize("seed", [pytest.param(k, marks=SLOW) if k else k for k in range(6)])
def test_they_are_those_of_pinocchio(seed: int) -> None:
    """On trees without a free base, whose coordinates are Pinocchio's, and of one joint a body: it
    takes the axes of several (`Composite`) for constant."""
    pinocchio = pytest.importorskip("pinocchio", reason="pin is not installed")
    text = random_tree(seed, pinocchio_safe=True, free_root=False, bodies=5, several=0.0)
    reference, peer = mujoco.MjModel.from_xml_string(text), pinocchio_model(text)
    model = load_quietly(reference)
    rng = np.random.default_rng(seed)
    v, a = rng.normal(size=(2, model.nv))
    q = np.asarray(rb.integrate(model, model.default_state().q, rng.normal(size=model.nv)))
    qp, vp = to_pinocchio(reference, q, v)
    assert (pinocchio_velocity_map(reference, q) == np.eye(model.nv)).all()
    ap = acceleration_to_pinocchio(reference, q, v, a)
    data = peer.createData()
    wanted = pinocchio.computeRNEADerivatives(peer, data, qp, vp, ap)
    got = rb.inverse_dynamics_derivatives(model, q, v, a)
    for x, want in zip(got[:2], wanted[:2], strict=True):
        assert relative_error(x, want, floor=1.0) <= F64_PARITY
    tau = pinocchio.rnea(peer, data, qp, vp, ap)
    wanted = pinocchio.computeABADerivatives(peer, data, qp, vp, tau)
    inverse = np.triu(wanted[2]) + np.triu(wanted[2], 1).T
    got = rb.forward_dynamics_derivatives(model, q, v, tau)
    for x, want in zip(got, (*wanted[:2], inverse), strict=True):
        assert relative_error(x, want, floor=1.0) <= F64_PARITY
