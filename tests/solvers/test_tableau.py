"""Tableaus against published stability functions, and against their own order conditions."""

import diffrax
import numpy as np
import pytest
from scipy.integrate._ivp import dop853_coefficients as hairer

from rbjax.solvers import RosenbrockTableau, Tableau, tableau
from rbjax.solvers.rosenbrock import _ros34pw2, holds
from rbjax.solvers.tableau import DOP853, attained_order, density, size, trees
from tests.oracles import load

ORACLE = load("ode_methods")
METHODS = {
    **{f"Gauss{s}": tableau.gauss(s) for s in (1, 2, 3)},
    **{f"RadauIIA{s}": tableau.radau_iia(s) for s in (2, 3)},
    **{f"LobattoIIIA{s}": tableau.lobatto_iiia(s) for s in (2, 3)},
    **{f"LobattoIIIC{s}": tableau.lobatto_iiic(s) for s in (2, 3)},
}


def test_rooted_trees_are_counted_and_weighed() -> None:
    assert [len(trees(n)) for n in range(1, 8)] == [1, 1, 2, 4, 9, 20, 48]  # Cayley's numbers
    tall, bushy = ((((),),),), ((), (), ())
    assert (size(tall), density(tall)) == (4, 24)
    assert (size(bushy), density(bushy)) == (4, 4)


@pytest.mark.parametrize("name", METHODS)
def test_stability_function(name: str) -> None:
    """R(z) = det(1 - z A + z 1 b') / det(1 - z A), against the published quotient."""
    method, oracle = METHODS[name], ORACLE[name]
    a, b = np.array(method.a), np.array(method.b)
    one = np.eye(len(b))
    for z in (-0.3, 2j, -1 + 1.5j, -7.0):
        got = np.linalg.det(one - z * a + z * np.outer(np.ones(len(b)), b))
        got = got / np.linalg.det(one - z * a)
        num, den = (eval(oracle[key], {"z": z}) for key in ("R_num", "R_den"))
        assert abs(got - num / den) < 1e-13
    z = -1e9
    far = np.linalg.det(one - z * a + z * np.outer(np.ones(len(b)), b)) / np.linalg.det(one - z * a)
    assert abs(far - float(oracle["R_inf"])) < 1e-6
    assert attained_order(a, b, 6) == min(oracle["order"], 6) == method.order


def test_coefficients_of_order_eight() -> None:
    """DOP853 is SciPy's; it and Prince and Dormand's satisfy all 200 conditions of order 8."""
    s = hairer.N_STAGES
    np.testing.assert_array_equal(DOP853.a, hairer.A[:s, :s])
    np.testing.assert_array_equal(DOP853.b, hairer.B)
    for method in (DOP853, tableau.of_diffrax(diffrax.Dopri8, 8)):
        assert attained_order(np.array(method.a), np.array(method.b), 9) == 8


def test_symplectic_condition_of_gauss() -> None:
    """b_i a_ij + b_j a_ji = b_i b_j."""
    for s in (1, 2, 3):
        a, b = np.array(tableau.gauss(s).a), np.array(tableau.gauss(s).b)
        m = b[:, None] * a
        np.testing.assert_allclose(m + m.T, np.outer(b, b), atol=1e-15)


def test_a_wrong_tableau_cannot_be_made() -> None:
    with pytest.raises(ValueError, match="order 1 by its conditions, expected 2"):
        Tableau(((0.0, 0.0), (0.6, 0.0)), (0.0, 1.0), 2)
    with pytest.raises(ValueError, match="do not sum to zero"):
        Tableau(((0.0, 0.0), (0.5, 0.0)), (0.0, 1.0), 2, (0.0, 1.0, 0.0))
    t = _ros34pw2()
    with pytest.raises(ValueError, match="order conditions of 3"):
        RosenbrockTableau(t.alpha, t.gamma, (0.25, -1.25, 1.5, 0.5), t.companion, 3)
    assert not holds(np.array(t.alpha), np.array(t.gamma), np.array(t.companion), 3)
