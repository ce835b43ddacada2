"""Craig-Bampton bodies of beams and solids: frequencies, invariants, interfaces, errors."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp

from rbjax.errors import InputError, UnknownName
from rbjax.flexible import rectangle, section
from rbjax.flexible.modal import (
    BeamSection,
    FiniteElements,
    Interface,
    beam_mesh,
    box_mesh,
    craig_bampton,
    tetrahedral_mesh,
    with_middle_nodes,
)

BETA = np.array([1.875104068711961, 4.694091132974175, 7.854757438237613, 10.99554073487547])
FREE_BETA = np.array([4.730040744862704, 7.853204624095838, 10.99560783800167])
EULER = BeamSection(EA=2.8e7, EIy=1.4e4, EIz=3.1e4, GJ=1e4, mass=1.2, rotary=(1e-3, 0.0, 0.0))


def line(n, length=10.0, direction=(1.0, 0.0, 0.0)):
    return np.linspace(np.zeros(3), length * np.asarray(direction), n + 1)


def errors(body, want):
    """Relative distance of the nearest frequency of a body to each wanted one."""
    want = np.atleast_1d(want)
    return np.abs(body.frequencies / want[:, None] - 1).min(1)


def test_cantilever_of_euler():
    """Errors of cubic elements fall with h^4."""
    want = BETA**2 * np.sqrt(1.4e4 / 1.2 / 1e4)
    found = [
        errors(
            craig_bampton(beam_mesh(line(n), EULER), [Interface("root", [0])], 14, frame="root"),
            want,
        )
        for n in (10, 20)
    ]
    assert found[1].max() < 1e-4 and found[1][0] < 1e-7
    assert (found[0][1:] / found[1][1:] > 14).all()


def test_cantilever_of_timoshenko():
    """Steel, 1 x 0.1 x 0.1 m, shear factor 5/6: roots of the characteristic equation."""
    omega = [522.50733604, 3131.56683978, 8236.49892388, 14940.7449485]
    steel = rectangle(0.1, 0.1, E=2.1e11, nu=0.3, density=7800.0, shear=5 / 6)
    found = [
        errors(
            craig_bampton(
                beam_mesh(line(n, 1.0), steel), [Interface("root", [0])], 16, frame="root"
            ),
            omega,
        )
        for n in (20, 40)
    ]
    assert found[1][0] < 1e-5 and found[1].max() < 1e-3
    # the shape functions are static: the rotary and shear terms have the error h^2
    assert (found[0] / found[1] > 3.5).all()
    # both are too high, so the error h^2 can be extrapolated
    assert np.abs((4 * found[1] - found[0]) / 3)[:2].max() < 1e-6


def test_a_section_of_a_beam():
    """A section of `rbjax.flexible` and the same `BeamSection`."""
    given = rectangle(0.1, 0.2, E=2.1e11, nu=0.3, density=7800.0, shear=5 / 6)
    GJ, EIy, EIz, EA, GAy, GAz = np.diagonal(given.stiffness)
    own = BeamSection(EA, EIy, EIz, GJ, given.mass, GAy, GAz, tuple(np.asarray(given.inertia)))
    one, two = (beam_mesh(line(3, 1.0), x) for x in (given, own))
    assert abs(one.M - two.M).max() == 0 == abs(one.K - two.K).max()
    C = np.eye(6)
    C[0, 1] = C[1, 0] = 0.1
    with pytest.raises(InputError, match="coupled or tapered"):
        beam_mesh(line(3), section(C, 1.0, [2.0, 1.0, 1.0]))


def test_free_beam_has_mean_axes():
    """Without a frame the rigid modes are gone: no momentum in the modes, free-free frequencies."""
    mesh = beam_mesh(line(20), EULER)
    ends = [Interface("left", [0]), Interface("right", [20])]
    for interfaces in (ends, []):
        body = craig_bampton(mesh, interfaces, 16)
        want = FREE_BETA**2 * np.sqrt(1.4e4 / 1.2 / 1e4)
        got = body.frequencies
        assert errors(body, want[:2]).max() < 2e-4  # 16 modes of the reduction
        scale = np.sqrt(12.0)
        assert np.abs(np.asarray(body.first_moment1)).max() < 1e-8 * scale
        about = np.asarray(body.coupling) - np.cross([5.0, 0, 0], body.first_moment1, axis=0)
        assert np.abs(about).max() < 1e-7 * scale
        assert got[0] > 1.0


def test_invariants_of_a_bar():
    """Mass, first moment and inertia of a bar and of a solid, about the frame at its root."""
    mesh = beam_mesh(line(8) + np.array([0, 0, 3.0]), EULER)
    body = craig_bampton(mesh, [Interface("root", [0]), Interface("tip", [8])], 2, frame="root")
    assert np.allclose(body.mass, 12.0, rtol=1e-13)
    assert np.allclose(body.first_moment, [60.0, 0, 0], atol=1e-10)
    assert np.allclose(body.inertia, np.diag([1e-2, 400.0, 400.0]), atol=1e-9)
    assert np.allclose(body.positions, [[0, 0, 0], [10, 0, 0]])
    nodes, cells = box_mesh((1.0, 2.0, 3.0), (1, 2, 2), quadratic=True)
    solid = tetrahedral_mesh(nodes, cells, E=1e9, poisson=0.3, density=2.0)
    whole = craig_bampton(solid, [], 3)
    assert np.allclose(whole.mass, 12.0, rtol=1e-12)
    assert np.allclose(whole.first_moment, [6.0, 12.0, 18.0], rtol=1e-12)
    second = 12.0 / 3 * np.array([1.0, 4.0, 9.0])
    assert np.allclose(np.diag(whole.inertia), second.sum() - second, rtol=1e-12)
    assert np.allclose(whole.inertia[0, 1], -12.0 * 0.5 * 1.0, rtol=1e-12)


def test_matrices_of_another_program():
    """Given M and K only: the same body from a solid's matrices; first-order terms of a frame."""
    nodes, cells = box_mesh((2.0, 0.3, 0.2), (4, 1, 1), quadratic=True)
    solid = tetrahedral_mesh(nodes, cells, E=1e9, poisson=0.3, density=2000.0)
    ends = [Interface(k, np.flatnonzero(nodes[:, 0] == x)) for k, x in (("a", 0.0), ("b", 2.0))]
    bare = FiniteElements.from_matrices(solid.M, solid.K, nodes)
    one, two = (craig_bampton(x, ends, 3, frame="a", stiffening=False) for x in (solid, bare))
    names = ("first_moment1", "coupling", "inertia", "inertia1", "inertia2", "coupling1", "modes")
    for name in names:
        a, b = np.asarray(getattr(one, name)), np.asarray(getattr(two, name))
        assert np.abs(a - b).max() < 1e-8 * np.abs(b).max(), name  # modes of two eigenproblems
    beam = beam_mesh(line(6), EULER)
    lumped = FiniteElements.from_matrices(beam.M.toarray(), beam.K.toarray(), beam.positions)
    tips = [Interface("a", [0]), Interface("b", [6])]
    one, two = (craig_bampton(x, tips, 0, frame="a", stiffening=False) for x in (beam, lumped))
    for name in ("first_moment1", "coupling", "inertia", "modal_mass"):
        a, b = np.asarray(getattr(one, name)), np.asarray(getattr(two, name))
        assert np.abs(a - b).max() < 1e-7 * max(np.abs(b).max(), 1e-3), name


