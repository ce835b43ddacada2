"""One step of each solver's code against theory that does not share it.

First-order solvers: exact polynomials. Second-order ones: the textbook's amplification matrix of
the generalized-alpha family in 50 digits, and closed forms.
"""

import diffrax
import mpmath
import numpy as np
import pytest

import rbjax as rb
from rbjax import stability
from tests.oracles import load

ORACLE = load("ode_theory")
ROUNDING = 2e-14
# A triple root, exactly so at infinite frequency, is known to the cube root of rounding (6e-6) from
# the matrix of a step; so are the published ones, which a double precision eigenvalue gave.
TRIPLE = 1e-5

POINTS = np.array([-0.3, 2j, -1 + 1.5j, -7.0, 0.2 - 0.1j, -0.01 + 0.3j, -50.0, 3.0])
NAMES = [
    n for n, e in rb.solvers.all().items()
    if e.kind == "ode" or n.startswith(("rkmk", "crouch", "comm"))
]  # fmt: skip
QUICK = {"rk4", "ros34pw2", "pece3", "crouch_grossman3"}
slow = pytest.mark.slow


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in QUICK else slow) for n in NAMES])
def test_the_code_has_the_roots_of_theory(name: str) -> None:
    """Every root of theory is a factor of a step, and every other factor is zero."""
    phi = stability.characteristic(name)
    got, want = stability.growth_factors(name, POINTS), phi.roots(POINTS)
    for z, factors, roots in zip(POINTS, got, want, strict=True):
        factors = list(factors)
        for root in roots:
            nearest = min(factors, key=lambda x, root=root: abs(x - root))
            # parasitic roots near zero are multiple ones: their distance is a root of rounding
            close = 1e-11 if len(roots) == 1 else 1e-7
            assert abs(nearest - root) < close * max(1, abs(root)), (z, roots, factors)
            factors.remove(nearest)
        assert np.abs(factors).max(initial=0.0) < 1e-3, (z, roots, factors)


@slow
def test_diffrax_own_solvers_too() -> None:
    for solver in (diffrax.ImplicitEuler(), diffrax.Ralston()):
        R = stability.stability_function(solver)
        np.testing.assert_allclose(stability.growth_factors(solver, POINTS)[:, 0], R(POINTS))


@slow
@pytest.mark.parametrize("name", ["rk4", "radau_iia2", "adams_bashforth3", "bdf3", "sdirk2"])
def test_an_oscillator_is_two_scalar_equations(name: str) -> None:
    omega = np.array([0.1, 0.4, 2.0])
    phi = stability.characteristic(name)
    for ratio in (0.0, 0.3):
        z = omega * (-ratio + 1j * np.sqrt(1 - ratio**2))
        got = stability.spectral_radius(name, omega, ratio)
        np.testing.assert_allclose(got, phi.radius(z), rtol=1e-9)


def textbook(omega: float, m: float, f: float, beta: float, gamma: float) -> mpmath.mpf:
    """The spectral radius of generalized-alpha, from its amplification matrix, in 50 digits."""
    with mpmath.workdps(50):
        w, m, f, beta, gamma = map(mpmath.mpf, (omega, m, f, beta, gamma))
        w2 = w * w
        new = mpmath.matrix([[1, 0, -beta], [0, 1, -gamma], [(1 - f) * w2, 0, 1 - m]])
        old = mpmath.matrix([[1, 1, 0.5 - beta], [0, 1, 1 - gamma], [-f * w2, 0, -m]])
        return max(abs(x) for x in mpmath.eig(new**-1 * old, left=False, right=False))


