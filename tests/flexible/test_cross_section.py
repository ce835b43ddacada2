"""Cross-sections: moments by integration, torsion by a grid, coefficients of shear, errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import diags_array, eye_array, kron
from scipy.sparse.linalg import spsolve

from rbjax.errors import InputError
from rbjax.flexible import cross_section as sections

STEEL = {"E": 2.1e11, "nu": 0.3, "density": 7800.0}
UNIT = {"E": 1.0, "G": 1.0, "density": 1.0, "shear": 1.0}


@pytest.mark.parametrize(
    "made, inside",
    [
        (sections.circle(0.7, **UNIT), lambda y, z: y**2 + z**2 < 0.49),
        (sections.tube(0.8, 0.5, **UNIT), lambda y, z: abs(y**2 + z**2 - 0.445) < 0.195),
        (sections.rectangle(1.0, 0.4, **UNIT), lambda y, z: (abs(y) < 0.5) & (abs(z) < 0.2)),
        (sections.ellipse(0.9, 0.3, **UNIT), lambda y, z: y**2 / 0.81 + z**2 / 0.09 < 1),
    ],
    ids=["circle", "tube", "rectangle", "ellipse"],
)  # fmt: skip
def test_area_and_moments(made, inside):
    """Sums over a million cells, whose edges err by about 1e-3."""
    x = (np.arange(1000) + 0.5) / 500 - 1
    y, z = np.meshgrid(x, x)
    cell = inside(y, z) / 500**2
    area, Iy, Iz = cell.sum(), (cell * z**2).sum(), (cell * y**2).sum()
    _, EIy, EIz, EA, GAy, GAz = np.diagonal(made.stiffness)
    assert np.allclose([EA, GAy, GAz, EIy, EIz], [area, area, area, Iy, Iz], rtol=3e-3)
    assert np.allclose(made.inertia, [Iy + Iz, Iy, Iz], rtol=3e-3)
    assert np.allclose(made.mass, area, rtol=3e-3)


@pytest.mark.parametrize("sides", [(1.0, 1.0), (1.0, 0.5), (0.3, 1.2)])
def test_torsion_of_a_rectangle(sides):
    """Against Prandtl's stress function on two grids, extrapolated: J = 2 int phi, D phi = -2."""

    def on_grid(n: int) -> float:
        steps = [side / n for side in sides]
        D = diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n - 1, n - 1))
        one = eye_array(n - 1)
        laplacian = kron(D / steps[0] ** 2, one) + kron(one, D / steps[1] ** 2)
        phi = spsolve(laplacian.tocsc(), -2.0 * np.ones((n - 1) ** 2))
        return 2 * phi.sum() * steps[0] * steps[1]

    a, b, c = (on_grid(n) for n in (20, 40, 80))
    first, second = (4 * b - a) / 3, (4 * c - b) / 3
    want = (16 * second - first) / 15
    got = sections.rectangle(*sides, **UNIT).stiffness[0, 0]
    assert abs(got / want - 1) < 1e-5


def test_coefficients_of_shear():
    """Cowper's table at nu = 0.3, and Timoshenko's circle and rectangle."""

    def k(made):
        d = np.diagonal(made.stiffness)
        return d[4:] / (d[3] / 2.6)

    assert np.allclose(k(sections.circle(0.1, **STEEL)), 7.8 / 8.8)
    assert np.allclose(k(sections.rectangle(0.1, 0.2, **STEEL)), 13 / 15.3)
    assert np.allclose(k(sections.rectangle(0.1, 0.2, **STEEL, shear="timoshenko")), 6.5 / 7.5)
    circle = sections.circle(0.1, **STEEL, shear="timoshenko")
    assert np.allclose(k(circle), (6 + 3.6 + 0.54) / (7 + 3.6 + 0.36))
    assert np.allclose(k(sections.rectangle(0.1, 0.2, **STEEL, shear=(0.5, 0.6))), [0.5, 0.6])
    thin = sections.tube(1.0, 1 - 1e-9, **STEEL)
    assert np.allclose(k(thin), 2 * 1.3 / (4 + 0.9), rtol=1e-6)  # Cowper's thin-walled tube
    deep = sections.ellipse(1e-6, 1.0, E=1.0, nu=0.0, density=1.0)  # 0.9 by its parabola of stress
    assert abs(deep.stiffness[5, 5] / (deep.stiffness[3, 3] / 2) - 0.9) < 1e-9


def test_batches_and_gradients():
    """A tapered beam is a batch, and properties are leaves."""
    radii = jnp.array([0.01, 0.02])
    made = sections.circle(radii, **STEEL)
    assert made.stiffness.shape == (2, 6, 6) and made.mass.shape == (2,)
    slope = jax.grad(lambda r: sections.circle(r, **STEEL).stiffness[1, 1])(0.02)
    assert abs(slope / (4 * made.stiffness[1, 1, 1] / 0.02) - 1) < 1e-12
    square = jax.grad(lambda w: sections.rectangle(w, 1.0, **UNIT).stiffness[0, 0])(1.0)
    assert np.isfinite(square)


def test_given_properties():
    C = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    C[0, 3] = C[3, 0] = 0.5
    made = sections.section(C, 2.0, (0.5, 0.2, 0.3), first_moment=(0.1, 0.0), product=0.01)
    assert np.allclose(made.stiffness, C) and made.eccentric
    assert not sections.section([1.0] * 6, 2.0, (0.0, 0.0, 0.0)).eccentric


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: sections.circle(0.0, **STEEL), "radius is 0.0, expected a number above zero"),
        (lambda: sections.circle(0.1, E=-1.0, nu=0.3, density=1.0), "E is -1.0"),
        (lambda: sections.circle(0.1, E=1.0, density=1.0), "neither nu nor G"),
        (lambda: sections.circle(0.1, E=1.0, nu=0.3, G=1.0, density=1.0), "expected one of them"),
        (lambda: sections.circle(0.1, E=1.0, nu=0.6, density=1.0), "up to 1/2"),
        (lambda: sections.tube(1.0, 1.0, **STEEL), "expected inner < outer"),
        (lambda: sections.ellipse(1.0, 1.0, **STEEL, shear="timoshenko"), "'cowper'"),
        (lambda: sections.rectangle(1.0, 1.0, **STEEL, shear=-1.0), "above zero"),
        (lambda: sections.section([1.0] * 5, 1.0, (0, 0, 0)), "expected \\(6,\\)"),
        (lambda: sections.section([0.0] * 6, 1.0, (0, 0, 0)), "stiffness is zero"),
        (lambda: sections.section([-1.0] * 6, 1.0, (0, 0, 0)), "negative eigenvalue"),
        (lambda: sections.section(np.eye(6, k=1), 1.0, (0, 0, 0)), "not symmetric"),
        (lambda: sections.section([1.0] * 6, 0.0, (0, 0, 0)), "mass is 0.0"),
        (lambda: sections.section([1.0] * 6, 1.0, (1.0, 2.0, 3.0)), "expected x = y \\+ z"),
        (
            lambda: sections.section([1.0] * 6, 1.0, (0.2, 0.1, 0.1), first_moment=(1.0, 0.0)),
            "no distribution of mass",
        ),
    ],
)
def test_bad_sections(make, message):
    with pytest.raises(InputError, match=message):
        make()