def test_two_static_modes_against_ten():
    """The tip of a cantilever after a step force, against ten modes and against free modes.

    Static modes decide: two Craig-Bampton modes are within 1 %, ten free modes are not.
    """
    n = 20
    mesh = beam_mesh(line(n), EULER)
    ends = [Interface("root", [0]), Interface("tip", [n])]

    def largest(K, M, tip):
        values, modes = scipy.linalg.eigh(K, M)
        times = np.linspace(0, 2 * np.pi / np.sqrt(values[0]), 400)
        share = (tip @ modes) ** 2 / values
        return (share * (1 - np.cos(np.sqrt(values) * times[:, None]))).sum(1).max()

    def reduced(count):
        body = craig_bampton(mesh, ends, count, frame="root", orthogonal=False)
        names = [k for k, s in enumerate(body.mode_names) if s in ("tip z", "tip ry")]
        c = np.abs(np.asarray(body.coupling))
        keep = names + [k for k in range(6, body.mode_count) if c[1, k] > c[[0, 2], k].sum()][:8]
        body = body.with_modes(keep)
        tip = np.asarray(body.modes)[1, 2]
        return largest(np.asarray(body.stiffness), np.asarray(body.modal_mass), tip), len(keep)

    two, count = reduced(0)
    ten, more = reduced(24)
    assert count == 2 and more == 10
    assert abs(two / ten - 1) < 0.01
    # the whole mesh
    free = [k for k in range(6, 6 * (n + 1)) if k % 6 in (2, 4)]
    K, M = (A.toarray()[np.ix_(free, free)] for A in (mesh.K, mesh.M))
    tip = np.zeros(len(free))
    tip[free.index(6 * n + 2)] = 1.0
    assert abs(ten / largest(K, M, tip) - 1) < 1e-4


