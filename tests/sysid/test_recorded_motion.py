"""A recorded motion: between samples, at its start, on finer grids, and what counts as measured."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicHermiteSpline

import rbjax as rb
from rbjax.sysid import Channel, Recording
from rbjax.sysid.estimators.least_squares import minimise
from rbjax.sysid.estimators.staged_fit import halve_steps
from rbjax.sysid.estimators.verdict import _tiny
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.parameters.unknowns import Inertia, Unknown, put
from rbjax.sysid.simulation.runs import _first_readings, make_batch
from rbjax.sysid.simulation.setup import Grid, Setup, SimulatedPath, interpolate_state
from rbjax.sysid.simulation.simulation_error import HUBER, SimulationError
from rbjax.sysid.simulation.traces import FEW, Trace

RNG = np.random.default_rng(0)
T = 0.02 * np.arange(40)


def test_states_between_samples_are_those_of_hermites_cubic():
    model = rb.load("double_pendulum")
    knots, q, v = 0.1 * np.arange(4), *RNG.normal(size=(2, 4, 2))
    cubic = CubicHermiteSpline(knots, q, v)
    t = np.array([0.0, 0.03, 0.17, 0.29])
    path = SimulatedPath(jnp.asarray(q), jnp.asarray(v), None, jnp.zeros((3, 0)))
    found = jax.jit(jax.vmap(lambda t: interpolate_state(model, path, 0.1, t)))(t)
    np.testing.assert_allclose(found.q, cubic(t), rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.v, cubic(t, 1), rtol=0, atol=1e-12)


def test_a_halved_grid_has_the_same_length_in_more_steps():
    grid = Grid(0.02, 3, "rk4", 5)
    for times in (1, 3):
        finer = halve_steps(grid, times)
        assert finer.period == 0.02 / 2**times and finer.longest_delay == 5 * 2**times
        np.testing.assert_allclose(finer.period * finer.longest_delay, 0.1, rtol=1e-15)
        assert (finer.substeps, finer.integrator) == (3, "rk4")


def test_first_readings():
    """v as it was recorded, else the slope of q."""
    model = rb.load("pendulum")
    q = 1 + 2 * T + 3 * T**2
    told = Recording("told", {"q": Channel(T, q), "v": Channel(T, np.full(40, 7.0))})
    np.testing.assert_array_equal(_first_readings(model, told, 0.0), [[1.0], [7.0]])
    bare = Recording("bare", {"q": Channel(T, q)})
    np.testing.assert_allclose(_first_readings(model, bare, 0.0), [[1.0], [2.0]], rtol=1e-9)


def test_residuals_of_a_simulation_are_robust_by_the_loss():
    """r = sign(u) sqrt(2 rho(u)) with Huber's rho; u is -off, because the pendulum rests."""
    model = rb.load("pendulum")
    still = rb.State(np.zeros(1), np.zeros(1))
    off = np.array([0.0, 0.5, -1.2, 4.0, -9.0])
    noise = np.full(1, 0.1)
    run = Recording("still", {"q": Channel(T[:5], 0.1 * off, noise=noise)}, initial_state=still)
    setup, grid = Setup.of(model), Grid(0.02)
    sought = Unknowns.of("test", {"mass": Unknown("bodies.mass", 0)}, setup)
    data = make_batch(setup, [run], grid)
    of = SimulationError(setup, sought, data, grid, estimate_initial_state=False, loss="huber")
    found = np.ravel(of.residuals(np.asarray(sought.read(setup))))
    far = np.abs(off) > HUBER
    due = np.where(far, np.sqrt(np.maximum(HUBER * (2 * np.abs(off) - HUBER), 0)), np.abs(off))
    np.testing.assert_allclose(found, -np.sign(off) * due, rtol=0, atol=1e-12)


def test_a_piece_from_the_start_keeps_the_initial_state():
    start = rb.State(np.ones(1), np.zeros(1))
    run = Recording("swing", {"q": Channel(T, np.ones(40))}, initial_state=start)
    assert run.segment(0.0, 0.3).initial_state is start
    assert run.segment(0.1, 0.3).initial_state is None


def trace(recorded, simulated):
    recorded, simulated = (np.reshape(x, (len(x), -1)) for x in (recorded, simulated))
    names = tuple(map(str, range(recorded.shape[1])))
    return Trace(names, T[: len(recorded)], recorded, simulated)


def test_a_column_with_a_start_only_is_not_measured():
    full = RNG.normal(size=FEW)
    start = np.where(np.arange(FEW) == 0, full, np.nan)
    never = np.full(FEW, np.nan)
    for columns, due in (
        ([full, full], True), ([full, never], True), ([full, start], False), ([never], False),
    ):  # fmt: skip
        assert trace(np.stack(columns, 1), np.zeros((FEW, len(columns)))).measured is due


def test_residuals_are_rounding_or_not():
    y = np.sin(T)
    for off, due in ((1e-13, True), (0.1, False)):
        seen = {"run": {"q": trace(y, y + off), "ctrl": trace(y, y + 1.0)}}
        assert _tiny(seen) is due


def test_a_search_tells_how_many_evaluations_and_their_squares():
    class Line:
        def residuals(self, x):
            return x - np.array([3.0, -1.0])

        def cost(self, x):
            return (self.residuals(x) ** 2).sum()

        def triangle(self, x):
            return np.column_stack([np.eye(2), self.residuals(x)])

        def divergence(self, x, x0):
            return Divergence.free(x, x0, 1.0)

    told = []
    minimise(Line(), np.zeros(2), watch=lambda k, cost, x: told.append((k, cost, x)))
    assert [k for k, _, _ in told] == list(range(1, len(told) + 1)) and told
    for _, cost, x in told:
        np.testing.assert_allclose(cost, (Line().residuals(x) ** 2).sum(), rtol=1e-14)


def test_only_bodies_that_follow_each_other_are_joined():
    one, rest = Inertia(0), Unknown("joints.damping", 0)
    members = {"a": one, "b": one, "damping": rest, "c": one}
    found = Unknowns(members, (10, 10, 1, 10), ())._joined
    assert [(type(u), size) for u, size in found] == [(Inertia, 20), (Unknown, 1), (Inertia, 10)]


def test_an_entry_is_replaced_in_traced_arrays_too():
    array = np.array([1.0, 2.0, 3.0])
    for found in (put(array, 1, 7.0), jax.jit(lambda x: put(array, 1, x))(7.0)):
        np.testing.assert_array_equal(found, [1.0, 7.0, 3.0])
