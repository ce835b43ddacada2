"""Frequencies of beams as links: cantilevers with and without shear, still and rotating."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import rbjax as rb
from tests.oracles import load

EMPTY = '<mujoco><option gravity="0 0 0"/></mujoco>'
HUB = """<mujoco><option gravity="0 0 0"/><worldbody><body name="hub"><joint axis="0 0 1"/>
  <geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>"""
CANTILEVER = np.array([float(x) for x in load("beams")["cantilever_modes"]["betaL"]]) ** 2


def compiled(f):
    return jax.jit(f, compiler_options=rb.compiler_options())


def cantilever(beam: rb.flexible.Beam) -> rb.Model:
    return rb.load(EMPTY).with_beam("rod", beam)


def frequencies(model: rb.Model) -> np.ndarray:
    """rad/s, of small motions at rest: K x = w^2 M x."""
    at_rest = model.default_state()

    def force(q):
        return rb.applied_forces(model, at_rest.replace(q=q))

    K, M = -compiled(jax.jacfwd(force))(at_rest.q), rb.mass_matrix(model, at_rest.q)
    return np.sqrt(scipy.linalg.eigh(np.asarray(K), np.asarray(M), eigvals_only=True))


@pytest.mark.parametrize(("degree", "errors"), [(3, [2e-6, 6e-3]), (7, [1e-8, 1e-8, 2e-6, 2e-3])])
def test_cantilever(degree: int, errors: list[float]) -> None:
    """w = (beta L)^2 with EI = m = L = 1, cos(beta L) cosh(beta L) = -1."""
    beam = rb.flexible.beam(1.0, [0, 0, 1.0, 0, 0, 0], {"k_z": degree}, mass=1.0)
    found = frequencies(cantilever(beam))[: len(errors)]
    assert (np.abs(found / CANTILEVER[: len(errors)] - 1) < errors).all()


@pytest.mark.slow
def test_linearise() -> None:
    """`linearise` has the same frequencies, and the damping ratio is w times half the ratio of
    viscosity to stiffness."""
    beam = rb.flexible.beam(1.0, [0, 0, 1.0, 0, 0, 0], {"k_z": 3}, mass=1.0, damping=2e-3)
    model = cantilever(beam)
    A, _ = rb.linearise(model, model.default_state())
    roots = np.linalg.eigvals(A)
    roots = roots[roots.imag > 0]
    roots = roots[np.argsort(abs(roots))]
    w = frequencies(model)
    np.testing.assert_allclose(abs(roots), w, rtol=1e-10)
    np.testing.assert_allclose(-roots.real / w, 1e-3 * w, rtol=1e-8)
    assert abs(w[0] / CANTILEVER[0] - 1) < 2e-6


@pytest.mark.slow
def test_timoshenko() -> None:
    """A thick cantilever with shear and rotary inertia: coefficients of k_z and of g_y.

    One coefficient less for shear is the best split. With 8 coordinates no split has 1e-8.
    """
    want = np.array(load("beams")["timoshenko_cantilever"]["omega"])
    square = rb.flexible.rectangle(0.1, 0.1, E=2.1e11, nu=0.3, density=7800.0, shear=5 / 6)
    for k, g, errors in (
        (4, 4, [2e-6, 6e-3]), (5, 3, [1.1e-6, 3e-3]), (6, 5, [1e-9, 3e-5, 6e-4]),
        (8, 8, [1e-8, 1e-8, 3e-6, 2e-3]),
    ):  # fmt: skip
        beam = rb.flexible.beam(1.0, square, {"k_z": k - 1, "g_y": g - 1})
        found = frequencies(cantilever(beam))[: len(errors)]
        assert (np.abs(found / want[: len(errors)] - 1) < errors).all()


@pytest.mark.slow
def test_flap_of_a_rotating_cantilever() -> None:
    """Small motions out of the plane of rotation, about an axis through the root."""
    beam = rb.flexible.beam(1.0, [0, 1.0, 0, 0, 0, 0], {"k_y": 7}, mass=1.0)
    model = rb.load(HUB).with_beam("rod", beam, "hub")
    zero = jnp.zeros(model.nv)

    def force(x, speed):
        """Generalized forces that hold the beam while the hub turns."""
        q, v = zero.at[1:].set(x), zero.at[0].set(speed)
        state = rb.State(q, v)
        return (rb.inverse_dynamics(model, q, v, zero) - rb.applied_forces(model, state))[1:]

    stiffness = compiled(jax.jacfwd(force))
    M = np.asarray(rb.mass_matrix(model, zero))[1:, 1:]
    for speed, want in load("beams")["rotating_cantilever_flap"]["table"].items():
        K = np.asarray(stiffness(zero[1:], float(speed)))
        np.testing.assert_allclose(K, K.T, atol=1e-13)
        found = np.sqrt(scipy.linalg.eigh(K, M, eigvals_only=True))[:3]
        fast = float(speed) > 10  # the tension bends the root in a shorter and shorter distance
        errors = [1e-7 if fast else 1e-8, 5e-7, 3e-6]
        assert (np.abs(found / np.array(want) - 1) < errors).all(), speed
