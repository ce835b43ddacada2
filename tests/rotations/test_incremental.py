"""Incremental orientation: long tumbling, far beyond every singularity of the local parameter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rbjax import InputError
from rbjax.rotations import incremental, quaternion, so3
from tests.tolerances import relative_error


def omega(t, q):
    return jnp.stack([2 * jnp.sin(t), 1.5 + jnp.cos(2 * t), -1.0 + 0.5 * t / 20])


def reference(end):
    """The matrix equation R' = R [omega], integrated in nine numbers."""

    def rate(t, x):
        return (x.reshape(3, 3) @ np.asarray(_hat(t))).ravel()

    return solve_ivp(rate, (0, end), np.eye(3).ravel(), method="DOP853", rtol=1e-13, atol=1e-13)


@jax.jit
def _hat(t):
    return so3.hat(omega(t, None))


@pytest.mark.parametrize("local", ["mrp", "gibbs", "roll_pitch_yaw"])
def test_tumbling(local: str) -> None:
    """Order four; some twenty turns, so that any unfolded parameter would have met its end."""
    want = reference(20.0).y[:, -1].reshape(3, 3)
    errors = []
    for steps in (1000, 2000):
        ts = jnp.linspace(0.0, 20.0, steps + 1)
        q = jax.jit(
            lambda ts: incremental.integrate(omega, quaternion.identity(), ts, local=local)
        )(ts)
        assert q.shape == (steps + 1, 4)
        np.testing.assert_allclose(jnp.linalg.norm(q, axis=-1), 1.0, atol=1e-14)
        errors.append(float(so3.distance(quaternion.to_matrix(q[-1]), want)))
    assert errors[1] < 1e-7 and 12 < errors[0] / errors[1] < 20


def test_folding_keeps_the_attitude() -> None:
    rng = np.random.default_rng(0)
    q = quaternion.normalize(rng.normal(size=(20, 4)))
    state = incremental.Incremental(q, rng.normal(size=(20, 3)))
    folded = incremental.fold(state)
    short = np.linalg.norm(state.x, axis=1) < 1  # mrp 1 is half a turn, half of the way
    np.testing.assert_array_equal(folded.x[short], state.x[short])
    assert (~short).any() and not np.asarray(folded.x[~short]).any()
    before, after = (quaternion.to_matrix(incremental.attitude(s)) for s in (state, folded))
    assert relative_error(after, before) < 1e-14
    always = incremental.fold(state, margin=100.0)
    assert not np.asarray(always.x).any()


@pytest.mark.slow
def test_is_differentiable() -> None:
    """The final attitude by a constant rate is exp(w t): its derivative is t J_r(w t)."""
    ts = jnp.linspace(0.0, 5.0, 501)

    @jax.jit
    def slopes(w):
        def last(w):
            q = incremental.integrate(lambda t, q: w, quaternion.identity(), ts)[-1]
            return quaternion.to_matrix(q)

        return jax.jacfwd(last)(w), jax.jacrev(last)(w), jax.jacfwd(lambda w: so3.exp(5 * w))(w)

    forward, reverse, want = slopes(jnp.array([0.5, -1.0, 0.8]))
    assert relative_error(forward, want) < 1e-7
    assert relative_error(reverse, forward) < 1e-12


@pytest.mark.parametrize("local", ["zyz", "unit_quaternion", "axis_angle"])
def test_singular_at_zero_is_refused(local: str) -> None:
    with pytest.raises(InputError, match="cannot be a local parameter"):
        incremental.rate(incremental.start(quaternion.identity()), jnp.ones(3), local)
