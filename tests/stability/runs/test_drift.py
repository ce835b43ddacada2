"""Energies over a million steps, lengths of quaternions, and the test of slopes."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.stability import trend
from tests.forces.elements import Lag
from tests.solvers.scenes import INERTIA

SOLVERS = rb.solvers.all()
STEP = 1e-3


# ------------------------------------------------------------------------- the test of slopes


def test_the_slope_is_that_of_numpy_and_scipy() -> None:
    from scipy.stats import linregress

    rng = np.random.default_rng(0)
    t = np.linspace(0, 10, 6400)
    x = 0.3 * t + rng.normal(size=t.shape)
    found, want = trend(t, x), linregress(t, x)
    assert abs(found.slope - want.slope) < 1e-3 * abs(want.slope)  # means of blocks of one size
    assert 0.6 < found.error / want.stderr < 2.0
    assert found.change == pytest.approx(3.0, rel=0.05)


def test_no_trend_is_seen_where_there_is_none() -> None:
    """Noise, oscillation slower than a block, and the walk of rounding: one false call in 80."""
    t = np.linspace(0, 100, 4001)
    calls = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        walk = rng.normal(size=t.shape).cumsum()
        swing = np.sin(rng.uniform(0.5, 30) * t + rng.uniform(0, 6)) + rng.normal(size=t.shape)
        calls += trend(t, walk).drifts + 2 * trend(t, swing).drifts
    assert calls <= 1


@pytest.mark.parametrize("share", [1.5, 10.0])
def test_a_trend_is_seen_under_oscillation(share: float) -> None:
    t = np.linspace(0, 100, 4001)
    rng = np.random.default_rng(1)
    found = trend(t, np.sin(7 * t) + 0.1 * rng.normal(size=t.shape) - 2 * share * t / 100)
    assert found.drifts
    assert abs(found.slope + share / 50) < 0.05 * share / 50
    assert abs(found.slope + share / 50) < 6 * found.error + 1e-3


def test_a_constant_has_no_slope() -> None:
    assert trend(np.arange(100.0), np.full(100, 3.0)) == (0.0, 0.0, 0.0, 0.0, False)


@pytest.mark.parametrize(
    ("ts", "xs", "words"),
    [
        (np.arange(5.0), np.arange(5.0), "at least 16"),
        (np.arange(20.0), np.arange(21.0), r"\(20,\) and xs \(21,\)"),
        (np.arange(20.0), np.full(20, np.nan), "20 of 20 samples are not finite"),
        (np.full(20, 3.0), np.arange(20.0), "ts must increase"),
        (np.arange(20.0)[::-1], np.arange(20.0), "ts must increase"),
    ],
)
def test_series_that_have_no_slope_are_refused(ts, xs, words: str) -> None:
    with pytest.raises(rb.InputError, match=words):
        trend(ts, xs)


# ------------------------------------------------------------------------------------ energies


def energy(t, state, model):
    return rb.kinetic_energy(model, state.q, state.v) + rb.potential_energy(model, state.q)


def canonical_energy(t, y, model):
    return energy(t, rb.stability.from_canonical(model, y), model)


def energy_trend(name: str, coordinates: str, steps: int, dt: float = STEP):
    """Of the double pendulum, from the keyframe that tumbles."""
    model, solver = rb.load("double_pendulum"), SOLVERS[name].make()
    state = model.keyframe("swing")
    if coordinates == "qp":
        y0 = rb.stability.to_canonical(model, state)
        term = diffrax.ODETerm(rb.stability.Hamiltonian())
        run = rb.stability.drift(
            term, y0, canonical_energy, solver=solver, dt=dt, steps=steps, args=model
        )
    else:
        run = rb.stability.drift(model, state, energy, solver=solver, dt=dt, steps=steps)
    assert int(run.steps) == steps and int(run.ending) == 0
    found = np.asarray(run.kept)
    assert len(found) == 1001
    return trend(run.ts, found), found


# symplectic for any mass matrix: Gauss in (q, p), the variational rule in (q, v)
SYMPLECTIC = [
    ("implicit_midpoint", "qp"),
    ("gauss_legendre2", "qp"),
    ("variational_midpoint", "qv"),
]


def test_energy_of_a_pendulum() -> None:
    model = rb.load("pendulum")
    model = model.replace(joints=model.joints.replace(damping=[0.0]))
    run = rb.stability.drift(
        model, model.keyframe("horizontal"), energy, solver=rb.solvers.stoermer_verlet(), dt=0.01,
        steps=20_000,
    )  # fmt: skip
    found = trend(run.ts, run.kept)
    assert not found.drifts, found
    assert 1e-5 < found.amplitude < 1e-2  # J


@pytest.mark.slow
@pytest.mark.parametrize(("name", "coordinates"), SYMPLECTIC)
def test_energy_over_a_million_steps(name: str, coordinates: str) -> None:
    found, energy = energy_trend(name, coordinates, 1_000_000)
    assert not found.drifts, found
    # rounding, a unit in the last place of the energy a step, may add up where nothing else does
    rounding = 1_000_000 * np.finfo(float).eps * np.abs(energy).max()
    small = max(0.1 * found.amplitude, rounding)
    assert abs(found.slope) < 4 * found.error or abs(found.change) < small
    early, late = (np.ptp(part) for part in np.array_split(energy, 2))
    assert late < 2 * early, (late, early)  # chaotic motion finds a little more, a drift the double


def test_energy_of_runge_kutta_drifts() -> None:
    term = diffrax.ODETerm(lambda t, y, args: (y[1], -jnp.sin(y[0])))
    run = rb.stability.drift(
        term, (2.0, 0.0), lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]),
        solver=rb.solvers.RK4(), dt=0.1, steps=20_000,
    )  # fmt: skip
    found = trend(run.ts, run.kept)
    assert found.drifts
    assert found.change < 0


def test_hamiltons_equations_are_lagranges() -> None:
    """q'' of the one is v' of the other, with springs and dampers."""
    model = rb.load("double_pendulum")
    joints = model.joints.replace(damping=[0.3, 0.2], stiffness=[3.0, 5.0], springref=[0.1, -0.4])
    model = model.replace(joints=joints)
    state = rb.State(jnp.array([0.7, -1.1]), jnp.array([1.3, 0.4]))

    @jax.jit
    def both(model, state):
        y = rb.stability.to_canonical(model, state)
        rate = rb.stability.Hamiltonian()(0.0, y, model)
        back = jax.jvp(lambda *y: rb.stability.from_canonical(model, y).v, y, rate)
        tau = rb.applied_forces(model, state)
        return back, rate[0], rb.forward_dynamics(model, state.q, state.v, tau)

    (v, a), q_rate, want = both(model, state)
    np.testing.assert_allclose(v, state.v, rtol=1e-13)
    np.testing.assert_allclose(q_rate, state.v, rtol=1e-13)
    np.testing.assert_allclose(a, want, rtol=1e-12)