def test_quadratic_solid_is_a_beam():
    """A slender box, clamped at averaged faces: the first bending frequency of Timoshenko."""
    L, h = 1.0, 0.1
    nodes, cells = box_mesh((L, h, h), (10, 1, 1), quadratic=True)
    solid = tetrahedral_mesh(nodes, cells, E=2.1e11, poisson=0.3, density=7800.0)
    ends = [Interface(k, np.flatnonzero(nodes[:, 0] == x)) for k, x in (("root", 0), ("tip", L))]
    body = craig_bampton(solid, ends, 4, frame="root", stiffening=False)
    # an averaged face is softer than a clamped one, by its warping: a diameter over the length
    assert 0.97 < body.frequencies[0] / 522.50733604 < 1.005
    assert abs(body.frequencies[1] / body.frequencies[0] - 1) < 0.03  # the mesh is not symmetric
    linear = tetrahedral_mesh(*box_mesh((L, h, h), (10, 1, 1)), E=2.1e11, poisson=0.3, density=7800)
    corner = box_mesh((L, h, h), (10, 1, 1))[0]
    ends = [Interface(k, np.flatnonzero(corner[:, 0] == x)) for k, x in (("root", 0), ("tip", L))]
    stiff = craig_bampton(linear, ends, 4, frame="root", stiffening=False)
    assert stiff.frequencies[0] > 1.3 * body.frequencies[0]  # linear tetrahedra lock in bending


