"""Maps of regions of attraction beside a closed form; axes, turns, bad input."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import region_of_attraction

RAIL = "tests/oracles/mass_on_a_rail.xml"


def saturated(t, state):
    """x'' = x + sat(-3 (x + v)): z = x + v follows z' = z - sat(3 z), so x = v = 0 attracts exactly
    |z| < 1."""
    x, v = state.q, state.v
    return x + jnp.clip(-3 * (x + v), -1, 1)


def test_a_region_in_closed_form():
    model = rb.load(RAIL)
    found = region_of_attraction(
        model, saturated, model.default_state(), [("x", -2.0, 2.0), ("x'", -2.0, 2.0)],
        points=(13, 9), duration=16.0, dt=0.04, integrator="rk4",
    )  # fmt: skip
    X, V = np.meshgrid(found.x, found.y)
    z = np.abs(X + V)
    assert found.back.shape == (9, 13) and (found.back == (z < 1))[np.abs(z - 1) > 0.02].all()
    assert (found.distance <= 0.05).tolist() == found.back.tolist()
    assert found.time[4, 6] == 0.0 and np.isnan(found.time[0, 0])
    # on v = -x the motion is x' = -x, but for the control, which is held for a step of 0.04 s
    for i, j in [(i, j) for i in range(9) for j in range(13) if abs(X[i, j] + V[i, j]) < 1e-12]:
        want = max(0.0, np.log(20 * abs(X[i, j]))) if X[i, j] else 0.0
        assert abs(found.time[i, j] - want) <= 0.1
    assert found.names == ("x", "x'") and abs(found.share - found.back.mean()) == 0
    assert np.allclose(found.extent, (-2 - 1 / 6, 2 + 1 / 6, -2.25, 2.25))


def test_a_turn_more_is_the_same_angle():
    """A pole that begins a whole turn away is at the top."""
    model = rb.load("cart_pole")
    law = lambda t, state: jnp.zeros(1)  # noqa: E731
    ask = {"points": (2, 2), "duration": 0.02, "dt": 0.02}
    axes = [(1, 0.0, 2 * np.pi), ("slider", 0.0, 1.0)]
    up = model.keyframe("up")
    found = region_of_attraction(model, law, up, axes, **ask)
    assert found.back.tolist() == [[True] * 2, [False] * 2]
    found = region_of_attraction(model, law, up, axes, angles=False, **ask)
    assert found.back.tolist() == [[True, False], [False, False]]


def test_what_is_not_finite_is_not_back():
    model = rb.load(RAIL)
    law = lambda t, state: jnp.where(jnp.abs(state.q) > 0.5, jnp.nan, -state.q - state.v)  # noqa: E731
    found = region_of_attraction(
        model, law, model.default_state(), [("x", -1.0, 1.0), ("x'", 0.0, 0.1)],
        points=(3, 2), duration=12.0, dt=0.1,
    )  # fmt: skip
    assert found.back.tolist() == [[False, True, False]] * 2
    assert np.isinf(found.distance[0, 0])


@pytest.mark.slow
def test_a_long_motion_goes_in_parts(monkeypatch):
    """Few states are kept at once; the policy has the time since the start, and a motion that is
    not finite in the first part stays so."""
    model = rb.load(RAIL)

    def law(t, state):
        lost = (jnp.abs(state.q) > 0.8) & (t > 0.25)
        return jnp.where(lost, jnp.nan, -(1.0 + jnp.sin(3 * t)) * (2 * state.q + 3 * state.v))

    def ask():
        return region_of_attraction(
            model,
            law,
            model.default_state(),
            [("x", -1.0, 1.0), ("x'", -0.5, 0.5)],
            points=(5, 3),
            duration=6.3,
            dt=0.1,
        )

    whole = ask()
    monkeypatch.setattr("rbjax.control.laws.attraction_map.KEPT", 2 * 15 * 10)
    parts = ask()
    assert parts.back.tolist() == whole.back.tolist() and 0 < whole.share < 1
    np.testing.assert_allclose(parts.distance, whole.distance, rtol=1e-9)
    np.testing.assert_allclose(parts.time, whole.time, rtol=1e-9)