def test_attitudes_have_no_canonical_coordinates() -> None:
    model = rb.load("spinning_top")
    with pytest.raises(rb.InputError, match="only hinges and slides"):
        rb.stability.to_canonical(model, model.default_state())


def test_canonical_coordinates_hold_no_states_of_elements() -> None:
    """They are refused by name, not left out; so is a state that brings some."""
    model = rb.load("double_pendulum")
    bare, y = model.default_state(), (jnp.zeros(2), jnp.ones(2))
    lagging = model.with_forces(Lag(jnp.array(0.1)))
    words = r"have states \(Lag\), expected none.*model.replace"
    for call in (
        lambda: rb.stability.to_canonical(lagging, lagging.default_state()),
        lambda: rb.stability.from_canonical(lagging, y),
        lambda: rb.stability.Hamiltonian()(0.0, y, lagging),
    ):
        with pytest.raises(rb.InputError, match=words):
            call()
    with pytest.raises(rb.InputError, match=r"state.x has shape \(1,\), expected None"):
        rb.stability.to_canonical(model, bare.replace(x=jnp.zeros(1)))
    with pytest.raises(rb.InputError, match=r"from_canonical: p has shape \(3,\)"):
        rb.stability.from_canonical(model, (jnp.zeros(2), jnp.ones(3)))


# ------------------------------------------------------------------------------------ manifolds

