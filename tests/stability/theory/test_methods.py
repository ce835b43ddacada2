"""A user's own methods: tableaus, polynomials, classes and names, in every function."""

from fractions import Fraction

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import stability
from rbjax.stability.methods import fixed_step_solver, solver_of

CLOSE = 1e-13  # of a growth factor: rounding of a step
SLOPE = 0.1  # of a measured order: powers of h beyond the first

#: the theta method with 0.4: R = (1 + 3 z / 5) / (1 - 2 z / 5), implicit, without error weights
THETA = rb.solvers.Tableau(np.array([[0.0, 0.0], [0.6, 0.4]]), [0.6, 0.4], 1)
#: Heun's method of order three: R = 1 + z + z^2 / 2 + z^3 / 6
HEUN3 = rb.solvers.Tableau([[0, 0, 0], [1 / 3, 0, 0], [0, 2 / 3, 0]], (1 / 4, 0, 3 / 4), 3)
Z = np.array([-0.7, 0.5j, -1 + 2j, -20.0])


def exactly(method, z):
    return (1 + 0.6 * z) / (1 - 0.4 * z) if method is THETA else 1 + z + z**2 / 2 + z**3 / 6


# ------------------------------------------------------------------------------------- tableaus


@pytest.mark.parametrize("table", [THETA, HEUN3], ids=["implicit", "explicit"])
def test_a_tableau_is_taken_as_it_is(table: rb.solvers.Tableau) -> None:
    R = stability.stability_function(table)
    np.testing.assert_allclose(R(Z), exactly(table, Z), rtol=CLOSE)
    report = stability.linear_analysis(table)
    assert report.method == R
    assert report.order == report.linear_order == table.order
    assert report.real_limit == pytest.approx(-10 if table is THETA else -2.5127453266183286)
    # of the code, of the function and of the polynomial
    phi = stability.characteristic(table)
    for method in (table, R, phi):
        factors = stability.growth_factors(method, Z)
        np.testing.assert_allclose(factors, exactly(table, Z)[:, None], rtol=CLOSE)
        assert stability.order_by_conditions(method) == table.order
    a = np.array([[0.0, 1.0], [-4.0, -0.4]])
    steps = [stability.stable_step(method, a) for method in (table, R, phi)]
    x = np.linalg.eigvals(a)[0]
    assert np.ptp(steps) == 0
    assert abs(exactly(table, steps[0] * x)) == pytest.approx(1, abs=1e-8)


def test_code_and_polynomials_agree_on_an_oscillation() -> None:
    omega = np.array([[0.3], [1.7]])
    for ratio in (0.0, 0.4, 1.5):
        pair = np.emath.sqrt(ratio**2 - 1)
        want = [np.abs(exactly(THETA, omega * (-ratio + s * pair))) for s in (1, -1)]
        for method in (THETA, stability.stability_function(THETA)):
            got = stability.spectral_radius(method, omega, ratio)
            np.testing.assert_allclose(got, np.maximum(*want), rtol=1e-8)  # a double root at 1
    xi = [stability.dissipation(m, 0.5) for m in (THETA, stability.characteristic(THETA))]
    assert xi[0] == pytest.approx(xi[1], rel=1e-9)


@pytest.mark.slow
def test_a_tableau_without_error_weights_takes_constant_steps() -> None:
    assert stability.measured_order(THETA).order == pytest.approx(1, abs=SLOPE)
    solver = rb.solvers.ImplicitRungeKutta(THETA)
    term = diffrax.ODETerm(lambda t, y, args: -y)

    def solve(controller, ts):
        return diffrax.diffeqsolve(
            term, solver, 0.0, 1.0, 0.125, jnp.ones(1), stepsize_controller=controller,
            saveat=diffrax.SaveAt(ts=ts),
        )  # fmt: skip

    found = solve(diffrax.ConstantStepSize(), jnp.array([0.0625, 1.0])).ys[:, 0]
    factor = (1 - 0.6 / 8) / (1 + 0.4 / 8)
    assert found[1] == pytest.approx(factor**8, rel=1e-12)
    # the cubic of both ends and their slopes, in the middle
    assert found[0] == pytest.approx((1 + factor) / 2 + (-1 + factor) / 64, rel=1e-12)
    with pytest.raises(RuntimeError, match="does not provide error estimates"):
        solve(diffrax.PIDController(rtol=1e-3, atol=1e-3), jnp.array([1.0]))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (([[0, 0], [1]], [1, 0], 1), "a is .*expected numbers in rows"),
        (([[0.0]], [0.5, 0.5], 1), r"a has shape \(1, 1\), expected \(2, 2\)"),
        (([[np.nan]], [1.0], 1), "all finite"),
        (([[0.0]], 1.0, 1), r"b has shape \(\), expected \(1,\)"),
        (([[0.0]], [1.0], 1, [0.0]), r"error has shape \(1,\), expected \(2,\)"),
        (([[0.0]], [1.0], 2), "order 1 by its conditions, expected 2"),
    ],
)
def test_what_is_no_tableau(table: tuple, words: str) -> None:
    with pytest.raises(rb.InputError, match=words):
        rb.solvers.Tableau(*table)


# ----------------------------------------------------------------------------------- polynomials


