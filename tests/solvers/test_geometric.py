"""Geometric properties: energies that do not drift, constant lengths and momenta."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rbjax as rb
from tests.solvers.scenes import INERTIA

SLOW = pytest.mark.slow


def energies(term, solver, y0, energy, dt, steps, every):
    """The energy at regular times, one compiled program, no interpolation."""

    @jax.jit
    def run(y0):
        def once(carry, i):
            y, state = carry
            t0 = i * dt
            y, _, _, state, _ = solver.step(term, t0, t0 + dt, y, None, state, made_jump=False)
            return (y, state), None

        def keep(carry, block):
            carry, _ = jax.lax.scan(once, carry, block * every + jnp.arange(every))
            return carry, energy(carry[0])

        state = solver.init(term, 0.0 * dt, dt, y0, None)
        return jax.lax.scan(keep, (y0, state), jnp.arange(steps // every))

    (y, _), found = run(y0)
    return y, np.asarray(found)


def trend(found: np.ndarray) -> float:
    """Slope of the energy over the whole run, in units of its oscillation."""
    half = len(found) // 2
    return abs(found[half:].mean() - found[:half].mean()) / np.ptp(found[:half])


PENDULUM = diffrax.ODETerm(lambda t, y, _: (y[1], -jnp.sin(y[0])))
START = (jnp.array(2.0), jnp.array(0.0))


def swing(y):
    return y[1] ** 2 / 2 - jnp.cos(y[0])


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in ("stoermer_verlet", "implicit_midpoint") else SLOW)
     for n in ("symplectic_euler", "stoermer_verlet", "yoshida4", "central_differences",
               "implicit_midpoint", "variational_midpoint", "newmark")],
)  # fmt: skip
def test_symplectic_energy_does_not_drift(name: str) -> None:
    solver = rb.solvers.all()[name].make()
    _, found = energies(PENDULUM, solver, START, swing, jnp.asarray(0.1), 20_000, 7)
    assert trend(found) < 0.05, trend(found)
    assert np.ptp(found) < 0.4


def test_the_trend_is_seen_where_there_is_one() -> None:
    for name in ("rk4", "heun", "semi_implicit_euler"):
        term = PENDULUM
        if name == "semi_implicit_euler":  # damped: no symplecticity to be kept
            term = diffrax.ODETerm(lambda t, y, _: (y[1], -jnp.sin(y[0]) - 1e-3 * y[1]))
        solver = rb.solvers.all()[name].make()
        _, found = energies(term, solver, START, swing, jnp.asarray(0.1), 20_000, 7)
        assert not trend(found) < 0.5, name


def test_variational_midpoint_on_a_double_pendulum() -> None:
    """Configuration-dependent mass: bounded with the momentum of the term, drifting without."""

    def mass(q):
        c = jnp.cos(q[0] - q[1])
        return jnp.array([[2.0, c], [c, 1.0]])

    def energy(y):
        q, v = y
        return v @ mass(q) @ v / 2 - 9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))

    def lagrangian(q, v):
        return v @ mass(q) @ v / 2 + 9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))

    def field(t, y, _):
        q, v = y
        turning = jax.jvp(lambda q: mass(q) @ v, (q,), (v,))[1]
        return v, jnp.linalg.solve(mass(q), jax.grad(lagrangian)(q, v) - turning)

    y0 = (jnp.array([0.8, 0.9]), jnp.zeros(2))
    dt, solver = jnp.asarray(0.02), rb.solvers.VariationalMidpoint()
    group = rb.solvers.Vector()
    with_mass = rb.solvers.OnGroup(field, group, lambda t, y, _: mass(y[0]) @ y[1])
    _, found = energies(with_mass, solver, y0, energy, dt, 20_000, 50)
    assert trend(found) < 0.05, trend(found)
    assert np.ptp(found) < 0.05 * abs(found[0])


BODY = rb.solvers.RigidBody(INERTIA)
SPIN = (jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.2, 2.0, 0.1]))


def growing(t, q, xp):
    """A mass that time and place change, with its slopes by both."""
    shape = 1 + xp.sin(q) ** 2 / 2
    return (1 + t) * shape, shape, (1 + t) * xp.sin(q) * xp.cos(q)


def growing_rate(t, q, v, xp):
    """v' of L = m v^2 / 2 + cos q."""
    mass, by_time, by_place = growing(t, q, xp)
    return -(xp.sin(q) + by_time * v + by_place * v * v / 2) / mass


GROWING = rb.solvers.OnGroup(
    lambda t, y, _: (y[1], growing_rate(t, *y, jnp)),
    rb.solvers.Vector(),
    lambda t, y, _: growing(t, y[0], jnp)[0] * y[1],
)


@functools.cache
def grown(name: str):
    """(t0, t1, y0, steps) -> y1, one program forwards and backwards."""
    solver = rb.solvers.all()[name].make()

    @jax.jit
    def run(t0, t1, y0, steps):
        dt = (t1 - t0) / steps * (1 + 1e-12)
        return diffrax.diffeqsolve(GROWING, solver, t0, t1, dt, y0, max_steps=128).ys

    return lambda *args: np.concatenate(run(*args))