BODY = rb.solvers.RigidBody(INERTIA)
SPIN = (jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.2, 2.0, 0.1]))
LIE = [name for name, entry in SOLVERS.items() if entry.kind == "lie"]


def lengths(t, y, args):
    turn, w = y
    in_space = (rb.rotations.quaternion.to_matrix(turn) * (INERTIA * w)).sum(-1)
    return {"length": jnp.sqrt((turn**2).sum()), "momentum": in_space}


def length_error(name: str, steps: int, dtype=np.float64) -> tuple[float, np.ndarray]:
    y0 = jax.tree.map(lambda x: x.astype(dtype), SPIN)
    body = rb.solvers.RigidBody(INERTIA.astype(dtype))
    run = rb.stability.drift(
        body, y0, lengths, solver=SOLVERS[name].make(), dt=2.0**-7, steps=steps, samples=100
    )
    assert int(run.steps) == steps
    assert run.y[0].dtype == dtype
    kept = jax.tree.map(np.asarray, run.kept)
    return float(np.abs(kept["length"].astype(np.float64) - 1).max()), kept["momentum"]


@pytest.mark.parametrize("name", ["rkmk2", "rigid_body_splitting"])
def test_unit_length_quick(name: str) -> None:
    assert length_error(name, 10_000)[0] < 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("name", LIE)
def test_unit_length_over_a_million_steps(name: str) -> None:
    """Every product is brought back to length 1, so that rounding does not add up: an ulp or two
    in f64, where 1e-13 is asked for, and in f32 likewise."""
    error, _ = length_error(name, 1_000_000)
    assert error < 1e-15, error
    error, _ = length_error(name, 1_000_000, np.float32)
    assert error < 5e-7, error


POSES = "rkmk2 rkmk3 rkmk4 rkmk5 crouch_grossman3 commutator_free4".split()  # noqa: SIM905


