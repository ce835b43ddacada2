"""`prediction_error` on simulated recordings whose truth and noise are known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import rbjax as rb
from rbjax.sysid import Channel, Grid, Recording, Setup, Unknown, identify
from rbjax.sysid import prediction_error as fitted
from rbjax.sysid.estimators.least_squares import minimise
from rbjax.sysid.estimators.likelihood import make_series
from rbjax.sysid.estimators.prediction import OF_LIKELIHOOD, PRIOR_WEIGHT
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.statistics import estimates

T, PUSH, SIGMA = 0.02, 0.3, 1e-3
EULER = "semi_implicit_euler"  # of one stage, whose program is small
GRID = Grid(T, 1, EULER)
MASS, DAMPING = 1.0, 0.3
TRUTH = rb.load("pendulum")
TRUTH = TRUTH.replace(joints=TRUTH.joints.replace(damping=jnp.array([DAMPING])))
GUESS = TRUTH.replace(bodies=TRUTH.bodies.replace(mass=jnp.array([1.4])))
GUESS = GUESS.replace(joints=GUESS.joints.replace(damping=jnp.array([0.1])))
UNKNOWNS = {
    "mass": Unknown("bodies.mass", 0, positive=True),
    "damping": Unknown("joints.damping", 0, positive=True),
}


@functools.cache
def motions(count, N, push=PUSH):
    """q and v (count, N + 1, 1) of a pendulum under known commands and unknown torques."""
    rng = np.random.default_rng(11)
    t = np.arange(N) * T
    ctrl = 4 * np.sin(3 * t)[:, None]
    felt = ctrl + push * rng.normal(size=(count, N, 1))
    start = rb.State(jnp.array([0.3]), jnp.array([0.2]))
    run = jax.jit(jax.vmap(lambda u: rb.rollout(TRUTH, start, u, T, integrator=EULER)))
    path = run(jnp.asarray(felt))
    noise = rng.normal(size=(2, count, N + 1, 1))
    return np.asarray(path.q) + SIGMA * noise[0], np.asarray(path.v) + 0.01 * noise[1], ctrl


def recordings(count=2, N=120, *, said=True, speeds=False, lost=False, push=PUSH):
    q, v, ctrl = motions(count, N, push)
    t = np.arange(N + 1) * T
    found = []
    for k in range(count):
        values = q[k].copy()
        if lost:
            values[20:30] = np.nan
        channels = {"q": Channel(t, values, noise=[SIGMA] if said else None, dropped="nan")}
        if speeds:
            channels["v"] = Channel(t, v[k])
        found.append(Recording(f"run {k}", channels | {"ctrl": Channel(t[:-1], ctrl)}))
    return found


@functools.cache
def first():
    return fitted(GUESS, recordings()[0], UNKNOWNS, grid=GRID)


def near(found, sigmas=4.0):
    names = {"mass": MASS, "damping": DAMPING, "torque noise[hinge]": PUSH}
    for name, truth in names.items():
        x = found.estimates.interval(name)
        assert abs(x.value - truth) < sigmas * x.sigma and x.sigma < truth


def test_numbers_and_the_size_of_pushes_are_found():
    found = first()
    assert (
        found.success
        and found.identifiable.single == ("mass", "damping")
        and found.likelihood.size == 3
    )
    near(found)
    np.testing.assert_allclose(found.levels.reading, [SIGMA])
    white = found.whitened()["run 0"]
    assert np.isnan(white[0]).all() and abs(np.nanvar(white) - 1) < 0.4
    # at a maximum: no number may be changed by a tenth of its deviation to any gain
    at = found.likelihood.cost(found.x)
    np.testing.assert_allclose(at, -2 * found.log_likelihood)
    for k in range(3):
        for side in (-0.1, 0.1):
            step = side / np.linalg.norm(found.likelihood.triangle(found.x)[:, k])
            assert found.likelihood.cost(found.x + step * np.eye(3)[k]) > at


def test_the_verdict_and_the_smoothed_motion():
    runs = recordings()
    found = first()
    verdict = found.validate(runs[1:])
    assert verdict.success and 0.75 < verdict.ratio < 1.25
    with pytest.raises(rb.InputError, match="both sides"):
        found.validate(runs[:1])
    smoothed = found.smoothed()["run 0"]
    v = motions(2, 120)[1][0]
    # speeds from positions: nearer than differences, and as near as their covariance says
    off = np.asarray(smoothed.state.v)[1:-1] - v[1:-1]
    rough = np.diff(motions(2, 120)[0][0], axis=0)[1:] / T - v[1:-1]
    assert (off**2).mean() < 0.5 * (rough**2).mean()
    sd = np.sqrt(np.asarray(smoothed.covariance)[1:-1, 1, 1] + 0.01**2)
    assert 0.8 < np.sqrt((off[:, 0] ** 2 / sd**2).mean()) < 1.2


BETWEEN = Recording("between", {"q": Channel([0.0, 0.02, 0.035, 0.06], np.zeros(4))})


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"recordings": BETWEEN, "grid": GRID}, "at 0.035 s after its start, between instants"),
        ({"model": Setup.of(GUESS, delay=0.01)}, r"delays, .* ctrl 0.01 s, so Channel.c.t . 0.01"),
    ],
)
def test_bad_arguments_are_named(change, error):
    given = {"model": GUESS, "recordings": recordings()[0], "unknowns": UNKNOWNS} | change
    with pytest.raises((rb.InputError, rb.UnknownName), match=error):
        fitted(given.pop("model"), given.pop("recordings"), given.pop("unknowns"), **given)


@pytest.mark.slow
def test_sensors_whose_noise_nobody_says_speeds_and_lost_samples():
    """Two recordings; noise of q and v is found with the numbers."""
    runs = recordings(2, 400, said=False, speeds=True, lost=True)
    found = fitted(GUESS, runs, UNKNOWNS, grid=GRID)
    assert found.success and found.likelihood.size == 5
    near(found)
    truth = np.array([MASS, DAMPING, *np.log([PUSH, SIGMA, 0.01])])
    excess = found.likelihood.cost(truth) - found.likelihood.cost(found.x)
    assert 0 < excess < stats.chi2(5).ppf(0.999)  # the ratio of likelihoods


@pytest.mark.slow
def test_it_begins_where_a_simulation_ends():
    runs = recordings()[:1]
    simulated = identify(GUESS, runs, UNKNOWNS, grid=GRID, estimate_initial_state=True)
    found = fitted(simulated, runs, UNKNOWNS)
    assert found.guess == simulated.values and found.success
    np.testing.assert_allclose([*found.values.values()], [*first().values.values()], rtol=1e-4)


@pytest.mark.slow
def test_pushes_as_accelerations():
    """On a pendulum they are torques over the inertia, which is known here but for the mass."""
    found = fitted(GUESS, recordings(1, 400)[0], UNKNOWNS, grid=GRID, drive="acceleration")
    M = float(rb.mass_matrix(found.model, jnp.zeros(1))[0, 0])
    assert found.success
    np.testing.assert_allclose(found.levels.drive, PUSH / M, rtol=0.25)
    assert abs(found.estimates.interval("mass").value - MASS) < 0.05


def descended(values, rows, X, steps=25):
    """Gauss-Newton with halved steps, of many problems at once; x and J at the end."""
    values, rows = jax.jit(jax.vmap(values)), jax.jit(jax.vmap(rows))
    now = np.asarray(values(X))
    for _ in range(steps):
        J, r = (np.asarray(a) for a in rows(X))
        step = np.stack([-np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(J, r, strict=True)])
        part = np.ones(len(X))
        for _ in range(12):
            trial = np.asarray(values(X + part[:, None] * step))
            worse = ~(trial <= now)
            part = np.where(worse, part / 2, part)
        X = np.where(worse[:, None], X, X + part[:, None] * step)
        now = np.where(worse, now, trial)
    return X, *(np.asarray(a) for a in rows(X))


@pytest.mark.slow
def test_intervals_hold_where_those_of_simulations_do_not():
    """200 experiments of 8 s. Noise drives the pendulum: the simulation error, its start sought,
    scatters far more, and its intervals do not hold."""
    count, N = 200, 400
    runs = recordings(count, N)
    base = fitted(GUESS, runs[0], UNKNOWNS, grid=GRID)
    of = base.likelihood
    series = make_series(base.setup, runs, base.grid)
    truth = np.array([MASS, DAMPING])
    begin = jnp.tile(jnp.append(truth, np.log(PUSH)), (count, 1))
    which = jnp.arange(count)[:, None] + 0.0  # experiment

    def pick(x):
        return jax.tree.map(lambda a: a[x[-1].astype(int)], series)

    X = jnp.concatenate([begin, which], 1)

    def value(x):
        return of.value(x[:3], pick(x))

    def rows(x):
        J, r = of.rows(x[:3], pick(x))
        return jnp.concatenate([J, jnp.zeros((J.shape[0], 1))], 1), r

    found, J, _ = descended(value, rows, X)
    np.testing.assert_allclose(found[0, :3], base.x, rtol=2e-3)

    q, _, ctrl = motions(count, N)
    q = jnp.asarray(q)

    def residual(x):
        model = TRUTH.replace(bodies=TRUTH.bodies.replace(mass=x[:1]))
        model = model.replace(joints=model.joints.replace(damping=x[1:2]))
        start = rb.State(x[2:3], x[3:4])
        path = rb.rollout(model, start, jnp.asarray(ctrl), T, integrator=EULER)
        return (path.q - q[x[-1].astype(int)]).ravel()

    def linear(x):
        return jax.jacfwd(residual)(x).at[:, -1].set(0.0), residual(x)

    start = jnp.tile(jnp.array([MASS, DAMPING, 0.3, 0.2]), (count, 1))
    X = jnp.concatenate([start, which], 1)
    simulated, Js, rs = descended(lambda x: (residual(x) ** 2).sum(), linear, X)

    bounds = {"mass": (0, np.inf), "damping": (0, np.inf)}
    names = ["mass", "damping"]
    inside, sigma = np.zeros((2, count, 2), bool), np.zeros((2, count, 2))
    for k in range(count):
        said = (
            estimates([*names, "log push"], found[k, :3], J[k, :, :3], 1.0, bounds=bounds),
            estimates([*names, "q", "v"], simulated[k, :4], Js[k, :, :4], residual=rs[k],
                      bounds=bounds),
        )  # fmt: skip
        for j, e in enumerate(said):
            for i, name in enumerate(bounds):
                x = e.interval(name)
                inside[j, k, i], sigma[j, k, i] = x.low < truth[i] < x.high, x.sigma
    off = np.stack([found[:, :2], simulated[:, :2]]) - truth
    scatter, held = np.sqrt((off**2).mean(1)), inside.mean(1)
    assert (held[0] >= 0.91).all() and (held[0] <= 0.985).all()
    np.testing.assert_allclose(scatter[0], sigma[0].mean(0), rtol=0.2)
    assert (np.abs(off[0].mean(0)) < 4 * scatter[0] / np.sqrt(count)).all()
    assert (held[1] < 0.6).all() and (scatter[1] > 3 * scatter[0]).all()
    assert (scatter[1] > 3 * sigma[1].mean(0)).all()


class Normal:
    """-2 log p = sum over samples of (y - x)^2 + const, of one number x > 0 with mean 2."""

    factor = 1.0

    def cost(self, x):
        return float(10 * (x[0] - 2.0) ** 2 + 3.0)

    def triangle(self, x):
        return np.sqrt(10) * np.array([[self.factor, x[0] - 2.0], [0.0, 0.0]])

    def divergence(self, x, x0):
        return Divergence.positive(x, x0)


class Slow(Normal):
    """r = (x - 2)^3: a step of Gauss and Newton goes a third of the way."""

    def cost(self, x):
        return float((x[0] - 2.0) ** 6)

    def triangle(self, x):
        return np.array([[3 * (x[0] - 2.0) ** 2, (x[0] - 2.0) ** 3], [0.0, 0.0]])


class Uphill(Normal):
    factor = -1.0  # no step can succeed


class Endless(Normal):
    def cost(self, x):
        return np.inf


class Thin(Normal):
    """Of which no point has a metric."""

    def divergence(self, x, x0):
        return Divergence.impossible(1)


@pytest.mark.parametrize(
    ("of", "steps", "said"),
    [
        (Normal(), 60, "converged"),
        (Slow(), 3, "not converged"),
        (Uphill(), 60, "stuck: no step lowers the cost"),
        (Endless(), 60, "not finite"),
        (Thin(), 60, "infeasible"),
    ],
)
def test_each_end_of_a_search(of, steps, said):
    start = np.array([3.0 if steps == 60 else 200.0])
    found = minimise(
        of, start, prior_weights=(PRIOR_WEIGHT,), max_evaluations=steps, tolerances=OF_LIKELIHOOD
    )
    assert found.status.text.startswith(said) and found.success == (said == "converged")
    if found.success:
        assert abs(found.x[0] - 2) < 1e-6
