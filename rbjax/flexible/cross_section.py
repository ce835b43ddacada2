"""Cross-sections of beams: stiffness, mass and rotary inertia per length.

The section is in the y z plane and the beam along x. Strains and forces are in the order

    k_x, k_y, k_z, e_x, g_y, g_z    (torsion, bending about y and z, axial strain, shear)
    C = diag(GJ, EI_y, EI_z, EA, c_y GA, c_z GA),   I_y = int z^2 dA,   I_z = int y^2 dA

Shear coefficients c by Cowper (*The shear coefficient in Timoshenko's beam theory*, J. Appl. Mech.
33, 1966), with n for Poisson's ratio:

    circle 6 (1 + n) / (7 + 6 n),   rectangle 10 (1 + n) / (12 + 11 n)
    tube, m = inner / outer: 6 (1 + n) (1 + m^2)^2 / ((7 + 6 n) (1 + m^2)^2 + (20 + 12 n) m^2)
    ellipse with semi-axis a along the force and b across:
        12 (1 + n) a^2 (3 a^2 + b^2) / ((40 + 37 n) a^4 + (16 + 10 n) a^2 b^2 + n b^4)

and by Timoshenko (Kaneko, *On Timoshenko's correction for shear in vibrating beams*, J. Phys. D 8,
1975):

    circle (6 + 12 n + 6 n^2) / (7 + 12 n + 4 n^2),   rectangle (5 + 5 n) / (6 + 5 n)
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import check_positive, real_array
from rbjax.errors import InputError
from rbjax.model.record import Record
from rbjax.rotations.arguments import checked

_SYMMETRY = 1e-9  # relative asymmetry of a stiffness that rounding explains


class Section(Record):
    """The properties of a cross-section about the line of a beam. Leading axes are a batch.

    Create it by a shape and a material (`circle`, `tube`, `rectangle`, `ellipse`), or by its
    properties (`section`).

    Fields:
        stiffness: C (..., 6, 6), N m^2 for curvatures, N for the others, N m for couplings.
        mass: kg/m.
        inertia: rotary inertia (..., 3) about x, y and z, kg m.
        first_moment: y and z (..., 2) of the mass centre times the mass, kg.
        product: entry yz of the rotary inertia, -int y z dm, kg m.
    """

    stiffness: jax.Array
    mass: jax.Array
    inertia: jax.Array
    first_moment: jax.Array
    product: jax.Array

    @property
    def eccentric(self) -> bool:
        """True if the mass centre is off the line, or y and z are not principal axes of inertia."""
        parts = (self.first_moment, self.product)
        return any(isinstance(x, jax.core.Tracer) or bool(np.asarray(x).any()) for x in parts)


def section(
    stiffness: Any, mass: Any, inertia: Any, *, first_moment: Any = None, product: Any = 0.0
) -> Section:
    """Create a section from its properties, for composite blades and measured beams.

    Args:
        stiffness: the diagonal (6,) of C or C (6, 6), in the order k_x, k_y, k_z, e_x, g_y, g_z.
        mass: kg/m, more than zero.
        inertia: rotary inertia (3,) about x, y and z through the line, kg m, not below zero.
        first_moment: mass times y and z of the mass centre (2,), kg; zero if None.
        product: entry yz of the rotary inertia, kg m.

    Returns:
        the section.

    Raises:
        InputError: C is not symmetric or has a negative eigenvalue, or the mass and rotary inertia
            are not those of a distribution of mass.

    Source: Hodges, *Nonlinear Composite Beam Theory*, AIAA 2006, chapter 4.

    Example:
        >>> flat = section([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 0.5, [0.02, 0.01, 0.01])
        >>> flat.stiffness.diagonal().tolist()
        [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    """
    if not isinstance(stiffness, jax.core.Tracer):
        stiffness = real_array("section", "stiffness", stiffness)
    C = np.shape(stiffness)
    if C == (6,):
        stiffness = jnp.diag(jnp.asarray(stiffness, float))
    elif C != (6, 6):
        raise InputError(
            f"section: stiffness has the shape {C}, expected (6,), the diagonal of C, or (6, 6)"
        )
    C = checked("section", "stiffness", stiffness, "matrix6")
    check_positive("section", mass=mass)
    mass = checked("section", "mass", mass, "scalar")
    inertia = checked("section", "inertia", inertia, "vector")
    first_moment = (0.0, 0.0) if first_moment is None else first_moment
    first_moment = checked("section", "first_moment", first_moment, "pair")
    product = checked("section", "product", product, "scalar")
    given = {"inertia": inertia.shape[:-1], "first_moment": first_moment.shape[:-1]}
    for name, shape in (given | {"product": product.shape}).items():
        if shape != mass.shape and (shape or name == "inertia"):
            raise InputError(
                f"section: {name} has the leading axes {shape} and mass {mass.shape}, expected the "
                "same: one value, or one at each Gauss point"
            )
    if not isinstance(C, jax.core.Tracer):
        _check_stiffness(np.asarray(C))
    parts = (mass, inertia, first_moment, product)
    if not any(isinstance(x, jax.core.Tracer) for x in parts):
        _check_inertia(*map(np.asarray, parts))
    return Section(C, *parts)


def circle(
    radius: Any, *, E: Any, density: Any, nu: Any = None, G: Any = None, shear: Any = "cowper"
) -> Section:
    """Compute the properties of a solid round section.

    Args:
        radius: m. It may be a batch: the radius at each Gauss point of a tapered beam.
        E: Young's modulus, Pa.
        density: kg/m^3.
        nu: Poisson's ratio. Give nu or the shear modulus G (Pa).
        G: the shear modulus, Pa.
        shear: "cowper", "timoshenko", a coefficient, or a pair (y, z) of coefficients.

    Returns:
        the section.

    Raises:
        InputError: a value that is not above zero, a ratio out of (-1, 1/2], both nu and G or
            neither, or no such coefficient of shear.

    Source: Cowper, J. Appl. Mech. 33, 1966.

    Example:
        >>> rod = circle(0.01, E=2.1e11, nu=0.3, density=7800.0)
        >>> [round(float(x), 1) for x in rod.stiffness.diagonal()[:3]]
        [1268.7, 1649.3, 1649.3]
    """
    check_positive("circle", radius=radius)
    r = checked("circle", "radius", radius, "scalar")
    E, G, nu, rho = _material("circle", E, nu, G, density)
    known = {
        "cowper": 6 * (1 + nu) / (7 + 6 * nu),
        "timoshenko": 6 * (1 + nu) ** 2 / (7 + 12 * nu + 4 * nu**2),
    }
    I = jnp.pi * r**4 / 4
    k = _shear("circle", shear, {name: (x, x) for name, x in known.items()})
    return _homogeneous(jnp.pi * r**2, I, I, 2 * I, E, G, rho, k)


def tube(
    outer: Any, inner: Any, *, E: Any, density: Any, nu: Any = None, G: Any = None,
    shear: Any = "cowper",
) -> Section:  # fmt: skip
    """Compute the properties of a round tube.

    Args:
        outer: outer radius, m, or a batch.
        inner: inner radius, m, smaller than the outer.
        E: Young's modulus, Pa.
        density: kg/m^3.
        nu: Poisson's ratio. Give nu or the shear modulus G (Pa).
        G: the shear modulus, Pa.
        shear: "cowper", a coefficient, or a pair (y, z) of coefficients.

    Returns:
        the section.

    Raises:
        InputError: as for `circle`, or an inner radius that is not smaller than the outer.

    Source: Cowper, J. Appl. Mech. 33, 1966.

    Example:
        >>> pipe = tube(2.0, 1.0, E=1.0, nu=0.0, density=1.0)
        >>> round(float(pipe.mass / jnp.pi), 12)
        3.0
    """
    check_positive("tube", outer=outer, inner=inner)
    R, r = checked("tube", "outer", outer, "scalar"), checked("tube", "inner", inner, "scalar")
    traced = any(isinstance(x, jax.core.Tracer) for x in (R, r))
    if not traced and (np.asarray(R) <= np.asarray(r)).any():
        raise InputError(f"tube: inner is {inner} and outer {outer}, expected inner < outer")
    E, G, nu, rho = _material("tube", E, nu, G, density)
    m, s = (r / R) ** 2, (1 + (r / R) ** 2) ** 2
    k = 6 * (1 + nu) * s / ((7 + 6 * nu) * s + (20 + 12 * nu) * m)
    I = jnp.pi * (R**4 - r**4) / 4
    k = _shear("tube", shear, {"cowper": (k, k)})
    return _homogeneous(jnp.pi * (R**2 - r**2), I, I, 2 * I, E, G, rho, k)


def rectangle(
    width: Any, height: Any, *, E: Any, density: Any, nu: Any = None, G: Any = None,
    shear: Any = "cowper",
) -> Section:  # fmt: skip
    """Compute the properties of a solid rectangular section.

    The torsion constant is Saint-Venant's series, to rounding.

    Args:
        width: edge along y, m, or a batch.
        height: edge along z, m, or a batch.
        E: Young's modulus, Pa.
        density: kg/m^3.
        nu: Poisson's ratio. Give nu or the shear modulus G (Pa).
        G: the shear modulus, Pa.
        shear: "cowper", "timoshenko", a coefficient (5/6 is common), or a pair (y, z).

    Returns:
        the section.

    Raises:
        InputError: as for `circle`.

    Source: Cowper, J. Appl. Mech. 33, 1966; Timoshenko & Goodier, *Theory of Elasticity*, sec. 109.

    Example:
        >>> bar = rectangle(1.0, 1.0, E=12.0, G=1.0, density=1.0)
        >>> [round(float(x), 6) for x in bar.stiffness.diagonal()[:3]]
        [0.140577, 1.0, 1.0]
    """
    check_positive("rectangle", width=width, height=height)
    w = checked("rectangle", "width", width, "scalar")
    h = checked("rectangle", "height", height, "scalar")
    E, G, nu, rho = _material("rectangle", E, nu, G, density)
    known = {
        "cowper": 10 * (1 + nu) / (12 + 11 * nu),
        "timoshenko": 5 * (1 + nu) / (6 + 5 * nu),
    }
    k = _shear("rectangle", shear, {name: (x, x) for name, x in known.items()})
    J = _rectangle_torsion(jnp.maximum(w, h), jnp.minimum(w, h))
    return _homogeneous(w * h, w * h**3 / 12, h * w**3 / 12, J, E, G, rho, k)


def ellipse(
    semi_y: Any, semi_z: Any, *, E: Any, density: Any, nu: Any = None, G: Any = None,
    shear: Any = "cowper",
) -> Section:  # fmt: skip
    """Compute the properties of a solid elliptic section.

    Args:
        semi_y: semi-axis along y, m, or a batch.
        semi_z: semi-axis along z, m, or a batch.
        E: Young's modulus, Pa.
        density: kg/m^3.
        nu: Poisson's ratio. Give nu or the shear modulus G (Pa).
        G: the shear modulus, Pa.
        shear: "cowper", a coefficient, or a pair (y, z) of coefficients.

    Returns:
        the section.

    Raises:
        InputError: as for `circle`.

    Source: Cowper, J. Appl. Mech. 33, 1966.

    Example:
        >>> a = ellipse(0.01, 0.01, E=2.1e11, nu=0.3, density=7800.0)
        >>> b = circle(0.01, E=2.1e11, nu=0.3, density=7800.0)
        >>> bool(jnp.allclose(a.stiffness, b.stiffness, rtol=1e-12))
        True
    """
    check_positive("ellipse", semi_y=semi_y, semi_z=semi_z)
    a = checked("ellipse", "semi_y", semi_y, "scalar")
    b = checked("ellipse", "semi_z", semi_z, "scalar")
    E, G, nu, rho = _material("ellipse", E, nu, G, density)

    def cowper(a: jax.Array, b: jax.Array) -> jax.Array:
        aa, bb = a * a, b * b
        under = (40 + 37 * nu) * aa**2 + (16 + 10 * nu) * aa * bb + nu * bb**2
        return 12 * (1 + nu) * aa * (3 * aa + bb) / under

    k = _shear("ellipse", shear, {"cowper": (cowper(a, b), cowper(b, a))})
    area, J = jnp.pi * a * b, jnp.pi * a**3 * b**3 / (a**2 + b**2)
    return _homogeneous(area, area * b**2 / 4, area * a**2 / 4, J, E, G, rho, k)


def _rectangle_torsion(a: jax.Array, b: jax.Array) -> jax.Array:
    """Compute J = a b^3 (1/3 - 64 b / (pi^5 a) sum tanh(n pi a / (2 b)) / n^5), n odd, a >= b.

    tanh is 1 to 5e-15 from n = 11, and the sum of 1 / n^5 over all odd n is 31 zeta(5) / 32.
    """
    few = jnp.arange(1, 13, 2)
    lacking = (1 - jnp.tanh(few * jnp.pi / 2 * (a / b)[..., None])) / few**5.0
    total = 31 / 32 * 1.0369277551433699 - lacking.sum(-1)
    return a * b**3 * (1 / 3 - 64 / jnp.pi**5 * (b / a) * total)


def _material(where: str, E: Any, nu: Any, G: Any, density: Any) -> tuple[jax.Array, ...]:
    """Check the material, and return E, G, nu and density."""
    if (nu is None) == (G is None):
        got = "neither nu nor G" if nu is None else f"nu = {nu} and G = {G}"
        raise InputError(f"{where}: got {got}, expected one of them; E = 2 G (1 + nu)")
    check_positive(where, E=E, density=density, G=G)
    E = checked(where, "E", E, "scalar")
    density = checked(where, "density", density, "scalar")
    if G is None:
        nu = checked(where, "nu", nu, "scalar")
        G = E / (2 * (1 + nu))
    else:
        G = checked(where, "G", G, "scalar")
        nu = E / (2 * G) - 1
        return E, G, nu, density  # a composite may have any G
    if not isinstance(nu, jax.core.Tracer):
        ratio = np.asarray(nu)
        if not ((ratio > -1) & (ratio <= 0.5)).all():
            raise InputError(f"{where}: nu is {nu}, expected a ratio above -1 and up to 1/2")
    return E, G, nu, density


def _shear(where: str, given: Any, known: dict[str, tuple]) -> tuple[jax.Array, jax.Array]:
    """Return the coefficients of shear along y and z."""
    if isinstance(given, str):
        if given not in known:
            raise InputError(
                f"{where}: shear is {given!r}, expected one of {', '.join(map(repr, known))}, a "
                "coefficient, or a pair (y, z) of coefficients"
            )
        return known[given]
    check_positive(where, shear=given)
    if np.shape(given) == (2,):
        k = checked(where, "shear", given, "pair")
        return k[0], k[1]
    k = checked(where, "shear", given, "scalar")
    return k, k


def _homogeneous(
    A: jax.Array, Iy: jax.Array, Iz: jax.Array, J: jax.Array, E: jax.Array, G: jax.Array,
    density: jax.Array, shear: tuple[jax.Array, jax.Array],
) -> Section:  # fmt: skip
    ky, kz = shear
    diagonal = jnp.broadcast_arrays(G * J, E * Iy, E * Iz, E * A, ky * G * A, kz * G * A)
    mass, *inertia = jnp.broadcast_arrays(
        density * A, density * (Iy + Iz), density * Iy, density * Iz
    )
    C = jnp.stack(diagonal, -1)[..., None] * jnp.eye(6)
    none = jnp.zeros_like(mass)
    return Section(C, mass, jnp.stack(inertia, -1), jnp.stack([none, none], -1), none)


def _check_stiffness(C: np.ndarray) -> None:
    scale = np.sqrt(np.abs(np.einsum("...ii->...i", C)))
    unit = scale + (scale == 0)
    scaled = C / (unit[..., :, None] * unit[..., None, :])
    if np.abs(scaled - scaled.swapaxes(-1, -2)).max() > _SYMMETRY:
        raise InputError(f"section: stiffness is not symmetric:\n{C}\nexpected C = C^T")
    least = np.linalg.eigvalsh(scaled).min()
    if least < -_SYMMETRY:
        raise InputError(
            f"section: stiffness has a negative eigenvalue ({least:.3g} with a unit diagonal), so "
            f"that the beam would release energy by deforming:\n{C}"
        )
    if not (np.einsum("...ii->...i", C) > 0).any():
        raise InputError("section: stiffness is zero, expected at least one entry above zero")


def _check_inertia(m: np.ndarray, J: np.ndarray, h: np.ndarray, yz: np.ndarray) -> None:
    """Check that the section is a distribution of mass: [m, h; h^T, int x x^T dm] >= 0."""
    if (J < 0).any():
        raise InputError(f"section: inertia is {J}, expected rotary inertias not below zero")
    zz, yy = J[..., 1], J[..., 2]  # int z^2 dm, int y^2 dm
    if np.abs(yy + zz - J[..., 0]).max() > 1e-6 * max(np.abs(J).max(), 1e-300):
        raise InputError(
            f"section: inertia is {J}, expected x = y + z for a section, which is flat"
        )
    m, y, z, yz, yy, zz = np.broadcast_arrays(m, h[..., 0], h[..., 1], yz, yy, zz)
    rows = [[m, y, z], [y, yy, -yz], [z, -yz, zz]]
    pseudo = np.stack([np.stack(row, -1) for row in rows], -2)
    if np.linalg.eigvalsh(pseudo).min() < -1e-9 * np.abs(pseudo).max():
        raise InputError(
            f"section: no distribution of mass has mass {m}, inertia {J}, first_moment {h} and "
            f"product {yz}; the inertias are about the line of the beam, not about the mass centre"
        )