@pytest.mark.parametrize("name", ["variational_midpoint", pytest.param("newmark", marks=SLOW)])
@pytest.mark.parametrize(("t0", "t1"), [(0.0, 1.0), (1.0, 0.0)])
def test_a_momentum_that_time_changes(name: str, t0: float, t1: float) -> None:
    """Order 2, whichever way time runs: the caller's time is what the momentum is asked at."""
    y0 = (0.7, -0.4)
    exact = solve_ivp(
        lambda t, y: [y[1], growing_rate(t, *y, np)], (t0, t1), y0, method="DOP853",
        rtol=1e-13, atol=1e-13,
    ).y[:, -1]  # fmt: skip
    found = [np.abs(grown(name)(t0, t1, y0, n) - exact).max() for n in (25.0, 50.0, 100.0)]
    assert found[-1] < 1e-4, found
    np.testing.assert_allclose(np.log2(np.divide(found[:-1], found[1:])), 2, atol=0.1)


def test_a_singular_mass_is_a_result() -> None:
    """It vanishes at the end of the step: no velocity belongs to the momentum there."""
    term = rb.solvers.OnGroup(
        lambda t, y, _: (y[1], y[1] / (1 - t)), rb.solvers.Vector(),
        lambda t, y, _: (1 - t) * y[1],
    )  # fmt: skip
    y0 = (jnp.array(0.0), jnp.array(1.0))
    solver = rb.solvers.VariationalMidpoint()
    for end, ok in ((0.75, True), (1.0, False)):
        out = diffrax.diffeqsolve(term, solver, 0.5, end, 0.5, y0, throw=False)
        assert (out.result == diffrax.RESULTS.successful) == ok


def momentum_in_space(y):
    turn, w = y
    return rb.rotations.quaternion.to_matrix(turn) @ (INERTIA * w)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in ("rkmk4", "rigid_body_splitting") else SLOW)
     for n in ("rkmk4", "crouch_grossman3", "commutator_free4", "lie_generalized_alpha",
               "rigid_body_splitting")],
)  # fmt: skip
def test_unit_length_over_many_steps(name: str) -> None:
    solver = rb.solvers.all()[name].make()

    def kept(y):
        return jnp.concatenate([jnp.linalg.norm(y[0])[None], momentum_in_space(y)])

    _, found = energies(BODY, solver, SPIN, kept, jnp.asarray(0.01), 20_000, 100)
    assert np.abs(found[:, 0] - 1).max() < 1e-15
    drift = np.abs(found[:, 1:] - np.asarray(momentum_in_space(SPIN))).max()
    bounds = {"rigid_body_splitting": 1e-11, "lie_generalized_alpha": 1.0}
    assert drift < bounds.get(name, 1e-3), drift


@pytest.mark.parametrize(
    ("name", "bound"),
    [("rkmk4", 4e-5), *(pytest.param(*x, marks=SLOW) for x in (
        ("commutator_free4", 4e-5), ("lie_generalized_alpha", 4e-5), ("yoshida4", 4e-5),
        ("rigid_body_splitting", 8e-4)))],
)  # fmt: skip
def test_rounding_does_not_add_up_turn_by_turn(name: str, bound: float) -> None:
    """The energy of a top in single precision, 64,000 steps, 480 turns: it walks, with no drift.

    A quaternion divided by its length after each step gained 1e-4 (rkmk4) to 2e-3 (the splitting).
    """
    inertia = np.array([1.0, 1.0, 0.5])

    def weight(t, turn, _):
        w, x, y, z = turn
        return 4 * jnp.stack([y * z + w * x, w * y - x * z, 0 * t]).astype(turn.dtype)

    def end(dtype):
        start = (np.array([np.cos(0.25), np.sin(0.25), 0, 0], dtype), np.array([0, 0.3, 6], dtype))
        term = rb.solvers.RigidBody(inertia.astype(dtype), weight)
        solver, dt = rb.solvers.all()[name].make(), jnp.asarray(2.0**-7, dtype)
        y, _ = energies(term, solver, start, lambda y: y[1][2], dt, 64_000, 640)
        (w, x, y, z), rate = (np.asarray(leaf, np.float64) for leaf in y)
        tilt = (x * x + y * y) / (w * w + x * x + y * y + z * z)
        return (inertia * rate**2).sum() / 2 + 2 * (1 - 2 * tilt)

    assert abs(end(np.float32) - end(np.float64)) < bound


def test_splitting_turns_the_body_over_as_dzhanibekov_saw() -> None:
    """Spun about its middle axis the body flips, and the energy stays."""
    solver = rb.solvers.RigidBodySplitting()

    def both(y):
        return jnp.stack([y[1][1], (INERTIA * y[1] ** 2).sum() / 2])

    _, found = energies(BODY, solver, SPIN, both, jnp.asarray(0.02), 20_000, 10)
    assert found[:, 0].min() < -1.9 and found[:, 0].max() > 1.9
    assert trend(found[:, 1]) < 0.05