def test_patch_of_constant_strain():
    """Displacements that are linear in space have their exact energy, in both kinds of elements."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 3))
    strain = (A + A.T) / 2
    E, nu = 3.0, 0.25
    mu, lam = E / (2 + 2 * nu), E * nu / ((1 + nu) * (1 - 2 * nu))
    density = mu * (strain**2).sum() + lam * np.trace(strain) ** 2 / 2
    nodes, cells = box_mesh((1.0, 2.0, 1.5), (2, 2, 2))
    inner = (nodes[:, 0] == 0.5) & (nodes[:, 1] == 1.0) & (nodes[:, 2] == 0.75)
    nodes = nodes + 0.1 * rng.normal(size=nodes.shape) * inner[:, None]
    for mesh in ((nodes, cells), with_middle_nodes(nodes, cells)):
        solid = tetrahedral_mesh(*mesh, E=E, poisson=nu, density=1.0)
        u = (mesh[0] @ A.T).ravel()
        assert np.isclose(u @ (solid.K @ u) / 2, 3.0 * density, rtol=1e-12)
        force = (solid.K @ u).reshape(-1, 3)
        inside = ((mesh[0] > 1e-9) & (mesh[0] < np.array([1, 2, 1.5]) - 1e-9)).all(1)
        assert np.abs(force[inside]).max() < 1e-12 * np.abs(force).max()
        # K_g is a quadratic form of the gradient of a second displacement
        G = rng.normal(size=(3, 3))
        stress = 2 * mu * strain + lam * np.trace(strain) * np.eye(3)
        v = (mesh[0] @ G.T).ravel()
        got = v @ (solid.prestress(u) @ v)
        assert np.isclose(got, 3.0 * np.einsum("ca,ab,cb", G, stress, G), rtol=1e-10)


def test_sparse_and_full_modes_agree():
    nodes, cells = box_mesh((2.0, 0.3, 0.2), (7, 1, 1), quadratic=True)
    solid = tetrahedral_mesh(nodes, cells, E=1e9, poisson=0.3, density=2000.0)
    assert solid.M.shape[0] > 400
    root = Interface("root", np.flatnonzero(nodes[:, 0] == 0.0))
    body = craig_bampton(solid, [root], 5, frame="root", stiffening=False)
    from rbjax.flexible.modal.interfaces import rigid_motion

    Z = scipy.linalg.null_space(rigid_motion(solid, root))
    K, M = (Z.T @ (A @ Z) for A in (solid.K, solid.M))
    want = np.sqrt(scipy.linalg.eigh(K, M, eigvals_only=True)[:5])
    assert np.abs(body.frequencies / want - 1).max() < 1e-9


SOLID = box_mesh((2.0, 1.0, 1.0), (2, 1, 1))


@pytest.mark.parametrize(
    ("interfaces", "options", "message"),
    [
        ([Interface("a", [0, 1])], {}, "2 nodes on one line"),
        ([Interface("a", [0])], {}, "one node"),
        ([Interface("a", [0, 1, 99])], {}, "no node 99"),
        ([Interface("a", [0, 1, 1, 4])], {}, "node 1 twice"),
        ([Interface("a", [0, 1, 2]), Interface("b", [2, 4, 9])], {}, "node 2 and interface 'a'"),
        ([Interface("a", [0, 1, 2]), Interface("a", [5, 6, 7])], {}, "given twice"),
        ([Interface("a", [])], {}, "expected indices"),
        ([Interface("a", [0, 1, 2], position=[0.0])], {}, "position"),
        ([Interface("a", [0, 1, 2])], dict(modes=0, frame="a"), "no modes"),
        ([Interface("a", [0, 1, 2])], dict(modes=99), "99 normal modes"),
        ([Interface("a", [0, 1, 2])], dict(orthogonal=False), "natural modes"),
    ],
)
def test_wrong_interfaces_are_sentences(interfaces, options, message):
    solid = tetrahedral_mesh(*SOLID, E=1.0, poisson=0.3, density=1.0)
    with pytest.raises(InputError, match=message):
        craig_bampton(solid, interfaces, **options)


def test_other_wrong_input():
    solid = tetrahedral_mesh(*SOLID, E=1.0, poisson=0.3, density=1.0)
    with pytest.raises(UnknownName, match="rot"):
        craig_bampton(solid, [Interface("root", [0, 1, 2])], frame="rot")
    nodes, cells = SOLID
    with pytest.raises(InputError, match="volume"):
        tetrahedral_mesh(nodes, cells[:, [1, 0, 2, 3]], E=1.0, poisson=0.3, density=1.0)
    with pytest.raises(InputError, match="no element"):
        tetrahedral_mesh(np.concatenate([nodes, [[9.0, 9, 9]]]), cells, E=1, poisson=0.3, density=1)
    with pytest.raises(InputError, match="Poisson"):
        tetrahedral_mesh(nodes, cells, E=1.0, poisson=0.5, density=1.0)
    with pytest.raises(InputError, match="no length"):
        beam_mesh(np.zeros((2, 3)), EULER)
    with pytest.raises(InputError, match=r"EIy.*above zero"):
        beam_mesh(line(2), BeamSection(EA=1.0, EIy=0.0, EIz=1.0, GJ=1.0, mass=1.0))
    with pytest.raises(InputError, match="y_axis"):
        beam_mesh(line(2), EULER, y_axis=[1.0, 0, 0])
    with pytest.raises(InputError, match="not symmetric"):
        FiniteElements.from_matrices(np.triu(np.ones((3, 3))), np.eye(3), [[0.0, 0, 0]])
    massless = BeamSection(EA=1.0, EIy=1.0, EIz=1.0, GJ=1.0, mass=1.0)
    with pytest.raises(InputError, match="rotary"):
        craig_bampton(beam_mesh(line(2), massless), [Interface("a", [0])], 2, frame="a")
    # two bars that are not connected
    apart = beam_mesh(line(3), EULER, elements=[[0, 1], [2, 3]])
    with pytest.raises(InputError, match="without deformation"):
        craig_bampton(apart, [Interface("a", [0])], 2, frame="a")
    # supported matrices are not free
    held = FiniteElements.from_matrices(
        solid.M, solid.K + sp.eye(solid.M.shape[0]) * 0.1, solid.positions
    )
    with pytest.raises(InputError, match="not free"):
        craig_bampton(held, [Interface("a", [0, 1, 2])], 2)
