"""Exponents that are known, and the time after which a gradient is noise."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.stability import gradient_growth, lyapunov

SADDLE = diffrax.ODETerm(lambda t, y, rates: rates * y)
RATES = np.array([0.3, -2.0])


def _lorenz(t, y, args):
    a, b, c = y
    return jnp.stack([10 * (b - a), a * (28 - c) - b, a * b - 8 / 3 * c])


LORENZ, ON_IT = diffrax.ODETerm(_lorenz), np.array([1.0, 1.0, 20.0])


def test_a_saddle() -> None:
    found = lyapunov(SADDLE, np.zeros(2), dt=0.01, steps=4000, transient=0.5, args=RATES)
    assert abs(found.value - 0.3) < 1e-9  # RK4's own: h^4 lambda^5 / 120
    assert found.error < 1e-9 and found.finite
    sink = lyapunov(SADDLE, np.zeros(2), dt=0.01, steps=4000, transient=0.5, args=-(RATES**2))
    assert abs(sink.value + 0.09) < 1e-9


@pytest.mark.parametrize("name", ["heun", "adams_bashforth3", "radau_iia2"])
def test_what_a_solver_remembers_has_tangents_too(name: str) -> None:
    found = lyapunov(SADDLE, np.zeros(2), dt=0.01, steps=2000, transient=0.5, args=RATES,
                     solver=name)  # fmt: skip
    assert abs(found.value - 0.3) < (1e-5 if name == "heun" else 1e-6)


def test_lorenz() -> None:
    """0.9056 (Sprott, *Chaos and Time-Series Analysis*, 2003)."""
    found = lyapunov(LORENZ, ON_IT, dt=0.01, steps=500_000)
    assert abs(found.value - 0.9056) < max(4 * found.error, 0.004), found[:2]
    assert found.error < 0.004
    assert abs(found.running[-1] - found.value) == 0.0


def test_a_pendulum_is_regular() -> None:
    term = diffrax.ODETerm(lambda t, y, args: (y[1], -jnp.sin(y[0])))
    found = lyapunov(term, (2.0, 0.0), dt=0.02, steps=200_000)
    assert 0 < found.value < 0.01  # log(t) / t, of t = 4,000 s
    assert found.error < 1e-3


@pytest.mark.slow
def test_a_double_pendulum_is_chaotic() -> None:
    model = rb.load("double_pendulum")
    found = lyapunov(model, model.keyframe("swing"), dt=0.002, steps=200_000)
    assert found.value > 10 * found.error
    assert 1.0 < found.value < 1.7
    # two motions from neighbouring states part at the same rate
    gap, T = 1e-11, 12.0
    state = model.keyframe("swing")

    @jax.jit
    def end(q):
        fine = diffrax.PIDController(rtol=1e-13, atol=1e-13)
        ts = jnp.array([0.0, T])
        path = rb.simulate(model, rb.State(q, state.v), ts, solver=diffrax.Dopri8(),
                           stepsize_controller=fine)  # fmt: skip
        return jnp.concatenate([path.q[-1], path.v[-1]])

    apart = [np.linalg.norm(end(state.q + d) - end(state.q)) / gap
             for d in gap * np.eye(2)]  # fmt: skip
    growth = gradient_growth(model, state, dt=0.002, steps=6000)
    columns = np.log10(np.linalg.norm(apart))
    assert abs(columns - growth.log10_norm[-1]) < 1.0, (columns, growth.log10_norm[-1])


@pytest.mark.slow
def test_a_top_on_its_manifold() -> None:
    """The tangents stay on the manifold with a solver that does."""
    model = rb.load("spinning_top")
    found = lyapunov(model, model.keyframe("spinning"), dt=1e-3, steps=100_000)
    assert abs(found.value) < 0.2  # regular: neighbours part linearly


def test_growth_of_a_saddle() -> None:
    found = gradient_growth(SADDLE, np.zeros(2), dt=0.02, steps=10_000, args=RATES)
    np.testing.assert_allclose(found.log10_norm, 0.3 * found.ts / np.log(10), atol=1e-6)
    np.testing.assert_allclose([found.f32, found.f64],
                               np.log([2.0**23, 2.0**52]) / 0.3, rtol=1e-6)  # fmt: skip


def test_no_horizon_without_growth() -> None:
    found = gradient_growth(SADDLE, np.zeros(2), dt=0.02, steps=1000, args=-(RATES**2))
    assert found.f32 == np.inf and found.f64 == np.inf
    assert found.log10_norm[0] == 0.0


def test_the_horizon_is_where_gradients_end() -> None:
    """Gradients through Lorenz' motion in f32 and f64: alike well before the horizon of f32, apart
    beyond it."""
    found = gradient_growth(LORENZ, ON_IT, dt=0.01, steps=4000)
    assert 0.7 < found.f32 * 0.9056 / np.log(2**23) < 1.3
    assert 0.7 < found.f64 * 0.9056 / np.log(2.0**52) < 1.3
    h = 2.0**-7

    @jax.jit
    def gradient(y, steps):
        def once(_, y):  # the classical method, by hand
            k1 = _lorenz(0.0, y, None)
            k2 = _lorenz(0.0, y + h / 2 * k1, None)
            k3 = _lorenz(0.0, y + h / 2 * k2, None)
            return y + h / 6 * (k1 + 2 * (k2 + k3) + _lorenz(0.0, y + h * k3, None))

        return jax.jacfwd(lambda y: jax.lax.fori_loop(0, steps, once, y))(y)

    def gap(T):
        single, double = (np.asarray(gradient(ON_IT.astype(t), round(T / h)), np.float64)
                          for t in (np.float32, np.float64))  # fmt: skip
        return np.abs(single - double).max() / np.abs(double).max()

    assert gap(0.5 * found.f32) < 0.1
    assert gap(1.5 * found.f32) > 0.5


def test_too_few_steps_are_refused() -> None:
    with pytest.raises(rb.InputError, match="16 normalizations"):
        lyapunov(SADDLE, np.zeros(2), dt=0.01, steps=100, args=RATES)
    with pytest.raises(rb.InputError, match="16 normalizations"):
        lyapunov(SADDLE, np.zeros(2), dt=0.01, steps=100_000, transient=1.0, args=RATES)
    with pytest.raises(rb.UnknownName, match="'rk5'"):
        gradient_growth(SADDLE, np.zeros(2), dt=0.01, steps=200, solver="rk5", args=RATES)
    with pytest.raises(rb.InputError, match="multiple"):
        gradient_growth(SADDLE, np.zeros(2), dt=0.01, steps=150, args=RATES)
