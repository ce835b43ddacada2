"""Closed chains through the positions where their rows lose rank: a parallelogram that is flat.

Every motion here is that of a pendulum in the closed form: bars turn alike.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rbjax as rb
from benchmarks.cases.mechanisms import four_bars
from rbjax import constraints as rc

FLAT = np.pi / 2
#: of the bars, rad; the last ones are flat, or nearly
STARTS = np.array([0.0, 0.1, 0.2, 0.3, 0.4, FLAT - 1e-4, FLAT - 1e-6, FLAT, -FLAT])


def inertia(n: int) -> float:
    """kg m^2 of n linkages, by the angle of the bars."""
    return (n + 1) / 3 + n


def weight(n: int) -> float:
    """N m: the potential energy of n linkages is this times the cosine of the angle."""
    return 9.81 * ((n + 1) / 2 + n)


def at(n: int, angle, dtype=jnp.float64) -> rb.State:
    """The state at an angle, with the energy of 1 rad/s upright."""
    angle = np.asarray(angle)
    speed = np.sqrt(1 + 2 * weight(n) * (1 - np.cos(angle)) / inertia(n))
    signs = np.array([1.0, -1.0] * n + [1.0])
    return rb.State(*(jnp.array(x[..., None] * signs, dtype) for x in (angle, speed)))


def expected(n: int, state: rb.State, t: float) -> np.ndarray:
    """The angle after a time, by DOP853."""

    def rates(t, y):
        return [y[1], weight(n) / inertia(n) * np.sin(y[0])]

    start = [float(state.q[0]), float(state.v[0])]
    return solve_ivp(rates, (0, t), start, "DOP853", rtol=1e-13, atol=1e-13).y[0, -1]


def of_dtype(model: rb.Model, dtype) -> rb.Model:
    """The model with its numbers in a dtype."""

    def cast(x):
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(cast, model)


def rolled(
    n: int, dtype, integrator: str | None, seconds: float, starts: np.ndarray, dt: float = 1e-3,
    constraints=None, twice: bool = False,
):  # fmt: skip
    """The trajectories of a batch, and the largest change of energy of each, J. twice: whether
    joints are said twice."""
    model, _ = four_bars(n)
    if twice:
        model = model.with_constraints(*model.constraints, *model.constraints)
    own, steps = of_dtype(model, dtype), round(seconds / dt)

    def run(state):
        return rb.rollout(
            own, state, None, dt, steps=steps, save_every=max(1, steps // 100),
            integrator=integrator, constraints=constraints,
        )  # fmt: skip

    path = jax.jit(jax.vmap(run))(at(n, starts, dtype))

    @jax.jit
    @jax.vmap
    @jax.vmap
    def energy(q, v):
        return rb.kinetic_energy(model, q, v) + rb.potential_energy(model, q)

    found = np.asarray(energy(*(x.astype(jnp.float64) for x in (path.q, path.v))))
    return path, np.abs(found - found[:, :1]).max(1)


def test_f32_passes_flat_positions() -> None:
    """0.2 s through one, of starts whose steps fall anywhere on it."""
    starts = FLAT - np.array([0.4, 0.41, 0.42, 0.43, 0.44, 1e-3, 0.0])
    path, off = rolled(1, jnp.float32, "rk4", 0.2, starts)
    assert path.success.all() and path.q[:, -1, 0].min() > FLAT + 0.4
    assert off.max() < 1e-2  # of 20 J; damped against the row itself: 7 and more


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize(
    "integrator, most",
    [("rk4", 2e-2), ("semi_implicit_euler", 0.3), ("variational_midpoint", 5e-2)],
)
def test_f32_keeps_energy_through_many_flat_positions(integrator: str, n: int, most: float) -> None:
    """10 s, some fifteen passages, 20 J and 36 J. What semi-implicit Euler loses it loses in f64,
    too, by the length of its steps."""
    path, off = rolled(n, jnp.float32, integrator, 10.0, STARTS)
    assert path.success.all() and off.max() < most
    assert np.abs(path.q[..., 0] - path.q[..., -1]).max() < 5e-4  # one branch from end to end
    if integrator == "semi_implicit_euler":
        _, own = rolled(n, jnp.float64, integrator, 10.0, STARTS)
        np.testing.assert_allclose(off, own, atol=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, tolerance, most",
    [
        (diffrax.Tsit5(), 1e-8, 5e-7),
        (diffrax.Dopri8(), 1e-11, 1e-7),
        (diffrax.Dopri8(), 1e-12, 1e-7),
    ],
)
def test_adaptive_steps_pass_flat_positions(solver, tolerance: float, most: float) -> None:
    """2 s, three passages, of 49 starts: none is stuck. Errors are beside the closed form."""
    model, _ = four_bars(2)
    begun = at(2, np.concatenate([np.linspace(-0.7, 0.7, 40), STARTS]))
    controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)

    def run(state):
        return rb.simulate(
            model, state, jnp.array([0.0, 2.0]), solver=solver, stepsize_controller=controller,
            throw=False, max_steps=5000,
        )  # fmt: skip

    path = jax.jit(jax.vmap(run))(begun)
    assert path.success.all()
    want = [expected(2, jax.tree.map(lambda x, i=i: x[i], begun), 2.0) for i in range(49)]
    off = np.abs(path.q[:, -1, 0] - np.array(want))
    # from a flat position the acceleration across the branch is not known to the first stage
    assert off[:-3].max() < most and off.max() < 1e-5


def test_multipliers_where_rows_vanish() -> None:
    """Exactly flat, with each joint said twice: rows that vanish push with nothing, twins share,
    and the rows that are left have what the textbook gives them. Rounding is divided by 1e-10."""
    model, _ = four_bars(1)
    twice = model.with_constraints(*model.constraints)
    state = at(1, FLAT)

    @jax.jit
    def solved(state):
        held = rc.constrained_dynamics(twice, state.q, state.v, 0 * state.v)
        G = rc.jacobian(model, state.q)
        return held, G, rb.mass_matrix(model, state.q), rb.bias_forces(model, state.q, state.v)

    (a, l), G, M, b = solved(state)
    vanishing = np.abs(G).max(1) < 1e-12
    assert vanishing.tolist() == [True, True, False]
    rows = np.asarray(G)[~vanishing]
    # of bars that turn alike G' v vanishes, too
    A, c = rows @ np.linalg.solve(M, rows.T), rows @ np.linalg.solve(M, np.asarray(b))
    want = np.zeros(3)
    want[~vanishing] = np.linalg.solve(A, c) / 2
    np.testing.assert_allclose(l[:3], want, atol=1e-3)
    np.testing.assert_allclose(l[3:], want, atol=1e-3)
    np.testing.assert_allclose(M @ a, 2 * rows.T @ want[~vanishing] - b, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)])
def test_derivatives_at_flat_positions(dtype) -> None:
    """Of two steps that begin there, end there, or pass: finite, and alike both ways."""
    model, _ = four_bars(1)
    own = of_dtype(model, dtype)
    keys = jax.random.split(jax.random.key(7), 4)
    dq, dv, wq, wv = (jax.random.normal(k, (own.nv,), dtype) for k in keys)

    @jax.jit
    def both(state):
        def moved(q, v):
            for _ in range(2):
                state = rb.step(own, rb.State(q, v), dt=1e-3)
                q, v = state.q, state.v
            return q, v

        at = state.q, state.v
        tangent = jax.jvp(moved, at, (dq, dv))[1]
        cotangent = jax.vjp(moved, *at)[1]((wq, wv))
        return tangent, cotangent

    for angle in (FLAT, FLAT - 0.0098, FLAT - 0.007):
        (tq, tv), (bq, bv) = both(at(1, angle, dtype))
        assert all(np.isfinite(x).all() for x in (tq, tv, bq, bv))
        forward, back = wq @ tq + wv @ tv, bq @ dq + bv @ dv
        size = np.abs(wq * tq).sum() + np.abs(wv * tv).sum()
        assert abs(forward - back) < 1e5 * float(jnp.finfo(dtype).eps) * size


def test_derivative_across_a_flat_position() -> None:
    """By the speed of the bars, against differences: the branch goes on."""
    model, _ = four_bars(1)
    start = at(1, FLAT - 0.0075)

    @jax.jit
    def after(speed):
        def moved(speed):
            state = start.replace(v=start.v * speed)
            for _ in range(3):
                state = rb.step(model, state, dt=1e-3)
            return state.q

        return jax.jvp(moved, (speed,), (jnp.ones_like(speed),))

    h = 1e-6
    slope = after(jnp.array(1.0))[1]
    ends = [after(jnp.array(1.0 + s))[0] for s in (h, -h)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-5)


IMPLICIT = ["index_2", "index_3", "ggl"]
OTHERS = [
    rc.Formulation(method, projection=rc.Projection())
    for method in (
        rc.KKT(), rc.NullSpaceQR(), rc.NullSpaceSVD(), rc.Partitioning(), rc.UdwadiaKalaba(),
        rc.ForceProjection(), rc.AugmentedLagrangian(),
    )
] + [rc.Formulation(projection=rc.TangentSpace())]  # fmt: skip


@pytest.mark.slow
def test_an_implicit_step_passes_a_flat_position() -> None:
    """Its stages are on both sides of it: rows turn round between them."""
    model, _ = four_bars(1)
    start = at(1, FLAT - 0.03)
    path = rb.rollout(model, start, None, 0.01, steps=1, constraints="index_3")
    assert path.success
    bars = path.q[-1] * jnp.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(bars, expected(1, start, 0.01), atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("twice", [False, True])
@pytest.mark.parametrize("name", IMPLICIT)
def test_implicit_steps_keep_energy_through_many_flat_positions(name: str, twice: bool) -> None:
    """10 s of Radau IIA, some fifteen passages, 20 J; with rows that say the same twice."""
    path, off = rolled(1, jnp.float64, None, 10.0, STARTS, 0.01, name, twice)
    assert path.success.all() and off.max() < 5e-8
    assert np.abs(path.q[..., 0] - path.q[..., -1]).max() < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("name", IMPLICIT)
@pytest.mark.parametrize("stage", [0, 2])
def test_stages_at_a_flat_position(name: str, stage: int) -> None:
    """Exactly there, or so near that a row is neither held nor free."""
    c = rb.solvers.radau_iia(3).tableau.c[stage]
    apart = [0.0, 1e-8, 1e-6, 1e-5, 3e-5, 1e-4, -1e-6, -1e-5, -3e-5, -1e-4]
    starts = np.array([expected(1, at(1, FLAT + x), -(9 + c) * 0.01) for x in apart])
    path, off = rolled(1, jnp.float64, None, 0.2, starts, 0.01, name)
    # index 3: where a row is neither held nor free, rounding decides whether a step is solved
    assert path.success.sum() >= len(apart) - (name == "index_3")
    assert off[np.asarray(path.success)].max() < 1e-9


@pytest.mark.slow
def test_ggl_in_f32() -> None:
    path, off = rolled(1, jnp.float32, None, 10.0, STARTS, 0.01, "ggl")
    assert path.success.all() and off.max() < 5e-2


@pytest.mark.slow
@pytest.mark.parametrize("name", IMPLICIT)
def test_derivatives_of_implicit_steps_across_a_flat_position(name: str) -> None:
    """By the speed of the bars, with each joint said twice, both ways and against differences."""
    model, _ = four_bars(1)
    model = model.with_constraints(*model.constraints, *model.constraints)
    start = at(1, FLAT - 0.075)

    def end(speed):
        state = start.replace(v=start.v * speed)
        return rb.rollout(model, state, None, 0.01, steps=3, constraints=name).q[-1]

    end = jax.jit(end)
    forward = jax.jacfwd(end)(1.0)
    h = 1e-3  # a state is solved to 1e-11, which is 1e-6 of a difference over 1e-5
    np.testing.assert_allclose(forward, (end(1.0 + h) - end(1.0 - h)) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(jax.jacrev(end)(1.0), forward, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("dtype, most", [(jnp.float64, 2e-9), (jnp.float32, 2e-2)])
@pytest.mark.parametrize("formulation", OTHERS, ids=lambda x: x.name)
def test_formulations_on_arrays_keep_energy(formulation: rc.Formulation, dtype, most) -> None:
    """As the first test of 10 s."""
    path, off = rolled(1, dtype, "rk4", 10.0, STARTS, constraints=formulation)
    assert path.success.all() and off.max() < most
