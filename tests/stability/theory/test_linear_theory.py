"""Linear theory against published constants, and against brute force over the plane.

The published limits were found by halving with a threshold of 1e-12 on a modulus, and carry that
error: -2.000000000001 is -2. Where it matters, the threshold is shown to explain the difference.
"""

import math
from fractions import Fraction

import diffrax
import mpmath
import numpy as np
import pytest

import rbjax as rb
from rbjax import stability
from rbjax.solvers import tableau
from rbjax.stability.theory.polynomials import value
from rbjax.stability.theory.stability_function import of_tableau
from tests.oracles import load

ORACLE = load("ode_theory")
THRESHOLD = 1e-12  # of the published halvings
LIMIT = 3e-12  # what it moves a limit by, of its own size, where the modulus crosses at a slope
EXACT = 2e-14  # roots of exact polynomials, in doubles

RUNGE_KUTTA = {
    "RK1 (s=p=1)": "euler",
    "RK2 (s=p=2)": "heun",
    "RK3 (s=p=3)": diffrax.Bosh3(),
    "RK4 (s=p=4)": "rk4",
    "DOPRI5": diffrax.Dopri5(),
}
IMPLICIT = {
    **{f"Gauss{s}": rb.solvers.gauss_legendre(s) for s in (1, 2, 3)},
    **{f"RadauIIA{s}": rb.solvers.radau_iia(s) for s in (1, 2, 3)},
    **{f"LobattoIIIA{s}": rb.solvers.lobatto_iiia(s) for s in (2, 3)},
    **{f"LobattoIIIC{s}": rb.solvers.lobatto_iiic(s) for s in (2, 3)},
}
LINEAR = [n for n, entry in rb.solvers.all().items() if entry.kind == "ode"]


@pytest.mark.parametrize("k", range(1, 8))
def test_backward_differentiation(k: int) -> None:
    phi, oracle = stability.backward_differentiation(k), ORACLE[f"BDF{k}"]
    assert list(phi.rho) == [Fraction(c) for c in oracle["coeffs_y_n_to_y_nk"]]
    assert phi.order == oracle["order"] == k
    assert phi.error_constant == Fraction(oracle["error_constant"])
    assert phi.zero_stable == oracle["zero_stable"]
    largest = np.abs(phi.spurious_roots).max(initial=0.0)
    assert abs(largest - oracle["largest_spurious_root"]) < EXACT
    if k < 7:
        report = stability.linear_analysis(f"bdf{k}")
        assert report.method == phi
        assert abs(report.alpha - oracle["A_alpha_deg"]) < LIMIT
        assert abs(report.stiff_D - oracle["D_stiff"]) < 1e-9  # a minimum: 1e-12 at most by theta^2
        assert (report.A_stable, report.L_stable, report.R_inf) == (k < 3, k < 3, 0)


def test_stiff_stability_is_exact_where_it_is_rational() -> None:
    D = [stability.linear_analysis(f"bdf{k}").stiff_D for k in (1, 2, 3, 4, 6)]
    np.testing.assert_allclose(D, [0, 0, 1 / 12, 2 / 3, 243 / 40], rtol=EXACT)


@pytest.mark.parametrize("name", [n for n in ORACLE if n[:2] in ("AB", "AM")])
def test_adams(name: str) -> None:
    oracle = ORACLE[name]
    phi = stability.adams(oracle["order"], implicit=name.startswith("AM"))
    assert [b for b in reversed(phi.sigma) if b] == [Fraction(b) for b in oracle["b"]]
    assert phi.error_constant == Fraction(oracle["error_constant"])
    assert phi.order == oracle["order"]
    assert phi.zero_stable
    limit = stability.real_limit(phi)
    if oracle["real_interval"] is None:
        assert limit == -math.inf
    else:
        assert abs(limit - oracle["real_interval"][0]) < LIMIT * max(1, -limit)