@pytest.mark.parametrize("rho", ["0.0", "0.5", "0.8", "0.9", "1.0"])
def test_generalized_alpha(rho: str) -> None:
    oracle = ORACLE["generalized_alpha"]["params"][rho]
    solver = rb.solvers.generalized_alpha(float(rho))
    numbers = [getattr(solver, name) for name in ("alpha_m", "alpha_f", "beta", "gamma")]
    for name, x in zip(("alpha_m", "alpha_f", "beta", "gamma"), numbers, strict=True):
        assert abs(x - oracle[name]) < 1e-15
    omegas = np.concatenate([np.logspace(-2, 3, 39), [1e6]])
    measured = stability.spectral_radius(solver, omegas)
    exact = np.array([float(textbook(w, *numbers)) for w in (0.1, 1.0, 10.0)])
    got = stability.spectral_radius(solver, np.array([0.1, 1.0, 10.0]))
    np.testing.assert_allclose(got, exact, atol=1e-8)
    at_infinity = float(textbook(1e6, *numbers))
    assert abs(at_infinity - oracle["rho_at_Omega_1e6"]) < TRIPLE
    assert abs(measured[-1] - at_infinity) < TRIPLE
    assert abs(measured.max() - oracle["rho_max_over_Omega"]) < 1e-7
    assert measured.max() < 1 + 1e-11


VIBRATION = np.array([[0.0, 1.0], [-1.0, 0.0]])  # undamped, omega = 1


def test_limits_of_newmarks_family() -> None:
    limits = {
        "central_differences": 2.0,
        rb.solvers.newmark(1 / 6): 2 * np.sqrt(3),  # linear acceleration
        "newmark": np.inf,
    }
    for solver, limit in limits.items():
        assert stability.stable_step(solver, VIBRATION) == pytest.approx(limit, rel=1e-6)


@pytest.mark.parametrize("name", [
    "stoermer_verlet",
    *(pytest.param(n, marks=slow) for n in ("symplectic_euler", "semi_implicit_euler")),
])  # fmt: skip
def test_explicit_symplectic_methods_reach_two(name: str) -> None:
    assert stability.stable_step(name, VIBRATION) == pytest.approx(2.0, rel=1e-6)


EXACT_LIMITS = {
    "heun": 0.0, "adams_bashforth5": 0.0, "adams_moulton4": 0.0, "pece5": 0.0, "bdf4": 0.0,
    "rk4": 2 * np.sqrt(2), "trapezoid": np.inf, "pece3": 1.2, "rkmk3": np.sqrt(3),
}  # fmt: skip


@pytest.mark.parametrize("name", EXACT_LIMITS)
def test_limits_of_first_order_methods_are_exact(name: str) -> None:
    """Zero for a weak instability of 1e-12 a step; likewise the largest step of a vibration."""
    limit, omega = EXACT_LIMITS[name], 7.0
    for real in (0.0, 1e-12, -1e-12):  # of rounding size
        vibration = np.array([[0.0, 1.0], [-(omega**2), 2 * omega * real]])
        assert stability.stable_step(name, vibration) == pytest.approx(limit / omega, rel=1e-9)


def test_limits_of_high_order_methods_on_the_axis() -> None:
    for solver, limit in ((diffrax.Dopri8(), 0.0), (diffrax.Tsit5(), 0.4779788688827523)):
        exact = stability.imaginary_limit(stability.characteristic(solver))
        assert exact == pytest.approx(limit, rel=1e-14)
        step = stability.stable_step(solver, np.array([[0.0, 1.0], [-4.0, 0.0]]))
        assert step == pytest.approx(limit / 2, rel=1e-9)
    R = stability.stability_function(diffrax.Tsit5())
    assert float(R.radius(0.477j)) < 1 < float(R.radius(0.48j))


def test_damping_as_small_as_one_likes_beside_the_axis() -> None:
    """Heun, lambda = -e + i: 1 - e y + y^4 / 8 leaves at y^3 = 8 e."""
    for e in (1e-4, 1e-6, 1e-8):
        A = np.array([[0.0, 1.0], [-1.0, -2 * e]])
        assert stability.stable_step("heun", A) == pytest.approx(2 * np.cbrt(e), rel=0.01)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: stability.spectral_radius("rk4", 0.0), "h_omega has 0.0, expected"),
        (lambda: stability.dissipation("rk4", [1.0, np.nan]), "h_omega has nan, expected"),
        (lambda: stability.spectral_radius("rk4", 1.0, np.nan), "damping_ratio is nan"),
        (lambda: stability.stable_step("rk4", np.full((2, 2), np.nan)), "matrices are not finite"),
        (lambda: stability.stable_step("newmark", np.ones((2, 4))), r"have shape \(2, 4\)"),
        (lambda: stability.stable_step("rk4", np.ones((3, 3))), r"have shape \(3, 3\)"),
    ],
)
def test_what_is_no_vibration_is_refused_in_a_sentence(call, words: str) -> None:
    with pytest.raises(rb.InputError, match=words):
        call()