@pytest.mark.slow
@pytest.mark.parametrize("name", POSES)
def test_poses_over_a_million_steps(name: str) -> None:
    """On SE(3): a body that turns and moves by a twist of its own."""

    def twist(t, y, args):
        return jnp.stack([jnp.cos(t), 2.0 + y[1][0], jnp.sin(3 * t)]), jnp.cos(t) * jnp.arange(3.0)

    term = rb.solvers.OnGroup(twist, rb.solvers.SE3())
    start = (jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    run = rb.stability.drift(
        term, start, lambda t, y, args: {"length": jnp.sqrt((y[0] ** 2).sum()), "at": y[1]},
        solver=SOLVERS[name].make(), dt=2.0**-7, steps=1_000_000, samples=100,
    )  # fmt: skip
    assert int(run.steps) == 1_000_000
    assert np.isfinite(run.kept["at"]).all()
    assert np.abs(np.asarray(run.kept["length"]) - 1).max() < 1e-15


@pytest.mark.slow
def test_the_splitting_keeps_the_momentum_in_space() -> None:
    momentum = length_error("rigid_body_splitting", 1_000_000)[1]
    assert np.abs(momentum - momentum[0]).max() < 1e-10


@pytest.mark.slow
def test_a_robots_manifold_over_a_million_steps() -> None:
    model = rb.load("spinning_top")
    run = rb.stability.drift(
        model, model.keyframe("spinning"), solver=rb.solvers.rkmk(4), dt=1e-3, steps=1_000_000
    )
    assert float(np.asarray(run.kept["manifold"]).max()) < 1e-15


@pytest.mark.slow
def test_a_length_that_is_lost_is_seen() -> None:
    """Any solver takes the quaternion's own rate; its length then goes with the method's error."""
    model = rb.load("free_body")
    model = model.replace(gravity=jnp.zeros(3))
    run = rb.stability.drift(
        model, model.keyframe("flip"), solver=rb.solvers.RK4(), dt=0.02, steps=2000, samples=100
    )
    kept = jax.tree.map(np.asarray, run.kept)
    assert kept["manifold"][-1] > 1e-9
    # left alone in space, the momentum stays but for the method's error
    assert np.abs(kept["momentum"] - kept["momentum"][0]).max() < 1e-4
    assert np.abs(kept["momentum"][0, 3:]).max() == 0.0


# ------------------------------------------------------------------------------------ how it ends


def test_a_run_that_blows_up_keeps_its_last_sound_state() -> None:
    term = diffrax.ODETerm(lambda t, y, args: y**2)  # infinite at t = 1
    run = rb.stability.drift(
        term, jnp.ones(2), lambda t, y, args: y, solver=diffrax.Euler(), dt=0.01, steps=2000,
        samples=20,
    )  # fmt: skip
    assert int(run.ending) == rb.stability.NOT_FINITE
    assert 100 < int(run.steps) < 200
    assert np.isfinite(np.asarray(run.kept)).all()
    assert (np.asarray(run.kept)[-1] == np.asarray(run.y)).all()
    # it came to the second sample, and no trend is read from what is frozen after it
    np.testing.assert_array_equal(run.ts, [0.0, 1.0, *[np.nan] * 19])
    with pytest.raises(rb.InputError, match=r"19 of 21 samples.* early end"):
        trend(run.ts, run.kept[:, 0])


def test_an_end_within_the_last_sample_is_told_too() -> None:
    """y' = y^2 by Euler from 1, 150 steps of the 200 that two samples would take."""
    term = diffrax.ODETerm(lambda t, y, args: y**2)
    run = rb.stability.drift(
        term, 1.0, lambda t, y, args: (y, jnp.round(y).astype(int)), solver="euler", dt=0.01,
        steps=200, samples=2,
    )  # fmt: skip
    np.testing.assert_array_equal(run.ts, [0.0, 1.0, np.nan])
    whole = rb.stability.drift(
        term, -1.0, lambda t, y, args: y, solver="euler", dt=0.01, steps=200, samples=2
    )
    assert int(whole.ending) == rb.stability.DONE
    np.testing.assert_allclose(whole.ts, [0.0, 1.0, 2.0], rtol=1e-15)


def test_a_root_that_is_not_found_ends_the_run() -> None:
    term = diffrax.ODETerm(lambda t, y, args: y**2)
    run = rb.stability.drift(
        term, jnp.ones(2), lambda t, y, args: y, solver=rb.solvers.implicit_midpoint(), dt=0.3,
        steps=20, samples=20,
    )  # fmt: skip
    assert int(run.ending) == rb.stability.NO_ROOT
    assert int(run.steps) < 4
    assert np.isfinite(np.asarray(run.ts)).sum() == int(run.steps) + 1
    assert np.isfinite(np.asarray(run.kept)).all()


def test_one_program_for_every_number() -> None:
    from tests.compilations import compilations

    term, keep = diffrax.ODETerm(lambda t, y, args: -args * y), lambda t, y, args: y

    def run(dt, steps, rate):
        found = rb.stability.drift(
            term, jnp.ones(1), keep, solver=solver, dt=dt, steps=steps, samples=10, args=rate
        )
        return float(found.y[0])

    solver = rb.solvers.RK4()
    first = run(0.01, 100, jnp.asarray(1.0))
    with compilations() as found:
        second = run(0.02, 200, jnp.asarray(0.5))
    assert not found
    np.testing.assert_allclose([first, second], np.exp([-1.0, -2.0]), rtol=1e-8)


def test_times_that_f32_cannot_tell_apart_are_refused() -> None:
    term, y0 = diffrax.ODETerm(lambda t, y, args: -y), np.ones(1, np.float32)
    options = {"solver": rb.solvers.RK4(), "steps": 1_000_000, "samples": 10}
    with pytest.raises(rb.InputError, match=r"take a power of two, dt = 0\.0009765625, or float64"):
        rb.stability.drift(term, y0, lambda t, y, args: y, dt=1e-3, **options)
    run = rb.stability.drift(term, y0, lambda t, y, args: y, dt=2.0**-10, **options)
    assert float(run.ts[-1]) == 1e6 / 1024


@pytest.mark.parametrize("options", [{"steps": 15, "samples": 10}, {"steps": 5, "samples": 10}])
def test_steps_that_samples_do_not_divide_are_refused(options) -> None:
    model = rb.load("pendulum")
    with pytest.raises(rb.InputError, match="multiple"):
        rb.stability.drift(
            model, model.default_state(), solver=rb.solvers.RK4(), dt=0.01, **options
        )
