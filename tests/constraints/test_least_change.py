"""The least change onto constraints: its equations, and its derivative beside differences."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import constraints as rc
from rbjax.constraints.equations.projection import project_state, project_to_tangent_space

FREE = "<freejoint/>"
PLANAR = """<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
  <joint pos="0.1 0 0" axis="0.1 0 1"/>"""
LENGTH = float(np.sqrt(0.6**2 + 0.8**2 + 0.3**2))


def sledge(joints: str, length=LENGTH, mass=2.0) -> rb.Model:
    """A body on a rod from the origin, with an edge that does not slide aside: rows with a level
    and without, and one redundant."""
    model = rb.load(f"""<mujoco><worldbody><body name="sledge" pos="0.6 0.8 0">{joints}
      <inertial pos="0.1 -0.2 0.1" mass="2" fullinertia="0.3 0.4 0.5 0.02 -0.03 0.04"/>
      </body></worldbody></mujoco>""")
    edge = rc.Place.on(body="sledge", point=[0.2, 0.0, -0.1], axis=[1.0, 0.2, 0.0])
    rod = rc.Distance(rc.Place.on(), rc.Place.on(body="sledge", point=[0.0, 0.0, 0.3]), length)
    model = model.with_constraints(rod, rod, rc.KnifeEdge(rc.Place.on(), edge))
    bodies = model.bodies
    return model.replace(bodies=bodies.replace(mass=bodies.mass.at[0].set(mass)))


def projection_of(joints: str, x):
    """The state found near one that numbers change: q, v, a length and a mass."""
    model = sledge(joints, LENGTH + x[12], 2.0 + x[13])
    start, n = model.default_state(), model.nv
    state = rb.State(rb.integrate(model, start.q, 1e-4 + x[:n]), 0.3 + x[6 : 6 + n])
    end = project_state(model, 0.0, state, iterations=3)
    return jnp.concatenate([end.q, end.v])


def across_of(joints: str, x):
    model = sledge(joints, LENGTH + x[12], 2.0 + x[13])
    start, n = model.default_state(), model.nv
    state = rb.State(rb.integrate(model, start.q, 3e-2 + x[:n]), 0.3 + x[6 : 6 + n])
    end = project_to_tangent_space(model, 0.0, state, 0.0, start, iterations=8)
    return jnp.concatenate([end.q, end.v])


#: the direction of the tests' derivatives
ALONG = jax.random.normal(jax.random.key(0), (14,))


@pytest.mark.slow
def test_derivatives() -> None:
    """To the state, a length of the constraints and a mass, forward and reverse."""
    found = partial(projection_of, PLANAR)
    first = jax.jit(partial(rate, found))
    h = 1e-5
    after, before, (end, slope) = first(h)[0], first(-h)[0], first(0.0)
    np.testing.assert_allclose(slope, (after - before) / (2 * h), rtol=0, atol=1e-8)
    w = jax.random.normal(jax.random.key(1), end.shape)
    back = jax.jit(lambda x: jax.vjp(found, x)[1](w)[0])(jnp.zeros(14))
    np.testing.assert_allclose(back @ ALONG, w @ slope, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("of", [projection_of, across_of])
def test_second_derivatives(of) -> None:
    found = partial(of, FREE)
    first = jax.jit(partial(rate, found))
    h = 1e-4
    after, before, (_, slope) = first(h), first(-h), first(0.0)
    np.testing.assert_allclose(slope, (after[0] - before[0]) / (2 * h), rtol=0, atol=1e-6)
    second = jax.jit(lambda s: jax.jvp(lambda s: rate(found, s)[1], (s,), (1.0,))[1])(0.0)
    np.testing.assert_allclose(second, (after[1] - before[1]) / (2 * h), rtol=0, atol=1e-5)


def rate(found, s):
    """The state found s along, and its derivative by s."""
    return jax.jvp(lambda s: found(s * ALONG), (s,), (1.0,))


def test_the_change_is_the_least() -> None:
    """M dq and M dv are in the range of G^T, and the rows hold."""
    model = sledge(FREE)
    q = rb.integrate(model, model.default_state().q, jnp.full(6, 1e-3))
    state = rb.State(q, jnp.array([0.3, -0.2, 0.4, 0.5, -0.1, 0.2]))

    @jax.jit
    def found():
        end = project_state(model, 0.0, state, iterations=6)
        off = rc.residual(model, end)
        M, G = rb.mass_matrix(model, q), rc.jacobian(model, q)
        return M, G, rb.difference(model, q, end.q), end.v - state.v, off

    M, G, dq, dv, off = found()
    _, s, Vt = np.linalg.svd(G)
    Z = Vt[(s > 1e-9).sum() :].T
    assert np.abs(off.rate).max() < 1e-12 and np.nanmax(np.abs(off.value)) < 1e-12
    np.testing.assert_allclose(Z.T @ M @ np.stack([dq, dv], 1), 0.0, atol=1e-12)
    assert np.abs(dq).max() > 1e-4 and np.abs(dv).max() > 0.1
