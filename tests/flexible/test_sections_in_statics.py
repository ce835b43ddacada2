"""Torsion, coupled sections, natural twist and taper of a beam against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import rbjax as rb
from tests.flexible.test_beam_frequencies import EMPTY, cantilever, frequencies

flexible = rb.flexible


def unbalanced(model: rb.Model, q, wrench) -> np.ndarray:
    """Generalized forces at rest under a wrench [moment; force] at the tip, in world axes."""
    state = model.default_state().replace(q=jnp.asarray(q, float))
    J = rb.jacobian(model, state.q, "rod")
    return np.asarray(rb.applied_forces(model, state) + J.T @ jnp.asarray(wrench, float))


def compliance(model: rb.Model, axis: int) -> float:
    """Deflection of the tip along an axis by a small unit force along it."""
    state = model.default_state()
    K = -jax.jacfwd(lambda q: rb.applied_forces(model, state.replace(q=q)))(state.q)
    J = np.asarray(rb.jacobian(model, state.q, "rod"))[3 + axis]
    return float(J @ np.linalg.solve(np.asarray(K), J))


def test_a_torque_twists_a_beam_by_a_constant_rate() -> None:
    """Angle T L / GJ, at any size."""
    GJ, T, L = 2.0, 1.5, 1.2
    beam = flexible.beam(L, [GJ, 1.0, 1.0, 0, 0, 0], {"k_x": 1, "k_y": 1}, mass=1.0)
    model = cantilever(beam)
    q = [T / GJ, 0.0, 0.0, 0.0]
    assert np.abs(unbalanced(model, q, [T, 0, 0, 0, 0, 0])).max() < 1e-14
    R, p = rb.frame_pose(model, jnp.asarray(q), "rod")
    angle = T * L / GJ
    turn = [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    np.testing.assert_allclose(R, turn, atol=1e-14)
    np.testing.assert_allclose(p, [L, 0, 0], atol=1e-14)


@pytest.mark.parametrize("strain", ["k_x", "e_x"])
def test_frequencies_of_rods(strain: str) -> None:
    """Torsion and extension: w = (2 k - 1) pi / 2 L sqrt(stiffness / inertia)."""
    C = {"k_x": [3.0, 0, 0, 0, 0, 0], "e_x": [0, 0, 0, 3.0, 0, 0]}[strain]
    beam = flexible.beam(2.0, C, {strain: 6}, mass=0.75, inertia=(0.75, 0.5, 0.25))
    found = frequencies(cantilever(beam))[:3]
    want = np.array([1, 3, 5]) * np.pi / 4 * np.sqrt(3.0 / 0.75)
    assert (np.abs(found / want - 1) < [1e-12, 3e-7, 2e-4]).all()


def test_a_coupled_section_under_a_moment() -> None:
    """A full 6 x 6 stiffness: constant strains C^-1 [0, M, 0, 0, 0, 0], and the arc that they make.

    Extension and curvature about y are coupled, so a moment stretches the beam.
    """
    C, M, L = np.diag([1.0, 2.0, 1.5, 40.0, 30.0, 30.0]), 1.7, 1.1
    C[1, 3] = C[3, 1] = 3.0
    beam = flexible.beam(L, C, {"k_y": 1, "e_x": 1}, mass=1.0)
    model = cantilever(beam)
    k, e = np.linalg.solve(C[np.ix_([1, 3], [1, 3])], [M, 0.0])
    assert abs(e) > 0.05
    q = [k, 0.0, e, 0.0]
    assert np.abs(unbalanced(model, q, [0, M, 0, 0, 0, 0])).max() < 1e-13
    p = rb.frame_pose(model, jnp.asarray(q), "rod")[1]
    arc = (1 + e) / k * np.array([np.sin(k * L), 0.0, np.cos(k * L) - 1])
    np.testing.assert_allclose(p, arc, atol=1e-13)


def test_natural_curvature_and_twist_are_free_of_forces() -> None:
    """The unloaded beam is the helix of constant natural twist and curvature."""
    kappa, L = np.array([0.8, 0.0, 1.1]), 1.3
    natural = {"k_x": [kappa[0]], "k_z": [kappa[2]]}
    beam = flexible.beam(L, np.ones(6), {"k_x": 1, "k_y": 1, "k_z": 1}, mass=1.0, natural=natural)
    model = cantilever(beam)
    zero = np.zeros(model.nv)
    assert np.abs(unbalanced(model, zero, np.zeros(6))).max() == 0.0
    xi = np.zeros((4, 4))
    xi[:3, :3] = np.cross(kappa, np.eye(3)).T
    xi[0, 3] = 1.0
    want = scipy.linalg.expm(L * xi)
    R, p = rb.frame_pose(model, jnp.asarray(zero), "rod")
    np.testing.assert_allclose(R, want[:3, :3], atol=1e-9)
    np.testing.assert_allclose(p, want[:3, 3], atol=1e-9)


def test_a_twisted_strip_bends_by_both_stiffnesses() -> None:
    """int (L - s)^2 (cos^2 / EI_y + sin^2 / EI_z) ds: the axes of the sections turn by tau s."""
    EI_y, EI_z, twist, L = 1.0, 20.0, 2.0, 1.0
    beam = flexible.beam(
        L, [5.0, EI_y, EI_z, 0, 0, 0], {"k_y": 7, "k_z": 7}, mass=1.0, natural={"k_x": [twist]}
    )

    def share(s: float) -> float:
        c, b = np.cos(twist * s) ** 2, np.sin(twist * s) ** 2
        return (L - s) ** 2 * (c / EI_y + b / EI_z)

    want = scipy.integrate.quad(share, 0.0, L, epsabs=1e-14)[0]
    assert compliance(cantilever(beam), axis=2) == pytest.approx(want, rel=1e-7)


def test_a_cone_is_softer_than_a_cylinder() -> None:
    """L^3 / 3 EI times the ratio of the diameters of root and tip."""
    E, r, L, ratio = 1e8, 0.01, 0.5, 0.6
    points = 11
    nodes = (np.polynomial.legendre.leggauss(points)[0] + 1) / 2
    section = flexible.circle(r * (1 - (1 - ratio) * nodes), E=E, nu=0.3, density=1000.0)
    beam = flexible.beam(L, section, {"k_y": 7}, points=points)
    want = L**3 / (3 * E * np.pi * r**4 / 4) / ratio
    assert compliance(cantilever(beam), axis=2) == pytest.approx(want, rel=1e-8)


def test_kirchhoff_and_inextensible_are_limits() -> None:
    """Frequencies with stiff shear and extension tend to those without, as 1 / stiffness."""
    own = {"mass": 1.0, "inertia": (2e-3, 1e-3, 1e-3)}
    kirchhoff = flexible.beam(1.0, [0, 0, 1.0, 0, 0, 0], {"k_z": 3}, **own)
    want, errors = frequencies(cantilever(kirchhoff))[:2], []
    for stiff in (1e4, 1e6):
        C = [0, 0, 1.0, stiff, stiff, 0]
        beam = flexible.beam(1.0, C, {"k_z": 3, "e_x": 2, "g_y": 2}, **own)
        errors.append(np.abs(frequencies(cantilever(beam))[:2] / want - 1).max())
    assert errors[1] < 1e-4 and 50 < errors[0] / errors[1] < 200


def test_a_rod_between_two_masses() -> None:
    """w^2 = (EA / L) (1 / m_1 + 1 / m_2) of a light rod between two bodies."""
    EA, L, m = 50.0, 0.8, (0.7, 0.3)
    rod = flexible.beam(L, [0, 0, 0, EA, 0, 0], {"e_x": 0}, mass=1e-9)
    block = f"""<worldbody><body name="a"><joint type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="{m[0]}" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
    model = rb.load(EMPTY.replace("</mujoco>", block)).with_beam("b", rod, "a")
    mass = model.bodies.mass.at[model.body("b")].set(m[1])
    model = model.replace(bodies=model.bodies.replace(mass=mass))
    state = model.default_state()
    K = -jax.jacfwd(lambda q: rb.applied_forces(model, state.replace(q=q)))(state.q)
    found = scipy.linalg.eigh(np.asarray(K), np.asarray(rb.mass_matrix(model, state.q)))[0]
    np.testing.assert_allclose(found, [0.0, EA / L * (1 / m[0] + 1 / m[1])], rtol=1e-7, atol=1e-9)