def test_dissipation_and_period() -> None:
    """Closed forms: tan(Omega' / 2) = Omega / 2 and cos(Omega') = 1 - Omega^2 / 2, no damping."""
    omega = np.array([0.05, 0.5, 1.5])
    slower = {
        "newmark": 2 * np.arctan(omega / 2),
        "central_differences": np.arccos(1 - omega**2 / 2),
    }
    for name, shown in slower.items():
        elongation = stability.period_elongation(name, omega)
        np.testing.assert_allclose(elongation, omega / shown - 1, atol=ROUNDING)
        np.testing.assert_allclose(stability.dissipation(name, omega), 0, atol=ROUNDING)
    damped = rb.solvers.generalized_alpha(0.5)
    xi = stability.dissipation(damped, omega)
    assert (np.diff(xi) > 0).all(), "high frequencies are damped more"
    assert xi[0] < 1e-4
    assert np.isnan(stability.period_elongation("central_differences", 2.5)), "nothing oscillates"


@slow
def test_other_members_of_the_family() -> None:
    """HHT: rho at infinity (1 + alpha) / (1 - alpha); variational midpoint: no damping at all."""
    for alpha in (-1 / 3, -0.1, 0.0):
        got = stability.spectral_radius(rb.solvers.hht_alpha(alpha), 1e6)
        assert abs(got - (1 + alpha) / (1 - alpha)) < 1e-4
    omega = np.array([0.1, 1.0, 10.0])
    for name in ("variational_midpoint", "implicit_midpoint", "gauss_legendre2"):
        np.testing.assert_allclose(stability.spectral_radius(name, omega), 1, atol=1e-12)


def test_f32_callers_measure_in_f64() -> None:
    import jax

    with jax.enable_x64(False):
        factor = stability.growth_factors("rk4", -1.0)[0]
    assert abs(factor - 0.375) < 1e-15


def test_the_rim_is_drawn_where_theory_has_it() -> None:
    from matplotlib.contour import QuadContourSet
    from matplotlib.figure import Figure

    ax = Figure().add_subplot()
    stability.plot_regions({"Euler": "euler"}, (-2.5, 0.5, -1.5, 1.5), points=301, ax=ax)
    _, rim = (c for c in ax.collections if isinstance(c, QuadContourSet))
    points = np.concatenate([path.vertices for path in rim.get_paths()])
    np.testing.assert_allclose(np.hypot(points[:, 0] + 1, points[:, 1]), 1, atol=1e-3)


def test_spectral_radii_are_drawn_as_measured() -> None:
    from matplotlib.figure import Figure

    ax, frequencies = Figure().add_subplot(), np.array([0.1, 1.0, 1.9])
    stability.plot_spectral_radius({"Verlet": "stoermer_verlet"}, frequencies, ax=ax)
    (line,) = ax.lines
    np.testing.assert_allclose(line.get_ydata(), 1, rtol=1e-6)  # stable below h omega = 2
    np.testing.assert_array_equal(line.get_xdata(), frequencies)


def test_factors_of_verlet_are_a_pair_on_the_unit_circle() -> None:
    """zeta^2 - (2 - Omega^2) zeta + 1 = 0."""
    omega = np.array([0.5, 1.5])
    factors = stability.oscillator_factors("stoermer_verlet", omega)
    assert factors.shape == (2, 2)
    np.testing.assert_allclose(factors.sum(-1), 2 - omega**2, atol=1e-6)
    np.testing.assert_allclose(factors.prod(-1), 1, atol=1e-6)


def test_the_region_of_euler_is_a_disc() -> None:
    euler = stability.stability_function(diffrax.Euler())
    x, y = np.linspace(-3, 1, 9), np.linspace(-2, 2, 5)
    radius = stability.stability_region(euler, x, y)
    np.testing.assert_allclose(radius, np.hypot(1 + x[None], y[:, None]), atol=1e-12)