@pytest.mark.parametrize("name", RUNGE_KUTTA)
def test_explicit_runge_kutta(name: str) -> None:
    R, oracle = stability.stability_function(RUNGE_KUTTA[name]), ORACLE[name]
    assert [float(c) for c in R.numerator] == oracle["R"]
    assert R.denominator == (1,)
    assert abs(stability.real_limit(R) - oracle["real"]) < EXACT
    limit = stability.imaginary_limit(R)
    assert abs(limit - oracle["imag"]) < 1e-9
    # the published one is beyond by no more than its threshold, ours by nothing
    assert R.radius(1j * oracle["imag"]) < 1 + 2 * THRESHOLD
    assert R.radius(1j * limit) < 1 + 1e-15
    assert limit <= oracle["imag"] + EXACT


@pytest.mark.parametrize("name", IMPLICIT)
def test_implicit_runge_kutta(name: str) -> None:
    solver, oracle = IMPLICIT[name], ORACLE[name]
    report = stability.linear_analysis(solver)
    R = report.method
    for part, text in ((R.numerator, oracle["R_num"]), (R.denominator, oracle["R_den"])):
        for z in map(Fraction, range(1, 6)):  # degree at most three: five points are an identity
            assert value(part, z) == eval(text, {"z": z})
    assert report.linear_order == oracle["order"]
    assert -report.error_constant == Fraction(oracle["R_minus_exp_coefficient"])
    assert R.at_infinity == float(oracle["R_inf"])
    assert (report.A_stable, report.L_stable) == (oracle["A_stable"], oracle["L_stable"])
    assert report.order == oracle["order"]
    assert solver.tableau.stages == oracle["stages"]


def test_dahlquists_published_constants() -> None:
    trapezoid = stability.linear_analysis("adams_moulton2")
    assert trapezoid.error_constant == Fraction(-1, 12)
    assert trapezoid.A_stable
    assert not trapezoid.L_stable
    seventh = stability.backward_differentiation(7)
    assert abs(abs(seventh.spurious_roots[0]) - 1.022218244361677) < EXACT


@pytest.mark.parametrize("name", LINEAR)
def test_brute_force_agrees(name: str) -> None:
    """Just inside every limit the method is stable, just outside it is not."""
    report, entry = stability.linear_analysis(name), rb.solvers.all()[name]
    phi = stability.characteristic(name)
    assert report.order == entry.order == report.linear_order
    assert report.zero_stable

    def stable(z):
        return (phi.radius(np.asarray(z)) <= 1 + 1e-9).all()

    inside = np.linspace(1e-3, 1 - 1e-6, 200)  # at the end two roots may meet on the circle
    if report.real_limit == -math.inf:
        assert stable(-np.logspace(-4, 6, 300))
    else:
        assert stable(report.real_limit * inside)
        assert not stable(report.real_limit * 1.0001 - 1e-9)
    if 0 < report.imaginary_limit < math.inf:
        assert stable(1j * report.imaginary_limit * inside)
        assert not stable(1j * report.imaginary_limit * 1.001)
    elif report.imaginary_limit == math.inf:
        assert stable(1j * np.logspace(-4, 6, 300))
    else:
        assert not stable(1j * np.linspace(0.05, 0.5, 50))
    ray = np.logspace(-2, 3, 4000)
    angle = math.radians(report.alpha)
    assert report.A_stable == (report.alpha == 90)
    if report.alpha:
        assert stable(-ray * np.exp(0.9999j * angle))
    if 0 < report.alpha < 90:
        assert not stable(-ray * np.exp(1.001j * angle))
    if 0 < report.stiff_D < math.inf:
        strip = 1j * np.linspace(0, 30, 3000)
        assert stable(-report.stiff_D * 1.0001 + strip)
        assert not stable(-report.stiff_D * 0.999 + strip)


def growth(phi: stability.Characteristic, y: float) -> mpmath.mpf:
    """|zeta| - 1 of the largest root at i y, in 60 digits."""
    with mpmath.workdps(60):
        row = [mpmath.mpc(0)] * (phi.steps + 1)
        for m, p in enumerate(phi.by_power):
            for j, c in enumerate(p):
                row[j] += mpmath.mpc(0, y) ** m * c.numerator / c.denominator
        while not row[0]:
            row.pop(0)
        order = {"asc": False} if mpmath.__version__ >= "1.4" else {}  # 1.3 has no such argument
        found = mpmath.polyroots(row[::-1], maxsteps=500, extraprec=300, **order)
        return max(map(abs, found)) - 1


