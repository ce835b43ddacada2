"""The derivatives of every estimator's loss, against differences that share no code with them.

A `Case` is one small problem: its loss as a function of the unknowns, the gradient that the
estimator goes by, and where it is a Gauss-Newton method, residuals and their Jacobian, or the
triangle R with R^T R = [J r]^T [J r]. Differences are central ones at two steps (Richardson): with
h = 1e-3 they err by about h^4 = 1e-12 of the fifth derivative and 1e-13 of the loss by rounding.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid
from rbjax.sysid import Channel, Grid, Recording, Setup, Unknown
from rbjax.sysid.estimators.likelihood import Likelihood, NoiseLevels, make_series
from rbjax.sysid.parameters import log_cholesky
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.parameters.unknown_vector import Unknowns
from rbjax.sysid.simulation.multiple_shooting import MultipleShooting
from rbjax.sysid.simulation.runs import make_batch, make_run
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.torque.consistency import _Problem
from rbjax.sysid.torque.encoder_zeros import _augmented
from rbjax.sysid.torque.regression import LOSSES, METHODS, weighted
from rbjax.sysid.torque.torque_equations import equations
from tests.sysid.test_prediction_error import first
from tests.sysid.test_torque_rows import MODEL as ARM
from tests.sysid.test_torque_rows import TERMS, run, truth

RELATIVE = 1e-6  # of the largest entry; differences are good to 1e-9
MODEL = rb.load("double_pendulum")
NAMES = sysid.torque.parameter_names(MODEL)
PI = np.asarray(rb.inertial_parameters(MODEL), float)
Q, V, A = (np.asarray(x) for x in sysid.torque.motions.random_motions(MODEL, 20))


@dataclasses.dataclass
class Case:
    """loss, gradient: (x) -> number, (n,); residual, jacobian: (x) -> (m,), (m, n); triangle: (x)
    -> R, of which the gradient is 2 J^T r."""

    x: np.ndarray
    loss: Callable[[Any], Any]
    gradient: Callable[[Any], Any] | None = None
    residual: Callable[[Any], Any] | None = None
    jacobian: Callable[[Any], Any] | None = None
    triangle: Callable[[Any], Any] | None = None
    h: float = 1e-3


def differences(f: Callable[[Any], Any], x: np.ndarray, h: float) -> np.ndarray:
    """d f / d x (..., n)."""
    columns = []
    for k in range(x.size):
        e = np.zeros(x.size)
        e[k] = h * max(abs(x[k]), 0.1)
        each = [
            (np.asarray(f(x + s * e)) - np.asarray(f(x - s * e))) / (2 * s * e[k])
            for s in (1.0, 0.5)
        ]
        columns.append((4 * each[1] - each[0]) / 3)
    return np.stack(columns, -1)


def close(found: Any, want: np.ndarray) -> None:
    assert np.abs(want).max() > 0
    np.testing.assert_allclose(found, want, rtol=0, atol=RELATIVE * np.abs(want).max())


# --- torques -------------------------------------------------------------------------------------


@functools.cache
def torques() -> Callable[[Any], jax.Array]:
    """Torques (40,) by inverse dynamics of a model with these parameters: no regressor."""

    def at(pi: Any) -> jax.Array:
        made = sysid.parameters.with_inertial_parameters(MODEL, pi)
        return jax.vmap(lambda q, v, a: rb.inverse_dynamics(made, q, v, a))(Q, V, A).ravel()

    return jax.jit(at)


@functools.cache
def measured() -> tuple[np.ndarray, np.ndarray]:
    W = np.asarray(sysid.torque.regressor(MODEL, Q, V, A))
    tau = W @ PI + 0.1 * np.random.default_rng(0).normal(size=W.shape[:2])
    tau[3, 0] += 5.0  # an outlier
    return W, tau


def regression(method: str) -> Case:
    """The loss of torques by inverse dynamics; its gradient by the regressor."""
    W, tau = measured()
    options = {"instruments": W} if method == "instrumental" else {}
    noise = np.array([0.1, 0.2])
    found = sysid.torque.regress(W, tau, NAMES, method=method, noise=noise, **options)
    pi = found.parameters(PI)
    X, y, sd = W.reshape(-1, len(PI)), tau.ravel(), np.tile(noise, len(Q))
    sd = np.ones(y.size) if method == "ordinary" else sd
    huber = LOSSES["huber"]

    def loss(p: Any) -> jax.Array:
        u = (jnp.asarray(y) - torques()(p)) / sd
        if method == "robust":  # Huber's: |u| beyond 1.345
            return jnp.where(abs(u) < 1.345, u**2, 1.345 * (2 * abs(u) - 1.345)).sum()
        if method == "instrumental":
            return ((X / sd[:, None]).T @ u @ np.ones(len(PI))) ** 2
        return u @ u

    def gradient(p: Any) -> np.ndarray:
        u, Z = (y - X @ p) / sd, X / sd[:, None]
        if method == "robust":
            return -2 * Z.T @ huber(u)[1]
        if method == "instrumental":
            one = np.ones(len(PI))
            return -2 * (one @ Z.T @ u) * (Z.T @ Z @ one)
        return -2 * Z.T @ u

    # the estimate is where the gradient vanishes
    scale = np.abs(gradient(pi + 0.1)).max()
    assert np.abs(gradient(pi)).max() < 1e-6 * scale
    # Huber's loss has a kink in its slope, which so short a step does not meet
    return Case(pi + 0.05 * np.abs(pi), loss, gradient, h=1e-5)


def consistent() -> Case:
    tau = measured()[1]
    terms = ("armature", "viscous")
    W = np.asarray(sysid.torque.regressor(MODEL, Q, V, A, joint_terms=terms))
    eq = equations(W, tau, sysid.torque.parameter_names(MODEL, terms), noise=0.3)
    X = W.reshape(-1, W.shape[-1]) / 0.3
    problem = _Problem(MODEL, terms, X, tau.ravel() / 0.3, np.asarray(0.5), weighted(eq))
    x = problem.start + 0.1 * np.random.default_rng(0).normal(size=problem.start.size)

    def loss(x: Any) -> float:
        r = problem.residual(x)
        return float(r @ r)

    def gradient(x: Any) -> np.ndarray:
        return 2 * problem.jacobian(x).T @ problem.residual(x)

    return Case(x, loss, gradient, problem.residual, problem.jacobian)


def torque_filter() -> Case:
    """Filtered rows at other zeros, beside their slopes dW/dz."""
    pi = truth()

    @functools.cache
    def made(*z: float) -> Any:
        recorded = run("zeros", (0.05, -0.03), rate=100.0, seconds=3.0)
        how = {"signal_cutoff": 30.0, "joint_terms": TERMS, "smoothing": 0.5}
        return sysid.torque.torque_rows(ARM, recorded, 4.0, zeros=z, **how)

    def rows(z: Any) -> Any:
        return made(*map(float, z))

    def loss(z: Any) -> float:
        return float((rows(z).residual(pi) ** 2).sum())

    def jacobian(z: Any) -> np.ndarray:
        return -np.einsum("nkpz,p->nkz", rows(z).slopes, pi).reshape(-1, 2)

    def residual(z: Any) -> np.ndarray:
        return rows(z).residual(pi).ravel()

    def gradient(z: Any) -> np.ndarray:
        return 2 * jacobian(z).T @ residual(z)

    return Case(np.array([0.02, 0.01]), loss, gradient, residual, jacobian)


def encoder_zeros() -> Case:
    """Parameters and the zeros of two recordings: the equations of each step are their slopes."""
    made = [
        run("a", (0.05, -0.03), rate=100.0, seconds=3.0),
        run("b", (0.0, 0.02), rate=100.0, seconds=3.0, seed=1),
    ]
    how = {"signal_cutoff": 30.0, "joint_terms": TERMS, "smoothing": 0.5}
    rows = [sysid.torque.torque_rows(ARM, r, 4.0, **how) for r in made]
    p, w = len(truth()), 0.05
    tau = np.concatenate([r.tau for r in rows])

    def residual(x: Any) -> np.ndarray:
        pi, z = x[:p], x[p:].reshape(2, 2)
        off = [r.residual(pi, zr).ravel() for r, zr in zip(rows, z, strict=True)]
        return np.concatenate([*off, -z.ravel() / w])

    def jacobian(x: Any) -> np.ndarray:
        W, _ = _augmented(rows, x[p:].reshape(2, 2), x[:p])
        J = -W.reshape(-1, W.shape[-1])
        J[tau.size :] /= w
        return J

    def loss(x: Any) -> float:
        return float((residual(x) ** 2).sum())

    x = np.concatenate([truth(), [0.03, -0.02, 0.01, 0.02]])
    return Case(x, loss, lambda x: 2 * jacobian(x).T @ residual(x), residual, jacobian)


# --- priors --------------------------------------------------------------------------------------


def prior() -> Case:
    """The log-determinant divergence of a body, by its ten squares."""
    theta = np.asarray(log_cholesky.model_log_cholesky(MODEL))[0]
    P0 = sysid.parameters.from_log_cholesky(theta)

    def loss(x: Any) -> jax.Array:
        return sysid.parameters.log_determinant_divergence(
            sysid.parameters.from_log_cholesky(x), P0
        )

    residual = jax.jit(lambda x: log_cholesky.prior_residual(x, theta))
    jacobian = jax.jit(jax.jacfwd(residual))

    def gradient(x: Any) -> Any:
        return 2 * np.asarray(jacobian(x)).T @ residual(x)

    x = theta + 0.2 * np.random.default_rng(2).normal(size=10)
    return Case(x, loss, gradient, residual, jacobian)


def divergence() -> Case:
    """The same in the inertial parameters, as `minimise` holds them possible; beside numbers that
    are positive, bounded or free."""
    unknowns = {
        "inertia": sysid.Inertia(0), "mass": Unknown("bodies.mass", 1, positive=True),
        "friction": Unknown("joints.damping", 0, bounds=(-1.0, 2.0)),
        "bias": Unknown("joints.springref", scale=0.1),
    }  # fmt: skip
    fat = [2.0, 0.1, 0.0, 0.2, 1.0, 0.05, 1.2, 0.02, 0.03, 0.9]
    model = sysid.parameters.with_inertial_parameters(MODEL, np.tile(fat, 2))
    of = Unknowns.of("test", unknowns, model)
    p0 = np.asarray(of.read(model), float)
    x = p0 * (1 + 0.02 * np.random.default_rng(3).normal(size=p0.size)) + 1e-3 * (p0 == 0)

    def at(x: Any) -> Divergence:
        return of.divergence(x, p0)

    return Case(
        x, lambda x: at(x).value, lambda x: at(x).slope, lambda x: at(x).slope,
        lambda x: at(x).curvature, h=1e-4,
    )  # fmt: skip


# --- motions -------------------------------------------------------------------------------------

T, COUNT = 0.02, 12
PENDULUM = rb.load("pendulum")
UNKNOWNS = {
    "mass": Unknown("bodies.mass", 0, positive=True),
    "damping": Unknown("joints.damping", 0, positive=True),
}
SOUGHT = Unknowns.of("test", UNKNOWNS, Setup.of(PENDULUM))
SETUP, GRID = Setup.of(PENDULUM), Grid(T, 1, "semi_implicit_euler")


def recording(*sensors: str) -> Recording:
    rng, t = np.random.default_rng(5), T * np.arange(COUNT + 1)
    q, v = 0.4 * np.cos(3 * t)[:, None], -1.2 * np.sin(3 * t)[:, None]
    noise = {"q": 0.02, "v": 0.1}
    channels = {
        s: Channel(t, x + noise[s] * rng.normal(size=x.shape), noise=[noise[s]])
        for s, x in (("q", q), ("v", v))
        if s in sensors
    }
    return Recording("test", channels | {"ctrl": Channel(t[:-1], np.sin(5 * t[:-1]))})


def simulation(loss: str, *sensors: str) -> Case:
    data = make_batch(SETUP, [recording(*sensors)], GRID)
    of = SimulationError(SETUP, SOUGHT, data, GRID, estimate_initial_state=True, loss=loss)
    x = np.array([1.2, 0.1, 0.02, -0.1])
    if loss == "huber":
        r = of.residuals(x)
        assert (np.abs(r) > 1.345).any() and (np.abs(r) < 1.345).any()

    def squares(x: Any) -> float:
        return float((of.residuals(x) ** 2).sum())

    return Case(x, squares, residual=lambda x: of.residuals(x).ravel(), triangle=of.triangle)


def shooting() -> Case:
    single = [make_run(SETUP, recording("q", "v"), GRID)]
    of = MultipleShooting(SETUP, SOUGHT, single, GRID, 4 * T)
    x = np.append([1.2, 0.1], 0.05 * np.random.default_rng(4).normal(size=of.size - 2))
    of.continuity_weight = 0.7

    def squares(x: Any) -> float:
        return float((of.residuals(x) ** 2).sum())

    return Case(x, squares, residual=of.residuals, triangle=of.triangle)


def predicted() -> Case:
    """-2 log p of the fit that its own tests make, away from its maximum."""
    found = first()
    return Case(found.x + 0.1, found.likelihood.cost, triangle=found.likelihood.triangle)


def levels() -> Case:
    """Numbers and all three noise levels; the loss is -2 log p, whose triangle is Fisher's."""
    series = make_series(SETUP, [recording("q", "v")], GRID)
    said = NoiseLevels(np.array([0.5]), np.array([0.02, 0.1]))
    of = Likelihood(
        SETUP, SOUGHT, series, GRID, levels=said, drives=np.ones(1, bool), reads=np.ones(2, bool)
    )
    x = np.array([1.2, 0.1, -0.5, -3.8, -2.2])
    return Case(x, of.cost, triangle=of.triangle)


