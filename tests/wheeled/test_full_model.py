"""The multibody model of wheeled robots against the reduced equations, which it shares no dynamics
with, and against momentum and the book's separation of wrenches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import wheeled
from rbjax.constraints import jacobian
from rbjax.model import State
from rbjax.wheeled.constrained import Constrained, full_state
from rbjax.wheeled.equations import project
from rbjax.wheeled.fidelity import angle_rates, angles_of, gravity_pull, kinetic_energy
from rbjax.wheeled.velocities import Moving, ideal, moving, rates, shape_of
from tests.quickly import quick_jit
from tests.tolerances import F64_IDENTITY, relative_error

KINDS = wheeled.kinds()
QUICK = ("differential_drive", "mecanum", "tricycle", "skid_steer")
SAMPLES = 5
every_kind = pytest.mark.parametrize(
    "name", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in KINDS]
)


def on_a_slope(name):
    return KINDS[name].make().replace(slope=jnp.array([0.1, -0.05]))


def stacked(lanes):
    return jnp.stack([jnp.asarray(x, float) for x in lanes])


def samples(fidelity, seed=0):
    """Random coordinates, free velocities and controls."""
    rng = np.random.default_rng(seed)
    for _ in range(SAMPLES):
        q = rng.uniform(-0.6, 0.6, fidelity.nq)
        yield q, 2 * rng.normal(size=fidelity.nv), rng.normal(size=fidelity.nu)


def full_rates(n, now, w, change):
    """w' by that of the free velocities."""
    angles = angles_of(n, now)
    shape = shape_of(n, moving(angles, angle_rates(n, now, w)))
    return rates(ideal(n, shape, [Moving(a, b) for a, b in zip(now.v, change, strict=True)]))


@every_kind
def test_accelerations_energy_and_momentum(name):
    robot = on_a_slope(name)
    reduced, full = wheeled.at(robot, "kinematical"), Constrained(robot)
    eliminated = wheeled.at(robot, "dynamical")

    def found(q, v, u):
        n, now = reduced.instant(State(q, v), u)
        w = reduced.full(n, now)
        then = now._replace(v=w)
        model, state = full_state(n, then, w)
        resting = now._replace(u=now.u[: len(robot.drives)] + [0.0] * len(robot.steerings))
        still = model_and_energy = full_state(n, resting, w)
        T = rb.kinetic_energy(*[still[0], still[1].q, still[1].v])
        return {
            "w": stacked(w),
            "on rows": stacked(full.full(n, then)),
            "by twists": stacked(full_rates(n, now, w, reduced.accelerations(n, now))),
            "by multipliers": stacked(full_rates(n, now, w, eliminated.accelerations(n, now))),
            "constrained": stacked(full.accelerations(n, then)),
            "T": jnp.stack([T, kinetic_energy(n, shape_of(n, angles_of(n, now)), w)]),
            "unused": jnp.zeros(()) * len(model_and_energy),
        }

    run = quick_jit(found)
    for q, v, u in samples(reduced):
        x = run(q, v, u)
        assert relative_error(x["on rows"], x["w"]) < 1e-13
        assert relative_error(x["constrained"], x["by twists"]) < F64_IDENTITY
        assert relative_error(x["constrained"], x["by multipliers"]) < F64_IDENTITY
        np.testing.assert_allclose(*x["T"], rtol=1e-13)


@pytest.mark.parametrize("name", ["differential_drive", "omni_3"])
def test_separation_of_wrenches_term_by_term(name):
    """S^T M S and S^T (f - M S' nu) of the reduction are those of the multibody model's own mass
    matrix and bias forces, on the null space of its own rows."""
    robot = on_a_slope(name)
    reduced = wheeled.at(robot, "kinematical")

    def found(q, nu, u):
        n, now = reduced.instant(State(q, nu), u)

        def lifted(nu):
            moved = now._replace(v=[nu[i] for i in range(reduced.nv)])
            return full_state(n, moved, reduced.full(n, moved))[1].v

        model, state = full_state(n, now, reduced.full(n, now))
        S = jax.jacfwd(lifted)(nu)
        M = rb.mass_matrix(model, state.q)
        # S' nu: how velocities change as q moves on and nu does not

        def ahead(s):
            w = reduced.full(n, now)
            dq = stacked(wheeled.fidelity.coordinate_rates(n, now, w))
            there = now._replace(q=[a + s * b for a, b in zip(now.q, dq, strict=True)])
            return full_state(n, there, reduced.full(n, there))[1].v

        bias = rb.bias_forces(model, state.q, state.v)
        _, dS = jax.jvp(ahead, (0.0,), (1.0,))
        rows = jacobian(model, state.q)
        shape = shape_of(n, angles_of(n, now))
        w = reduced.full(n, now)
        book = project(
            n, angles_of(n, now), angle_rates(n, now, w), ideal, now.v,
            gravity_pull(n, now, shape), [0.0] * len(n.shafts),
        )  # fmt: skip
        return {
            "rows": rows @ S,
            "M": (S.T @ M @ S, jnp.stack([stacked(row) for row in book.M])),
            "f": (-S.T @ (bias + M @ dS), stacked(book.f)),
        }

    run = quick_jit(found)
    for q, v, u in samples(reduced):
        x = run(q, v, u)
        np.testing.assert_allclose(x["rows"], 0.0, atol=1e-14)
        assert relative_error(*x["M"]) < 1e-13
        assert relative_error(*x["f"]) < 1e-13