FAMILIES = {
    **{f"AB{k}": stability.adams(k, implicit=False) for k in range(2, 9)},
    **{f"AM{k}": stability.adams(k, implicit=True) for k in range(3, 9)},
    **{f"PECE{k}": stability.pece(k) for k in range(3, 9)},
    **{f"BDF{k}": stability.backward_differentiation(k) for k in range(1, 8)},
}
WEAK = {"AB6", "PECE6", "AM7"}  # by 3e-11, 6e-15 and 5e-19 at 0.05 i, 0.02 i and 0.01 i


@pytest.mark.parametrize("name", [
    n if n in WEAK else pytest.param(n, marks=pytest.mark.slow) for n in FAMILIES
])  # fmt: skip
def test_imaginary_limits_of_multistep_methods(name: str) -> None:
    """Against a scan that knows a growth of 1e-40: inside all along, outside just beyond."""
    phi = FAMILIES[name]
    limit = stability.imaginary_limit(phi)
    if limit == 0:
        assert all(growth(phi, y) > 0 for y in (1e-3, 0.01, 0.02, 0.05))
    elif limit == math.inf:
        assert all(growth(phi, y) < 1e-50 for y in np.logspace(-3, 3, 30))
    else:
        assert all(growth(phi, y) < 0 for y in limit * np.linspace(0.001, 0.999, 40))
        assert growth(phi, limit * 1.001) > 0
    if name in WEAK:
        assert limit == 0


def test_a_polynomial_of_one_step_is_a_stability_function() -> None:
    """Radau IIA's has z^2: limits and angle are those of its R."""
    phi, R = stability.characteristic("radau_iia2"), stability.stability_function("radau_iia2")
    for of in (stability.imaginary_limit, stability.real_limit, stability.alpha_degrees,
               stability.stiff_stability):  # fmt: skip
        assert of(phi) == of(R)
    cubed = stability.Characteristic((*FAMILIES["AB2"].by_power, (), (Fraction(1),)))
    with pytest.raises(rb.InputError, match=r"z\^3, expected at most z\^2"):
        stability.imaginary_limit(cubed)
    newest = tuple(map(Fraction, (0, 0, 1)))
    squared = stability.Characteristic((*FAMILIES["BDF2"].by_power, newest))
    with pytest.raises(rb.InputError, match=r"with z\^2, expected rho - z sigma"):
        stability.alpha_degrees(squared)


def test_half_solver_takes_two_half_steps() -> None:
    half = stability.stability_function(diffrax.HalfSolver(diffrax.Heun()))
    whole = stability.stability_function("heun")
    for z in (-0.7, 1j, -3 + 2j):
        assert abs(half(z) - whole(z / 2) ** 2) < 1e-15


def test_leapfrog_is_stable_on_the_axis_alone() -> None:
    report = stability.linear_analysis(diffrax.LeapfrogMidpoint())
    assert (report.order, report.error_constant) == (2, Fraction(1, 6))
    assert (report.real_limit, report.imaginary_limit) == (0, 1)


def test_any_tableau_of_ones_own() -> None:
    """The theta method with 0.4: implicit, and stable to -2 / (1 - 2 theta)."""
    R = stability.stability_function(rb.solvers.Tableau([[0, 0], [0.6, 0.4]], [0.6, 0.4], 1))
    assert str(R) == "(1 + 3z/5) / (1 - 2z/5)"
    assert abs(stability.real_limit(R) + 10) < 1e-12
    assert stability.alpha_degrees(R) == 0
    assert R.at_infinity == -1.5


@pytest.mark.parametrize("degree", [3, 4])
def test_the_angle_of_a_one_step_method(degree: int) -> None:
    """1 / (1 - z + z^2 / 2 - ...), Pade's (0, degree), against points all along the rim."""
    Q = tuple(Fraction((-1) ** k, math.factorial(k)) for k in range(degree + 1))
    R = stability.StabilityFunction((Fraction(1),), Q)
    theta = np.linspace(0, np.pi, 10_001)
    rim = np.concatenate([
        np.roots([*map(float, Q[:0:-1]), 1 - np.exp(1j * t)]) for t in theta
    ])  # fmt: skip
    left = rim[rim.real < -1e-6]
    angle = np.degrees(np.abs(np.arctan2(left.imag, -left.real))).min()
    assert stability.alpha_degrees(R) == pytest.approx(angle, abs=1e-3)
    assert 80 < angle < 90
    assert stability.real_limit(R) == -math.inf
    assert stability.stiff_stability(R) == pytest.approx(-rim.real.min(), abs=1e-6)


