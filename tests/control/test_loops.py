"""Mechanisms with loops: steps on the constraint, their derivatives, and an optimum.

The bundled parallelogram is a pendulum of one angle: its two rods turn alike, the coupler moves on
a circle, and all configurations that close it are on a plane, so a step stays on them exactly.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import control
from tests.tolerances import GRADIENT, relative_error

H, STEPS, GOAL = 0.02, 20, 1.0
ALIKE = jnp.array([1.0, -1.0, 1.0])  # of left, coupler and right, by the angle


@pytest.fixture(scope="module")
def four_bar(tmp_path_factory) -> rb.Model:
    """With a motor on its left rod."""
    xml = (Path(rb.__file__).parent / "loading/scenes/four_bar.xml").read_text()
    motor = '<actuator><motor joint="left"/></actuator>'
    path = tmp_path_factory.mktemp("scene") / "four_bar.xml"
    path.write_text(xml.replace("<keyframe>", motor + "<keyframe>"))
    return rb.load(path)


def pushed(model, **how) -> control.Problem:
    return control.Problem(
        model, STEPS, H, running=[control.Cost(control.Control(), 1e-3)],
        terminal=[
            control.Cost(lambda t, x, u: _angle(x)[:1] - GOAL, 1e2),
            control.Cost(lambda t, x, u: _angle(x)[1:], 10.0),
        ],
        **how,
    )  # fmt: skip


def _angle(x) -> jax.Array:
    """Of the left rod, and its rate."""
    return jnp.stack([x.q[0], x.v[0]]) if isinstance(x, rb.State) else x


@pytest.mark.slow
def test_derivatives_of_a_step_that_is_projected_are_its_differences(four_bar) -> None:
    """In directions that leave the constraint, too."""
    system = pushed(four_bar).system
    state = rb.State(0.3 * ALIKE, 0.5 * ALIKE)
    n = system.n

    def both(u):
        def at(d):
            return system.step(0.0, system.plus(state, d[:n]), u + d[n:], H)

        d = 1e-6 * jnp.eye(n + 1)
        slopes = jax.vmap(system.minus)(jax.vmap(at)(d), jax.vmap(at)(-d)).T / 2e-6
        found = system.linear(0.0, state, u, H)
        return jnp.concatenate([found.A, found.B], 1), slopes

    found, due = jax.jit(both)(jnp.array([3.0]))
    assert relative_error(found, due) < GRADIENT


@pytest.mark.slow
def test_the_optimum_is_that_of_the_pendulum_of_one_angle(four_bar) -> None:
    inertia = 2 * (0.0833 + 0.25) + 1.0

    def step(t, x, u):  # semi-implicit Euler
        rate = x[1] + H * (u[0] + 2 * 9.81 * jnp.sin(x[0])) / inertia
        return jnp.stack([x[0] + H * rate, rate])

    start = rb.State(0.3 * ALIKE, jnp.zeros(3))
    found = control.solve(pushed(four_bar, integrator="semi_implicit_euler"), start)
    pendulum = control.Equations(step, 2, 1, discrete=True)
    due = control.solve(pushed(pendulum), jnp.array([0.3, 0.0]))
    assert found.success and due.success
    np.testing.assert_allclose(found.cost, due.cost, rtol=1e-9)
    np.testing.assert_allclose(found.ctrl, due.ctrl, atol=1e-5)
    np.testing.assert_allclose(found.states.q, due.states[:, :1] * ALIKE, atol=1e-7)