def test_a_multistep_method_of_ones_own() -> None:
    """Nystroem's of three steps, and the trapezoidal rule in doubles."""
    nystroem = stability.multistep([0, -1, 0, 1], [1 / 3, -2 / 3, 7 / 3])
    assert nystroem.sigma == (Fraction(1, 3), Fraction(-2, 3), Fraction(7, 3))
    assert (nystroem.order, nystroem.error_constant) == (3, Fraction(1, 6))
    report = stability.linear_analysis(nystroem)
    assert (report.order, report.real_limit, report.zero_stable) == (3, 0, True)
    roots = stability.growth_factors(nystroem, Z)
    for z, zetas in zip(Z, roots, strict=True):
        for x in zetas:
            assert abs(x**3 - x - z * (7 * x**2 - 2 * x + 1) / 3) < 1e-9 * max(1, abs(x)) ** 3
    assert (np.diff(np.abs(roots)) <= 0).all()
    doubles = stability.Characteristic((np.array([-1.0, 1.0]), np.array([-0.5, -0.5])))
    assert doubles == stability.adams(2, True) == stability.multistep([-1, 1], [0.5, 0.5])
    assert (doubles.order, doubles.error_constant) == (2, Fraction(-1, 12))


def test_what_is_not_consistent_is_reported() -> None:
    assert stability.multistep([-1, 1], [1, 1]).order == 0  # rho'(1) = 1, sigma(1) = 2
    assert stability.multistep([1, 1], [1, 1]).order == -1  # rho(1) = 2
    double = stability.linear_analysis(stability.multistep([1, -2, 1], [0, 1]))
    assert (double.order, double.zero_stable, double.error_constant) == (0, False, np.inf)


def test_unstable_methods_have_a_report() -> None:
    report = stability.linear_analysis(stability.backward_differentiation(7))
    assert (report.order, report.zero_stable, report.alpha) == (7, False, 0.0)
    sixth = stability.adams(6, implicit=False)
    assert stability.linear_analysis(sixth).order == 6
    limit = stability.real_limit(sixth)
    stiff = np.array([[0.0, 1.0], [0.0, -50.0]])
    assert stability.stable_step(sixth, stiff) == pytest.approx(-limit / 50, rel=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: stability.multistep([-1, 0, 1], [0, 2, 0, 0]), r"rho \(3,\) and sigma \(4,\)"),
        (lambda: stability.multistep(1.0, [1]), r"rho \(\) and sigma \(1,\)"),
        (lambda: stability.multistep([-1, 1, 0], [0, 2]), "last coefficient of rho is zero"),
        (lambda: stability.multistep([-1, np.nan], [1]), "expected finite numbers"),
        (lambda: stability.multistep([-1, 1], [0, 0]), "sigma is zero"),
        (lambda: stability.Characteristic(((-1, 1),)), "neither zero"),
        (lambda: stability.StabilityFunction((1,), (0,)), "the denominator is zero"),
        (lambda: stability.adams(0, False), "adams: order is 0, expected an integer from 1"),
        (lambda: stability.adams(-1, True), "order is -1"),
        (lambda: stability.adams(2.5, True), "order is 2.5"),
        (lambda: stability.backward_differentiation(0), "backward_differentiation: order is 0"),
        (lambda: stability.pece(1), "pece: order is 1, expected an integer from 2"),
        (
            lambda: rb.solvers.adams_moulton(1),
            "order is 1, expected an integer from 2 to 5",
        ),
        (lambda: stability.measured_order(stability.pece(3)), "Characteristic, which does not"),
        (lambda: stability.growth_factors(diffrax.Tsit5, -1.0), r"class Tsit5, call it: Tsit5\(\)"),
        (lambda: stability.linear_analysis(diffrax.Tsit5), "class Tsit5"),
        (lambda: stability.growth_factors("newmark", -1.0), "1 parts, expected a tuple"),
        (lambda: stability.growth_factors(diffrax.KenCarp3(), -1.0), "KenCarp3 does not step"),
    ],
)
def test_what_is_no_method(call, words: str) -> None:
    with pytest.raises(rb.InputError, match=words):
        call()


# ----------------------------------------------------------------------------- names and solvers


def test_one_door_for_names_solvers_and_tableaus() -> None:
    assert isinstance(solver_of("rk4"), rb.solvers.RK4)
    solver = diffrax.Tsit5()
    assert solver_of(solver) is fixed_step_solver(solver) is solver
    assert isinstance(solver_of(HEUN3), rb.solvers.MuntheKaas)
    assert isinstance(solver_of(THETA), rb.solvers.ImplicitRungeKutta)
    # tolerances of one's own stay, those of a controller are not waited for
    own = diffrax.Kvaerno3(root_finder=diffrax.VeryChord(rtol=1e-3, atol=1e-3))
    assert fixed_step_solver(own) is own
    assert isinstance(fixed_step_solver(diffrax.Kvaerno3()).root_finder, rb.solvers.RootFinder)


@pytest.mark.slow
def test_orders_of_diffrax_implicit_methods_can_be_measured() -> None:
    assert stability.measured_order(diffrax.Kvaerno3()).order == pytest.approx(3, abs=SLOPE)