def test_a_tableau_with_printed_digits() -> None:
    """Alexander's SDIRK3: gamma of ten digits leaves 1e-11 of the order conditions."""
    for gamma in (0.4358665215, 0.435866521508459):
        late = (1 + gamma) / 2
        b = [-(6 * gamma**2 - 16 * gamma + 1) / 4, (6 * gamma**2 - 20 * gamma + 5) / 4, gamma]
        a = np.array([[gamma, 0, 0], [late - gamma, gamma, 0], b])
        R = of_tableau(a, np.array(b))
        assert tableau.attained_order(a, np.array(b)) == stability.characteristic(R).order == 3
        assert (stability.imaginary_limit(R), stability.alpha_degrees(R)) == (math.inf, 90)
        assert float(stability.characteristic(R).error_constant) == pytest.approx(
            0.0258970846, rel=1e-8
        )


def test_ninety_degrees_are_a_stability() -> None:
    """Radau IIA with 1/6 + e: |P|^2 - |Q|^2 = 2 e w - (1/6 + e)^2 w^2, above zero by 4e-15."""
    for e, A_stable in ((Fraction(1, 10**8), False), (-Fraction(1, 10**8), True)):
        Q = (Fraction(1), -Fraction(2, 3), Fraction(1, 6) + e)
        R = stability.StabilityFunction((Fraction(1), Fraction(1, 3)), Q)
        assert (stability.imaginary_limit(R) == math.inf) is A_stable
        assert (stability.alpha_degrees(R) == 90) is A_stable
        assert (stability.stiff_stability(R) == 0) is A_stable
        assert stability.stiff_stability(R) < 1e-6
        assert stability.alpha_degrees(R) > 89.99


@pytest.mark.parametrize(
    ("solver", "order"),
    [(rb.solvers.gauss_legendre(5), 10), (rb.solvers.radau_iia(5), 9),
     (rb.solvers.lobatto_iiic(6), 10), (rb.solvers.gauss_legendre(4), 8), (diffrax.Dopri8(), 8)],
    ids=["gauss5", "radau5", "lobatto6", "gauss4", "dopri8"],
)  # fmt: skip
def test_orders_above_eight_by_simplifying_assumptions(solver, order: int) -> None:
    assert stability.order_by_conditions(solver) == order


def test_tableaus_of_irrational_numbers_keep_them() -> None:
    gamma = 1 - 0.5**0.5
    R = stability.stability_function("sdirk2")
    assert [float(c) for c in R.denominator] == pytest.approx([1, -2 * gamma, gamma**2], rel=1e-15)
    assert len(R.numerator) == 2, "L-stable: the coefficient of z^2 is zero, and not rounding"
    assert tableau.attained_order(np.array(tableau.RK4.a), np.array(tableau.RK4.b)) == 4


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: stability.stability_function("bdf2"), "BDF has no R.z."),
        (lambda: stability.linear_analysis("newmark"), "no linear theory here.*spectral_radius"),
        (lambda: stability.stability_function(diffrax.KenCarp3()), "KenCarp3 has no R.z."),
        (lambda: stability.spectral_radius("rigid_body_splitting", 1.0), "RigidBodySplitting"),
        (lambda: stability.plot_regions({}, (1.0, 0.0, 0.0, 1.0)), "window"),
    ],
)
def test_what_has_no_theory_is_refused_in_a_sentence(call, words: str) -> None:
    with pytest.raises(rb.InputError, match=words):
        call()


def test_unknown_names_list_the_names() -> None:
    with pytest.raises(rb.UnknownName, match=r"unknown solver 'rk5'.*'rk4'"):
        stability.linear_analysis("rk5")