QUICK: dict[str, Callable[[], Case]] = {
    **{f"torques, {method}": functools.partial(regression, method) for method in METHODS},
    "consistent": consistent,
    "torque rows": torque_filter,
    "encoder zeros": encoder_zeros,
    "log-determinant prior": prior,
    "divergences": divergence,
    "prediction error": predicted,
}
MOTIONS: dict[str, Callable[[], Case]] = {
    "simulation error, squares, q": functools.partial(simulation, "squares", "q"),
    "simulation error, squares, q and v": functools.partial(simulation, "squares", "q", "v"),
    "simulation error, huber, q": functools.partial(simulation, "huber", "q"),
    "simulation error, huber, q and v": functools.partial(simulation, "huber", "q", "v"),
    "shooting": shooting,
    "prediction error, noise of q and v": levels,
}
CASES = QUICK | MOTIONS
LONG = [*MOTIONS, "prediction error"]
#: whose loss is JAX's
TRACED = [*(n for n in QUICK if n.startswith("torques")), "log-determinant prior"]


@functools.cache
def case(name: str) -> Case:
    return CASES[name]()


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in CASES]
)
def test_the_derivatives_are_those_of_the_loss(name):
    of = case(name)
    gradient = None if of.gradient is None else of.gradient(of.x)
    if of.triangle is not None:
        R = of.triangle(of.x)
        gradient = 2 * R[:, :-1].T @ R[:, -1]
    close(gradient, differences(of.loss, of.x, of.h))
    if of.residual is None:
        return
    J = differences(of.residual, of.x, of.h)
    if of.jacobian is not None:
        close(of.jacobian(of.x), J)
    else:
        close(R[:, :-1].T @ R[:, :-1], J.T @ J)


@pytest.mark.parametrize("name", TRACED)
def test_losses_are_differentiated_compiled_and_batched(name):
    of = case(name)
    slope = jax.grad(of.loss)
    want = of.gradient(of.x)
    close(jax.jit(slope)(of.x), want)
    close(jax.jit(jax.vmap(slope))(jnp.stack([of.x, 1.1 * of.x]))[0], want)


@pytest.mark.slow
def test_likelihood_by_both_modes_compiled_and_batched():
    """Its gradient is JAX's in reverse mode, too, of many runs at once."""
    series = make_series(SETUP, [recording("q")], GRID)
    said = NoiseLevels(np.array([0.5]), np.array([0.02]))
    of = Likelihood(
        SETUP, SOUGHT, series, GRID, levels=said, drives=np.ones(1, bool), reads=np.zeros(1, bool)
    )
    one = jax.tree.map(lambda a: a[0], series)
    x = np.array([1.2, 0.1, -0.5])
    R = of.triangle(x)
    slope = jax.jit(jax.vmap(jax.grad(lambda x: of.value(x, one))))
    close(slope(jnp.stack([x, 0.9 * x]))[0], 2 * R[:, :-1].T @ R[:, -1])
